// The leaderboard: what the server says of it, and rows of a table for the page and the wall.

/** Asks for the standings; null where no runs are kept or nobody may see them. */
export async function ask() {
  const answer = await fetch("/api/leaderboard");
  return answer.ok ? answer.json() : null;
}

const cell = (text) => Object.assign(document.createElement("td"), { textContent: text });

/** Fills a table's body with places. */
export function fill(body, places) {
  const rows = places.map((place) => {
    const row = document.createElement("tr");
    if (place.rank === 1) row.className = "first";
    const time = place.seconds == null ? "–" : `${place.seconds.toFixed(2)} s`;
    row.append(cell(place.rank), cell(place.team), cell(`${place.stages_passed}/${place.stages}`), cell(time));
    return row;
  });
  if (!rows.length) {
    const row = document.createElement("tr");
    row.className = "none";
    row.append(Object.assign(cell("nobody yet"), { colSpan: 4 }));
    rows.push(row);
  }
  body.replaceChildren(...rows);
}

/** Who flies now, in a sentence; empty if nobody. */
export function flying(vehicles) {
  return vehicles
    .filter(({ flight_s }) => flight_s != null)
    .map(({ team, vehicle, attempt, flight_s }) => `${team ?? vehicle}, ${attempt}: ${flight_s.toFixed(1)} s`)
    .join(" · ");
}
