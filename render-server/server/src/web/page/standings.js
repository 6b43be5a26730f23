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

/** Fills a node with the standings of signed grades: a table for each course and conditions. */
export function fillGrades(node, boards) {
  const parts = boards.flatMap(({ project, level, conditions, places }) => {
    const rows = places.map(({ rank, team, mean_stages_passed, stages, finished, flights, median_s }) => {
      const row = document.createElement("tr");
      if (rank === 1) row.className = "first";
      const time = median_s == null ? "–" : `${median_s.toFixed(2)} s`;
      row.append(cell(rank), cell(team), cell(`${mean_stages_passed.toFixed(2)}/${stages}`), cell(`${finished} of ${flights}`), cell(time));
      return row;
    });
    const title = Object.assign(document.createElement("h3"), { textContent: `graded: ${project} ${level}, ${conditions}` });
    const table = document.createElement("table"), heads = document.createElement("tr"), body = document.createElement("tbody");
    const head = (textContent) => Object.assign(document.createElement("th"), { textContent, scope: "col" });
    heads.append(...["place", "team", "stages", "finished", "time"].map(head));
    table.createTHead().append(heads);
    body.append(...rows);
    table.append(body);
    return [title, table];
  });
  node.replaceChildren(...parts);
}

/** Who flies now, in a sentence; empty if nobody. */
export function flying(vehicles) {
  return vehicles
    .filter(({ flight_s }) => flight_s != null)
    .map(({ team, vehicle, attempt, flight_s }) => `${team ?? vehicle}, ${attempt}: ${flight_s.toFixed(1)} s`)
    .join(" · ");
}
