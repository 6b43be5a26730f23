// The wall: flying teams with images and map, and the standings, large. Polls every second; display only.

import { BestRun, ghostAt, readGhost } from "./best_run.js";
import { $, setText } from "./dom.js";
import { followTheme } from "./theme.js";
import { fetchLeaderboard, fillGrades, fillPlaces } from "./standings.js";
import { TopView } from "./top_view.js";
import { VehicleTags } from "./vehicle_tags.js";
import { WallFlight } from "./wall_flight.js";

/** @typedef {import("./messages").Leaderboard} Leaderboard */

const EVERY_MS = 1000;
const KEPT = "wall-ghost ";

const map = new TopView($("map", HTMLCanvasElement));
const tags = new VehicleTags(null);
$("map-room").append(tags.element);
/** Vehicles with a runtime, by name. @type {Map<string, WallFlight>} */
const flights = new Map();
let best = new BestRun(null), course = "", boot = "";

/** Watches only the vehicles with a runtime, because each watched vehicle costs the server images. */
async function follow() {
  const answer = await fetch("/api/vehicles");
  /** @type {import("./messages").VehicleLine[]} */
  const vehicles = answer.ok ? await answer.json() : [];
  const flown = vehicles.filter(({ runtime }) => runtime != null).map(({ name }) => name);
  for (const [name, flight] of flights)
    if (!flown.includes(name) || flight.hasEnded) {
      flight.close();
      flights.delete(name);
    }
  for (const name of flown)
    if (!flights.has(name)) {
      const flight = new WallFlight(name, (state) => best.watch(name, state.flight_s, state.pose.p_world_m));
      flights.set(name, flight);
      $("pictures").append(flight.element);
    }
  $("live").hidden = !flights.size;
}

/** @param {Leaderboard} board */
function showBoard(board) {
  if (board.course !== course) {
    course = board.course;
    best = new BestRun(readGhost(localStorage.getItem(KEPT + course)));
  }
  if (best.take(board)) localStorage.setItem(KEPT + course, JSON.stringify(best.ghost));
  $("course").textContent = course;
  document.title = `${course} – VizFlyt leaderboard`;
  fillPlaces($("official"), board.official);
  fillPlaces($("practice"), board.practice);
  fillGrades($("graded"), board.graded);
  $("graded-panel").hidden = !board.graded.length;
  for (const flyer of board.vehicles) flights.get(flyer.vehicle)?.showTeam(flyer);
  setText($("ghost"), best.ghost ? `ghost: the best official run, ${best.ghost.team}` : "");
}

async function refresh() {
  try {
    await follow();
    const board = await fetchLeaderboard();
    $("announcement").textContent = board ? "" : "no standings: are runs kept here, and are you logged in?";
    if (board) showBoard(board);
  } catch {
    $("announcement").textContent = "the server cannot be reached";
  }
  setTimeout(refresh, EVERY_MS);
}

/** Draws the map with all flying vehicles. @param {number} now_ms */
function paint(now_ms) {
  requestAnimationFrame(paint);
  const [first, ...rest] = [...flights.values()].filter(({ arena }) => arena);
  if (!first?.arena || !first.state) return;
  if (first.arena.boot !== boot) {
    ({ boot } = first.arena);
    map.setArena(first.arena);
    tags.setVehicles(first.arena.vehicles, "");
  }
  const others = rest.flatMap(({ name, pose, track }) => (pose ? [{ name, phase: "", pose, track }] : []));
  const { flight_s, objects } = first.state;
  const ghost = best.ghost && flight_s != null ? ghostAt(best.ghost, flight_s) : null;
  map.draw({
    now_ms, objects, others, pose: first.pose, track: first.track, passed: first.passed, crashed: false,
    ghost: ghost && { pose: { p_world_m: ghost.p_world_m }, track: ghost.way.map(([, x, y, z]) => [x, y, z, 0]) },
  });
  const drawn = [...flights.values()].flatMap(({ name, pose }) => (pose ? [{ name, phase: null, at: map.at(pose.p_world_m) }] : []));
  tags.show(drawn);
  for (const flight of flights.values()) flight.showClock();
}

followTheme(() => map.restyle());
refresh();
requestAnimationFrame(paint);
