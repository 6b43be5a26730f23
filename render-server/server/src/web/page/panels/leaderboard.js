// The leaderboard: standings, checked-in teams, and check-in.

import { make, makeButton, makeFoldingPanel } from "../dom.js";
import { send, vehicleUrl } from "../session.js";
import { fetchLeaderboard, fillGrades, fillPlaces } from "../standings.js";

const checkedIn = make("span", { id: "checked-in" });
const checkOut = makeButton("check out", { id: "check-out", hidden: true });
const token = make("input", { name: "token", type: "password", required: true });
const attempt = make("select", { name: "attempt" }, ...["practice", "official"].map((name) => new Option(name, name)));
const status = make("span", { id: "team-status", role: "status" });
const form = make("form", { id: "team-form", autocomplete: "off" },
  make("label", {}, "token ", token), make("label", {}, "as ", attempt),
  make("button", { type: "submit", textContent: "check in" }), " ", status);
const official = make("tbody", { id: "official" }), practice = make("tbody", { id: "practice" }), graded = make("div", { id: "graded" });
const element = makeFoldingPanel("leaderboard", "leaderboard: who leads, who flies",
  make("div", { className: "board" },
    make("p", {}, checkedIn, " ", checkOut), form,
    make("h2", { textContent: "official" }), make("table", {}, official),
    make("h2", { textContent: "practice" }), make("table", {}, practice),
    graded,
    make("p", {}, make("a", { href: "/wall", target: "_blank", rel: "noopener", textContent: "wall view" }))));
element.hidden = true;

let vehicle = "", decided = "";

async function refresh() {
  const board = await fetchLeaderboard().catch(() => null);
  element.hidden = !board;
  if (!board) return;
  fillPlaces(official, board.official);
  fillPlaces(practice, board.practice);
  fillGrades(graded, board.graded);
  const team = board.vehicles.find((flyer) => flyer.vehicle === vehicle);
  checkedIn.textContent = team?.team ? `${team.team} flies: ${team.attempt}` : "no team has checked in: flights are not ranked";
  checkOut.hidden = !team?.team;
}

/**
 * @param {"PUT" | "DELETE"} method
 * @param {object} [body]
 */
async function change(method, body) {
  if (!vehicle) return;
  const { ok, text } = await send(method, `${vehicleUrl(vehicle)}/team`, body);
  status.textContent = text;
  if (ok) form.reset();
  refresh();
}
form.addEventListener("submit", (event) => {
  event.preventDefault();
  change("PUT", { token: token.value.trim(), attempt: attempt.value });
});
checkOut.addEventListener("click", () => change("DELETE"));

/** @type {import("../panels.js").Panel} */
export const leaderboard = {
  element,
  onArena(arena) {
    ({ vehicle } = arena);
  },
  onState({ outcome, landed }) {
    // Refresh if the vehicle has changed, a flight is decided, or it has landed.
    const now = `${vehicle} ${outcome?.at_s} ${outcome?.text} ${landed}`;
    if (now !== decided) refresh();
    decided = now;
  },
};
