// The panel of `vizflyt scene align`: clicks give points of the scene, points give its placement, and the placement is
// saved. The server finds points and solves; only the page stores the clicks.

import { Drawing, drawRoom } from "/overlay.js";
import { view } from "/view.js";

const FLOOR = "#7df09a", LENGTH = "#ffd166", ABOVE = "#b9c7ff";

/** Clicked points: {p_scene, rough_m}, and the camera of the click in the frame of the scene's file. */
const picks = { floor: [], above: null, ends: [null, null] };
const settings = { metres: "", originAt: [0, 0, 0], yaw: 0 };
/** Meaning of the next click: {kind: "floor" | "above" | "end" | "start", index}. */
let wanted = { kind: "floor", index: null };
let setup = null, room = null, place = null, solved = null, shown = null;
let problem = "", report = null, solves = 0, busy = false;

// ---- places ----------------------------------------------------------------------------------
const turn = ([x, y, z, w], [a, b, c]) => {
  const [i, j, k] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
  return [a + w * i + y * k - z * j, b + w * j + z * i - x * k, c + w * k + x * j - y * i];
};
const back = ([x, y, z, w], p) => turn([-x, -y, -z, w], p);
const toWorld = (at, p) => turn(at.rotation, p).map((value, k) => value * at.metres_per_unit + at.origin[k]);
const toScene = (at, p) => back(at.rotation, p.map((value, k) => value - at.origin[k])).map((value) => value / at.metres_per_unit);

/** Shows the scene at another placement: the camera keeps its position in the scene, and is levelled. */
function show(next) {
  const { eye } = view;
  const ahead = [Math.cos(eye.yaw) * Math.cos(eye.pitch), Math.sin(eye.yaw) * Math.cos(eye.pitch), Math.sin(eye.pitch)];
  const [x, y, z] = turn(next.rotation, back(place.rotation, ahead));
  eye.p = toWorld(next, toScene(place, eye.p));
  eye.yaw = Math.atan2(y, x);
  eye.pitch = Math.asin(Math.min(1, Math.max(-1, z)));
  place = next;
  view.extra.place = next;
  view.changed(false);
}

// ---- the server ------------------------------------------------------------------------------
/** @returns the server's answer; throws its text if it rejects the order. */
async function order(path, body) {
  const answer = await fetch(path, { method: "POST", body: JSON.stringify(body) });
  const text = await answer.text();
  if (!answer.ok) throw new Error(text || `the server answers ${answer.status}`);
  return JSON.parse(text);
}

const roughness = (all) => Math.hypot(...all.map((pick) => pick.rough_m)) / Math.sqrt(all.length);
const rooms = () => ({
  floor: picks.floor.map((pick) => pick.p_scene),
  above: picks.above?.p_scene ?? picks.floor.at(-1).eye_scene,
  length: picks.ends.every(Boolean) && +settings.metres > 0
    ? { ends: picks.ends.map((pick) => pick.p_scene), metres: +settings.metres }
    : null,
  origin_at_m: settings.originAt,
  yaw_deg: settings.yaw,
  geofence: room.geofence,
  rough_m: roughness([...picks.floor, ...picks.ends].filter(Boolean)),
});

async function solve() {
  const mine = ++solves;
  [report, problem] = [null, ""];
  if (picks.floor.length < 3) {
    solved = null;
    show(setup.place);
    return draw();
  }
  try {
    const found = await order("/api/align/solve", rooms());
    if (mine !== solves) return; // The picks have changed in the meantime.
    solved = found;
    show(found.place);
  } catch (error) {
    if (mine !== solves) return;
    [solved, problem] = [null, error.message];
  }
  draw();
}

async function click(x, y) {
  if (!wanted || !shown || busy) return;
  const { kind, index } = wanted;
  busy = true;
  draw();
  const side = (length) => Math.max(16, Math.round((length * view.canvas.width) / innerWidth));
  const request = { ...shown.request, grid: false, width_px: side(innerWidth), height_px: side(innerHeight) };
  const at = place;
  try {
    const px = [(x / innerWidth) * request.width_px, (y / innerHeight) * request.height_px];
    const { p_scene, p_world, rough_m } = await order("/api/align/pick", { request, px });
    take(kind, index, { p_scene, rough_m, eye_scene: toScene(request.place ?? at, request.p_m) }, p_world);
  } catch (error) {
    problem = error.message;
  }
  busy = false;
  draw();
}

function take(kind, index, pick, p_world) {
  problem = "";
  if (kind === "floor") {
    if (index == null) picks.floor.push(pick);
    else {
      picks.floor[index] = pick;
      want(null);
    }
  } else if (kind === "above") {
    picks.above = pick;
    want(null);
  } else if (kind === "end") {
    picks.ends[index] = pick;
    want(index === 0 && !picks.ends[1] ? { kind: "end", index: 1 } : null);
    if (!wanted && !(+settings.metres > 0)) requestAnimationFrame(() => document.getElementById("metres")?.focus());
  } else {
    room.spawn = { position_m: p_world.map((value) => Math.round(value * 100) / 100), yaw_deg: Math.round((view.eye.yaw * 180) / Math.PI) };
    want(null);
    return;
  }
  solve();
}

function want(next) {
  wanted = next;
  document.body.toggleAttribute("data-picking", next !== null);
}

async function save(force) {
  [problem, report] = ["", null];
  try {
    report = await order("/api/align/save", { picks: rooms(), spawn: room.spawn, force });
  } catch (error) {
    problem = error.message;
  }
  draw();
}

/** Moves fence and start with the scene, from the placement in the arena's file to the current one. */
function carry() {
  const move = (p) => toWorld(place, toScene(setup.place, p));
  const { min_m: min, max_m: max } = setup.geofence;
  const corners = Array.from({ length: 8 }, (_, k) => move([0, 1, 2].map((axis) => ((k >> axis) & 1 ? max : min)[axis])));
  const round = (value) => Math.round(value * 10) / 10;
  const over = (pick) => [0, 1, 2].map((axis) => round(pick(...corners.map((corner) => corner[axis]))));
  room.geofence = { min_m: over(Math.min), max_m: over(Math.max) };
  const [x, y] = move(setup.spawn.position_m).map((value) => Math.round(value * 100) / 100);
  const yaw = (setup.spawn.yaw_deg * Math.PI) / 180;
  const [c, s] = turn(place.rotation, back(setup.place.rotation, [Math.cos(yaw), Math.sin(yaw), 0]));
  room.spawn = { position_m: [x, y, 0], yaw_deg: Math.round((Math.atan2(s, c) * 180) / Math.PI) };
  solve();
}

// ---- the panel -------------------------------------------------------------------------------
function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}
const button = (textContent, onclick, properties = {}) => make("button", { type: "button", textContent, onclick, ...properties });

/** Returns a button that makes the next click a point; pressing it again cancels. */
function picker(text, next, title) {
  const isOn = wanted?.kind === next.kind && wanted.index === next.index;
  const element = button(text, () => {
    want(isOn ? null : next);
    problem = "";
    draw();
  }, { title });
  element.setAttribute("aria-pressed", isOn);
  return element;
}

function number(value, set, label, step = 0.1) {
  const input = make("input", { type: "number", step: String(step), value: String(value) });
  input.setAttribute("aria-label", label);
  input.onchange = () => {
    if (input.value !== "" && Number.isFinite(+input.value)) set(+input.value);
    solve();
  };
  return input;
}

const HINTS = {
  floor: (index) => index != null
    ? `click where point ${index + 1} should be`
    : picks.floor.length < 3
      ? `click points of the floor, far apart: ${picks.floor.length} of at least 3`
      : `${picks.floor.length} points; a fourth and more show how level the floor is. Then measure a length`,
  above: () => "click something that stands above the floor",
  end: (index) => `click ${index === 0 ? "one end" : "the other end"} of a length that you have measured`,
  start: () => "click the floor where flights begin; the vehicle looks the way you do",
};

function floorList() {
  // Three points always fit a plane, so their error is zero.
  const off_cm = (pick) => Math.round((toWorld(place, pick.p_scene)[2] - settings.originAt[2]) * 1000) / 10 + 0;
  const off = (pick) => (solved && picks.floor.length > 3 ? `${off_cm(pick).toFixed(1)} cm` : `± ${(pick.rough_m * 1000).toFixed(0)} mm`);
  const items = picks.floor.map((pick, k) => make("li", {},
    make("b", { textContent: String(k + 1) }),
    make("span", { textContent: `${off(pick)}${k === 0 ? " · origin" : k === 1 ? " · x axis" : ""}` }),
    k === 0 ? "" : button(k === 1 ? "origin" : "x axis", () => {
      const [moved] = picks.floor.splice(k, 1);
      picks.floor.splice(k === 1 ? 0 : 1, 0, moved);
      solve();
    }, { title: k === 1 ? "swaps origin and x axis" : "the x axis goes from point 1 through this one" }),
    picker("again", { kind: "floor", index: k }, "the next click takes its place"),
    button("×", () => {
      picks.floor.splice(k, 1);
      if (picks.floor.length < 3) want({ kind: "floor", index: null });
      solve();
    }, { title: `removes point ${k + 1}` })));
  return make("ul", { id: "floor-points" }, ...items);
}

function lengthRow() {
  const metres = number(settings.metres, (value) => (settings.metres = value), "its length in metres", 0.01);
  metres.id = "metres";
  const name = (k) => `${picks.ends[k] ? "✓ " : ""}${k === 0 ? "one end" : "other end"}`;
  return make("div", { className: "row" }, picker(name(0), { kind: "end", index: 0 }), picker(name(1), { kind: "end", index: 1 }), metres, "m");
}

function roomRows() {
  const axes = ["x", "y", "z"];
  const corner = (name, key) => make("div", { className: "row" }, make("span", { textContent: name }),
    ...axes.map((axis, k) => number(room.geofence[key][k], (value) => (room.geofence[key][k] = value), `fence ${name} ${axis} in metres`)));
  const { position_m: p } = room.spawn;
  const turned = (by) => () => {
    settings.yaw = ((settings.yaw + by + 540) % 360) - 180;
    solve();
  };
  return [
    make("div", { className: "row" }, make("span", { textContent: "x axis" }), button("↶ 90°", turned(90)), button("↷ 90°", turned(-90)),
      number(settings.yaw, (value) => (settings.yaw = value), "heading of points 1 to 2 in degrees", 1), "°"),
    make("div", { className: "row" }, make("span", { textContent: "point 1 is" }),
      ...axes.map((axis, k) => number(settings.originAt[k], (value) => (settings.originAt[k] = value), `${axis} of point 1 in metres`))),
    make("h2", {}, "Fence and net [m]", button("carry along", carry, { title: "fence and start stay about the same part of the scene" })),
    corner("from", "min_m"),
    corner("to", "max_m"),
    make("h2", {}, "Start", picker("click it", { kind: "start", index: null })),
    make("div", { className: "row" }, ...axes.map((axis, k) => number(p[k], (value) => (p[k] = value), `start ${axis} in metres`)),
      number(room.spawn.yaw_deg, (value) => (room.spawn.yaw_deg = value), "heading of the start in degrees", 5), "°"),
  ];
}

function resultRows() {
  const rows = [];
  const end = make("div", { className: "end" });
  if (solved) {
    const words = { true: "GO", false: "NO GO", null: "size not known yet" };
    const verdict = make("div", { className: "verdict", id: "verdict", textContent: words[String(solved.go)] });
    verdict.dataset.go = String(solved.go);
    const line = ({ key, text }) => make("tr", {}, make("th", { textContent: key }), make("td", { textContent: text }));
    rows.push(make("h2", {}, "Result"), make("table", { id: "result" }, ...solved.lines.map(line)));
    end.append(verdict);
  }
  end.append(button("save into arena.toml", () => save(false), { className: "main", id: "save", disabled: solved?.go == null }));
  if (solved?.go === false) end.append(button("save anyway", () => save(true), { id: "force" }));
  if (report) end.append(make("p", { id: "saved" }, report.map(({ key, text }) => `${key} ${text}`).join(" · ")));
  return [...rows, end];
}

const panel = make("aside", { id: "align", className: "panel" });
panel.setAttribute("aria-label", "align the scene with the room");

function draw() {
  const focus = document.activeElement?.getAttribute("aria-label");
  const scrolled = panel.scrollTop;
  const hint = !shown ? "the scene is being drawn …" : busy ? "looking …" : wanted ? HINTS[wanted.kind](wanted.index) : "fly and look: is the floor level, do the walls stand where they should?";
  panel.replaceChildren(
    make("p", { className: "hint", id: "hint", textContent: hint }),
    ...(problem ? [make("p", { className: "wrong", id: "problem", textContent: problem })] : []),
    make("h2", {}, "Floor", picker("add points", { kind: "floor", index: null })),
    floorList(),
    make("h2", {}, "Up", picker("click above", { kind: "above", index: null })),
    make("div", { className: "row" },
      make("span", { textContent: picks.above ? "the point ↑ is above the floor" : "where you look from is above the floor" }),
      ...(picks.above ? [button("×", () => {
        picks.above = null;
        solve();
      }, { title: "forgets it" })] : [])),
    make("h2", {}, "Known length"),
    lengthRow(),
    ...(solved ? [make("h2", {}, "Motion capture's frame"), ...roomRows()] : []),
    ...resultRows(),
  );
  panel.scrollTop = scrolled;
  if (focus) [...panel.querySelectorAll("input")].find((input) => input.getAttribute("aria-label") === focus)?.focus();
  drawOverlay();
}

// ---- overlay ---------------------------------------------------------------------------------
const overlay = make("canvas", { id: "overlay" });
const context = overlay.getContext("2d");

function drawOverlay() {
  if (!shown || !room) return;
  const ratio = Math.min(devicePixelRatio || 1, 2);
  const [width, height] = [innerWidth, innerHeight];
  if (overlay.width !== Math.round(width * ratio) || overlay.height !== Math.round(height * ratio))
    [overlay.width, overlay.height] = [Math.round(width * ratio), Math.round(height * ratio)];
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  const drawing = new Drawing(context, width, height, shown.request, shown.info.grid);
  const at = shown.request.place ?? place;
  if (solved) drawRoom(drawing, room);
  const ends = picks.ends.map((pick) => pick && toWorld(at, pick.p_scene));
  if (ends.every(Boolean)) {
    drawing.line(ends, { color: LENGTH, width: 2.5, hidden: 0.5 });
    const middle = ends[0].map((value, k) => (value + ends[1][k]) / 2);
    if (+settings.metres > 0) drawing.label(middle, `${settings.metres} m`, LENGTH);
  }
  for (const [k, end] of ends.entries()) if (end) drawing.marker(end, "AB"[k], LENGTH);
  for (const [k, pick] of picks.floor.entries()) drawing.marker(toWorld(at, pick.p_scene), String(k + 1), FLOOR);
  if (picks.above) drawing.marker(toWorld(at, picks.above.p_scene), "↑", ABOVE);
}

view.listeners.push((request, info) => {
  const isFirst = !shown;
  shown = { request, info };
  if (isFirst && setup) draw(); // Enables clicks.
  drawOverlay();
});

// A click moves by at most a few pixels; larger motion turns the camera.
let down = null;
view.canvas.addEventListener("pointerdown", (event) => {
  down = event.isPrimary && event.button === 0 ? [event.clientX, event.clientY] : null;
});
view.canvas.addEventListener("pointerup", (event) => {
  if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 5) click(event.clientX, event.clientY);
  down = null;
});
addEventListener("keydown", (event) => {
  if (event.code !== "Escape" || !wanted) return;
  want(null);
  draw();
});

document.head.append(make("link", { rel: "stylesheet", href: "/panel.css" }));
view.canvas.after(overlay);
document.body.append(panel);
setup = await (await fetch("/api/align")).json();
room = structuredClone(setup);
place = setup.place;
view.extra.grid = true;
view.extra.place = place;
want(wanted);
view.changed(false);
draw();
