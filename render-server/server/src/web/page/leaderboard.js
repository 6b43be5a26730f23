// The leaderboard's panel on the page: standings, who has checked in, and checking in.
import { order } from "/controls.js";
import { ask, fill, fillGrades } from "/standings.js";

const $ = (id) => document.getElementById(id);
let vehicle = null;

async function show() {
  const board = await ask().catch(() => null);
  $("leaderboard").hidden = !board;
  if (!board) return;
  fill($("official"), board.official);
  fill($("practice"), board.practice);
  fillGrades($("graded"), board.graded);
  const now = board.vehicles.find((flyer) => flyer.vehicle === vehicle);
  $("checked-in").textContent = now?.team ? `${now.team} flies: ${now.attempt}` : "nobody has checked in: flights have no place in the standings";
  $("check-out").hidden = !now?.team;
}

async function send(method, body) {
  if (vehicle == null) return;
  const answer = await order(method, `/api/vehicles/${encodeURIComponent(vehicle)}/team`, body);
  $("team-said").textContent = await answer.text();
  if (answer.ok) $("team-form").reset();
  show();
}

$("team-form").addEventListener("submit", (event) => {
  event.preventDefault();
  const form = new FormData(event.target);
  send("PUT", { token: form.get("token").trim(), attempt: form.get("attempt") });
});
$("check-out").addEventListener("click", () => send("DELETE"));

/** Shows the panel of the vehicle of this name; call when it changes and when a flight has ended. */
export function showLeaderboard(name) {
  vehicle = name;
  show();
}
