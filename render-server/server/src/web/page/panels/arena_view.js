// The arena panel: top view or 3D view, stages of the course, and a hint about missing inputs.

import { make, setText } from "../dom.js";
import { notePassed } from "../event_kinds.js";
import { extended, Fleet, movedOn, received } from "../fleet.js";
import { FlightRecording } from "../flight_recording.js";
import { chooseVehicle } from "../header.js";
import { showOutcome } from "../outcome.js";
import { ReplayBar } from "../replay_bar.js";
import { SpaceDrawing } from "../space_drawing.js";
import { theme } from "../theme.js";
import { TopView } from "../top_view.js";
import { VehicleTags } from "../vehicle_tags.js";

/** @typedef {import("../messages").Arena} Arena */
/** @typedef {import("../messages").State} State */

const top = make("canvas", { id: "map", role: "img", ariaLabel: "top view of the arena" });
const space = new SpaceDrawing();
const stages = make("ol", { id: "stages", ariaLabel: "stages of the course", hidden: true });
/** Selectable views: the top view, and the 3D view from several positions. @typedef {"top" | "space" | "chase" | "onboard"} View */
/** @type {View[]} */
const VIEWS = ["top", "space", "chase", "onboard"];
const buttons = VIEWS.map((view) => make("button", { id: `view-${view}`, type: "button", textContent: view }));
const fastest = make("span", { id: "speed-top", textContent: "m/s" });
const recording = new FlightRecording();
const replay = new ReplayBar(recording, (text) => showOutcome("warn", "No flight", text));
const hint = make("p", { id: "hint", className: "hint", hidden: true });
const fleet = new Fleet();
const tags = new VehicleTags(chooseVehicle);
const element = make("section", { className: "panel map", ariaLabel: "where it flies" },
  top, space.canvas, tags.element, stages,
  make("div", { className: "views", role: "group", ariaLabel: "view" }, ...buttons),
  make("div", { className: "legend" },
    make("span", { className: "speed" }, make("span", { textContent: "0" }), make("i"), fastest)),
  replay.element, space.note, hint,
);

const topView = new TopView(top);
/** @type {Arena | null} */
let arena = null;
/** @type {import("../fleet.js").ShownPose | null} */
let pose = null;
/** @type {State | null} */
let state = null;
/** Indices of the stages passed in this flight. @type {Set<number>} */
const passed = new Set();
let boot = "", flown = false;
/** Track of the replayed flight. @type {{ of: FlightRecording, track: import("../messages").Track["points"] } | null} */
let former = null;
/** @type {View} */
let view = "top";

/** Shows a view. @param {View} wanted */
async function pickView(wanted) {
  view = wanted;
  // Immediately, because opening the 3D view may take long on a busy computer.
  for (const [k, button] of buttons.entries()) button.ariaPressed = String(VIEWS[k] === view);
  if (view !== "top" && arena) await space.open(arena, theme(), view === "space" ? "free" : view);
  top.hidden = view !== "top";
  space.isHidden = view === "top";
  (view === "top" ? topView : space.view)?.resize();
}

/** Selects the last chosen view; by default the 3D view if a graphics card draws it, otherwise the top view. */
async function firstView() {
  const chosen = () => VIEWS.find((name) => name === localStorage.getItem("view"));
  const usual = chosen() ?? ((await space.hasCard()) ? "space" : "top");
  // Keep a view that was selected in the meantime.
  pickView(chosen() ?? usual);
}
for (const [k, button] of buttons.entries())
  button.addEventListener("click", () => {
    localStorage.setItem("view", VIEWS[k]);
    pickView(VIEWS[k]);
  });
firstView();

/** Stages whose lights are on: live, or at a replayed moment. */
let lit = passed;

/** Shows a light for each stage of the course: passed, next, or open. */
function showStages() {
  const course = arena?.stages ?? [];
  const next = course.findIndex((_, k) => !lit.has(k));
  stages.hidden = !course.length;
  stages.replaceChildren(
    ...course.map(({ name }, k) => {
      const status = lit.has(k) ? "passed" : k === next ? "next" : "to come";
      const light = make("li", { textContent: name, ariaLabel: `${name}: ${status}` });
      light.dataset.light = status;
      if (k === next) light.ariaCurrent = "step";
      return light;
    }),
  );
}

/** Shows a hint; hides it if the text is empty. @param {string} text */
export function showHint(text) {
  hint.hidden = !text;
  setText(hint, text);
}

/** @param {State} state */
function hintOf({ pose, runtime, landed }) {
  if (!pose) return "waiting for the first pose of the vehicle";
  return runtime || landed ? "" : `waiting for a runtime: vizflyt fly PLUGIN --vehicle ${arena?.vehicle} --server …`;
}

/** Returns the description of the flight that has just ended. @param {State} state */
function ended({ outcome }) {
  return { arena: arena?.name ?? "", vehicle: arena?.vehicle ?? "", outcome: outcome?.title ?? "landed", at: new Date().toISOString() };
}

/** Shows the vehicles' name tags. @param {Parameters<TopView["draw"]>[0]} shown */
function showTags({ pose, others, now_ms }) {
  const drawn = space.isHidden ? topView : space.view;
  const place = (/** @type {import("../fleet.js").ShownPose} */ pose) => drawn?.at(movedOn(pose, now_ms)) ?? null;
  const own = pose && view !== "onboard" ? [{ name: arena?.vehicle ?? "", phase: null, at: place(pose) }] : [];
  tags.show([...own, ...others.map(({ name, phase, pose }) => ({ name, phase, at: place(pose) }))]);
}

/** Returns the shown track: live, or of the replayed flight. */
function shownTrack() {
  if (replay.recording === recording) return topView.track;
  if (former?.of !== replay.recording) former = { of: replay.recording, track: replay.recording.track() };
  return former.track;
}

/** @type {import("../panels.js").Panel} */
export const arenaView = {
  element,
  onArena(newest) {
    arena = newest;
    passed.clear();
    if (arena.boot !== boot) {
      [boot, flown] = [arena.boot, false];
      recording.clear();
      replay.offer(false, null);
      replay.list(arena.name);
    }
    fleet.clear();
    tags.setVehicles(arena.vehicles, arena.vehicle);
    topView.setArena(arena);
    space.setArena(arena, theme());
    pickView(view);
    showStages();
    setText(fastest, `${Math.max(1, arena.max_speed_mps)} m/s`);
  },
  onTrack(points, vehicle) {
    if (vehicle === arena?.vehicle) topView.track = points;
    else fleet.setTrack(vehicle, points);
  },
  onEvents(entries) {
    notePassed(passed, entries);
    showStages();
  },
  onState(newest) {
    state = newest;
    if (state.flight_s == null && flown) {
      // A new flight on the same server.
      topView.track = [];
      passed.clear();
      recording.clear();
      showStages();
    }
    recording.add(state, passed);
    const hasEnded = flown && (state.landed || state.outcome != null);
    replay.offer(hasEnded || state.flight_s == null, hasEnded ? ended(state) : null);
    flown = state.flight_s != null;
    if (state.pose) {
      pose = received(state.pose, performance.now());
      topView.track = extended(topView.track, state.pose);
    }
    fleet.update(state.others, performance.now());
    showHint(hintOf(state));
  },
  onFrame(now_ms) {
    const moment = replay.moment(now_ms);
    const isOver = !moment || (replay.recording === recording && moment.flight_s >= recording.end_s);
    const shown = {
      now_ms,
      crashed: isOver && ["collided", "geofence"].includes(state?.outcome?.outcome ?? ""),
      pose: moment ? { ...moment.pose, age_s: 0, received_ms: now_ms } : pose,
      objects: (moment ?? state)?.objects ?? [],
      passed: moment?.passed ?? passed,
      track: shownTrack(),
      ghost: replay.ghostNow(),
      // A recording contains only one vehicle.
      others: moment ? [] : fleet.others,
    };
    if (shown.passed !== lit) {
      lit = shown.passed;
      showStages();
    }
    if (space.isHidden) topView.draw(shown);
    else space.draw(shown);
    showTags(shown);
  },
  onTheme() {
    topView.restyle();
    if (arena) space.setArena(arena, theme());
  },
};
