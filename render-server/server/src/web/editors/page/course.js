// The panel of `vizflyt arena edit`: start, goal, fence, stages and moving objects are dragged in the image. The server
// shows and checks every change, and writes the file. Only the page stores the course and its undo history.

import * as items from "/course_items.js";
import { Drawing, drawRoom } from "/overlay.js";
import { view } from "/view.js";

const COLOURS = ["orange", "blue", "green", "white"];
const ADDS = { gate: "gate", box: "keep-out box", pillar: "pillar", drone: "moving drone", goal: "goal" };
const GRAB_PX = 16;

let course = null, report = null, shown = null, saved = "";
let selected = null; // Key of an item.
let past = [], future = []; // Courses as text.
let held = null; // Dragged handle: {item, handle}.
let problem = "", looking = false, stale = false;

// ---- the server ------------------------------------------------------------------------------
async function order(what) {
  const answer = await fetch("/api/course", { method: "POST", body: JSON.stringify(what) });
  const text = await answer.text();
  if (!answer.ok) throw new Error(text || `the server answers ${answer.status}`);
  return JSON.parse(text);
}

/** Shows and checks the current course; while the server is busy, only the newest state waits. */
async function look(what = "look") {
  stale = true;
  if (looking) return;
  looking = true;
  while (stale) {
    stale = false;
    draw();
    try {
      report = await order({ [what]: course });
      problem = "";
      if (what === "save" && report.said.length) saved = JSON.stringify(course);
      what = "look";
      view.changed(false);
    } catch (error) {
      problem = error instanceof TypeError ? "connection lost; restart the server, and reload this page" : error.message;
    }
  }
  looking = false;
  draw();
}

// ---- changes ---------------------------------------------------------------------------------
/** Applies a change to the course, with undo. */
function change(act) {
  past.push(JSON.stringify(course));
  future = [];
  act();
  if (past.at(-1) === JSON.stringify(course)) past.pop();
  look();
}

function travel(from, to) {
  if (!from.length) return;
  to.push(JSON.stringify(course));
  course = JSON.parse(from.pop());
  if (!chosen()) selected = null;
  look();
}

const chosen = () => items.items(course).find((item) => item.key === selected) ?? null;

function select(key) {
  selected = key;
  draw();
}

/** Selects an item of the list; turns the camera to it if it is not visible. */
function selectAndFace(key) {
  select(key);
  const item = chosen();
  const at = item && items.centre(course, item);
  const place = at && shown && drawing().place(at);
  if (!at || (place && place.at[0] > 40 && place.at[0] < innerWidth - 400 && place.at[1] > 40 && place.at[1] < innerHeight - 40)) return;
  const way = at.map((value, k) => value - view.eye.p[k]);
  view.eye.yaw = Math.atan2(way[1], way[0]);
  view.eye.pitch = Math.max(-1.2, Math.min(1.2, Math.atan2(way[2], Math.hypot(way[0], way[1]))));
  view.changed(false);
}

function add(kind) {
  const { eye } = view;
  const ahead = Math.min(shown?.info.middle_m ?? 3, 3);
  const at = [0, 1].map((k) => {
    const p = eye.p[k] + [Math.cos(eye.yaw), Math.sin(eye.yaw)][k] * ahead;
    return Math.min(course.geofence.max_m[k] - 0.8, Math.max(course.geofence.min_m[k] + 0.8, p));
  });
  change(() => (selected = items.add(course, kind, at, eye.yaw, report.floor_z_m)));
}

function remove() {
  const item = chosen();
  if (!item || item.kind === "start" || item.kind === "fence") return;
  change(() => items.remove(course, item));
  select(null);
}

// ---- the panel -------------------------------------------------------------------------------
function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}
const button = (textContent, onclick, properties = {}) => make("button", { type: "button", textContent, onclick, ...properties });
const row = (name, ...children) => make("div", { className: "row" }, make("span", { textContent: name }), ...children);

function number(label, value, set, step = 0.05) {
  const input = make("input", { type: "number", step: String(step), value: String(Math.round(value * 1000) / 1000), ariaLabel: label });
  input.onchange = () => {
    if (input.value !== "" && Number.isFinite(+input.value)) change(() => set(+input.value));
  };
  return input;
}
const vector = (label, value, set = (k, to) => (value[k] = to), axes = "xyz") =>
  [...axes].map((axis, k) => number(`${label} ${axis}`, value[k], (to) => set(k, to)));

function choice(label, options, value, set) {
  const element = make("select", { ariaLabel: label }, ...options.map((name) => make("option", { value: name, textContent: name, selected: name === value })));
  element.onchange = () => change(() => set(element.value));
  return element;
}

function fields(item) {
  const it = items.part(course, item);
  const rows = [];
  if ("name" in it) {
    const input = make("input", { type: "text", value: it.name, maxLength: 32, ariaLabel: "name", className: "name" });
    input.onchange = () => input.value.trim() && change(() => items.rename(course, item, input.value.trim()));
    rows.push(row("name", input));
  }
  if (it.min_m) rows.push(row("from [m]", ...vector("from", it.min_m)), row("to [m]", ...vector("to", it.max_m)));
  if (item.kind === "gate") {
    const settle = () => items.settle(course, it);
    const frame = items.frameOf(course, it);
    rows.push(
      row("middle [m]", ...vector("middle", it.center_m, (k, to) => { it.center_m[k] = to; settle(); })),
      row("opening [m]", number("width", it.width_m, (to) => { it.width_m = to; settle(); }), number("height", it.height_m, (to) => { it.height_m = to; settle(); })),
      row("through [°]", number("heading", items.yawOfGate(it), (to) => { items.setYaw(it, to); settle(); }, 15)),
      row("frame", choice("frame", ["none", ...COLOURS], frame ? frame.scene.match(/-([a-z]+)\.ply$/)?.[1] ?? "orange" : "none", (to) => items.setFrame(course, it, to === "none" ? null : to))),
    );
    const move = (by) => () => change(() => {
      course.stages.splice(item.index, 1);
      course.stages.splice(item.index + by, 0, it);
      selected = `stages[${item.index + by}]`;
    });
    rows.push(row("order", button("earlier", move(-1), { disabled: item.index === 0 }), button("later", move(1), { disabled: item.index === course.stages.length - 1 })));
  }
  if (it.position_m) rows.push(row("place [m]", ...vector("place", it.position_m)));
  if ("yaw_deg" in it) rows.push(row("heading [°]", number("heading", it.yaw_deg, (to) => (it.yaw_deg = to), 15)));
  if (item.kind === "goal") rows.push(row("radius [m]", number("radius", it.radius_m, (to) => (it.radius_m = to))));
  if (item.kind === "start") rows.push(row("climbs to [m]", number("climb", course.takeoff_height_m, (to) => (course.takeoff_height_m = to))));
  if (item.kind === "object") rows.push(row("splats", make("code", { textContent: it.scene })), ...motion(it));
  return rows;
}

const MOTIONS = {
  none: undefined,
  rotation: { kind: "rotation", axis: [0, 0, 1], period_s: 6 },
  oscillation: { kind: "oscillation", slide_m: [0, 0.8, 0], period_s: 6 },
  path: { kind: "path", points_m: [[0, -0.8, 0], [0, 0.8, 0]], speed_mps: 0.6, closed: false },
};

function motion(it) {
  const kind = it.motion?.kind ?? "none", move = it.motion;
  const rows = [row("moves", choice("motion", Object.keys(MOTIONS), kind, (to) => {
    if (to === "none") delete it.motion;
    else it.motion = structuredClone(MOTIONS[to]);
  }))];
  if (move?.axis && kind === "rotation") rows.push(row("axis", ...vector("axis", move.axis)));
  if (kind === "oscillation" && move.slide_m) rows.push(row("slides [m]", ...vector("slide", move.slide_m)));
  if (move?.period_s) rows.push(row("period [s]", number("period", move.period_s, (to) => (move.period_s = to), 0.5)));
  if (kind === "path")
    rows.push(
      row("speed [m/s]", number("speed", move.speed_mps, (to) => (move.speed_mps = to), 0.1)),
      row("points", button("add", () => change(() => move.points_m.push(move.points_m.at(-1).map((v, k) => (k ? v : v + 0.5))))),
        button("remove", () => change(() => move.points_m.pop()), { disabled: move.points_m.length < 3 })),
    );
  return rows;
}

function verdict() {
  if (problem) return make("p", { className: "wrong", id: "course-problem", textContent: problem });
  if (looking) return make("div", { className: "verdict", id: "course-verdict", textContent: "looking …" });
  const { findings, way_m, least_room_m } = report;
  const count = course.stages.length;
  const room = least_room_m == null ? "" : ` · ${least_room_m.toFixed(2)} m of room in the narrowest`;
  const text = findings.length ? `cannot be flown: ${findings.length} found` : `can be flown: ${count} ${count === 1 ? "gate" : "gates"}, a way of ${way_m.toFixed(1)} m${room}`;
  const element = make("div", { className: "verdict", id: "course-verdict", textContent: text });
  element.dataset.go = String(!findings.length);
  return element;
}

function findings() {
  const line = ({ key, text }) => {
    const item = items.items(course).find((item) => key.startsWith(item.key));
    return make("li", {}, button(item?.name ?? key, () => item && selectAndFace(item.key), { disabled: !item }), make("span", { textContent: text }));
  };
  return make("ul", { id: "course-findings" }, ...(report.findings ?? []).map(line));
}

const panel = make("aside", { id: "course", className: "panel", ariaLabel: "set up the course" });

function draw() {
  if (!course || !report) return;
  const focus = document.activeElement?.ariaLabel, scrolled = panel.scrollTop, item = chosen();
  const isSaved = saved === JSON.stringify(course);
  const list = items.items(course).map((one) => {
    const element = button(one.name, () => (one.key === selected ? select(null) : selectAndFace(one.key)), { className: one.kind });
    element.setAttribute("aria-pressed", String(one.key === selected));
    return make("li", {}, element);
  });
  panel.replaceChildren(
    make("p", { className: "hint", textContent: item
      ? "drag its handles; with Shift up and down, with Ctrl without steps. Delete removes it"
      : "click a thing in the picture or here; drag what is empty to look around" }),
    make("h2", { textContent: "Add" }),
    make("div", { className: "row" }, ...Object.entries(ADDS).map(([kind, name]) => button(name, () => add(kind), { disabled: kind === "goal" && !!course.goal }))),
    make("h2", {}, "Course", make("span", {}, button("undo", () => travel(past, future), { disabled: !past.length, id: "course-undo" }), " ",
      button("redo", () => travel(future, past), { disabled: !future.length, id: "course-redo" }))),
    make("ul", { id: "course-items" }, ...list),
    ...(item ? [make("h2", {}, item.name, item.kind === "start" || item.kind === "fence" ? "" : button("remove", remove)), ...fields(item)] : []),
    findings(),
    make("div", { className: "end" }, verdict(), button("save into arena.toml", () => look("save"), { className: "main", id: "course-save", disabled: isSaved || looking }),
      make("p", { id: "course-saved", textContent: isSaved && report.said.length ? report.said.map(({ key, text }) => `${key} ${text}`).join(" · ") : "" })),
  );
  panel.scrollTop = scrolled;
  if (focus) [...panel.querySelectorAll("input, select")].find((input) => input.ariaLabel === focus)?.focus();
  drawOverlay();
}

// ---- overlay ---------------------------------------------------------------------------------
const overlay = make("canvas", { id: "overlay" });
const context = overlay.getContext("2d");

function drawing() {
  return new Drawing(context, innerWidth, innerHeight, shown.request, shown.info.grid);
}

function drawOverlay() {
  if (!shown || !course) return;
  const ratio = Math.min(devicePixelRatio || 1, 2);
  const size = [innerWidth, innerHeight].map((side) => Math.round(side * ratio));
  if (overlay.width !== size[0] || overlay.height !== size[1]) [overlay.width, overlay.height] = size;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, innerWidth, innerHeight);
  const picture = drawing();
  drawRoom(picture, { ...course, body_radius_m: report.body_radius_m });
  for (const box of course.no_fly) picture.box(box.min_m, box.max_m, { color: "#ff6b5e", width: 2 }, box.name);
  if (course.goal) picture.ball(course.goal.position_m, course.goal.radius_m, "#7df09a", "goal");
  for (const object of course.objects)
    if (object.motion?.kind === "path") {
      const points = object.motion.points_m.map((p) => items.toWorld(object, p));
      picture.line(object.motion.closed ? [...points, points[0]] : points, { color: "#b9c7ff", width: 2 });
    }
  const item = chosen();
  for (const one of items.items(course)) {
    if (one.kind === "object") picture.label(items.centre(course, one), one.name, "#b9c7ff");
    if (one.key !== item?.key) dot(picture, items.centre(course, one), 4, "rgb(255 255 255 / .55)");
  }
  if (item) for (const handle of items.handles(course, item)) dot(picture, handle.at, handle.id === "move" ? 9 : 7, handle.id === "turn" ? "#ffd166" : "#ffffff");
}

function dot(picture, point, radius, color) {
  const place = picture.place(point);
  if (!place) return;
  context.beginPath();
  context.arc(...place.at, radius, 0, 7);
  Object.assign(context, { fillStyle: color, strokeStyle: "rgb(0 0 0 / .8)", lineWidth: 2 });
  context.fill();
  context.stroke();
}

view.listeners.push((request, info) => {
  shown = { request, info };
  drawOverlay();
});

// ---- the pointer -----------------------------------------------------------------------------
/** Returns the item of a list under the pointer. */
function nearest(list, place, event) {
  const picture = drawing();
  const away = (one) => {
    const seen = picture.place(place(one));
    return seen ? Math.hypot(seen.at[0] - event.clientX, seen.at[1] - event.clientY) : Infinity;
  };
  const [best] = list.map((one) => [away(one), one]).sort((a, b) => a[0] - b[0]);
  return best && best[0] < GRAB_PX ? best[1] : null;
}

/** Returns the point of the surface under the pointer. */
function surface(at) {
  const { request, info: { grid } } = shown;
  const cell = [at.clientX / innerWidth, at.clientY / innerHeight].map((share, k) => Math.floor((share * [request.width_px, request.height_px][k]) / grid.cell_px));
  const depth = grid.depth_mm[cell[1] * grid.columns + cell[0]] / 1000;
  if (!(depth > 0)) return null;
  const { from, way } = pointed(at);
  return from.map((value, k) => value + way[k] * depth);
}
const pointed = (at) => items.ray(shown.request, [at.clientX / innerWidth - 0.5, at.clientY / innerHeight - 0.5]);

// Before the handlers of the view, which turn the camera.
const take = (type, handle) => view.canvas.addEventListener(type, (event) => {
  if (course && shown && handle(event)) event.stopImmediatePropagation();
}, { capture: true });

take("pointerdown", (event) => {
  if (!event.isPrimary || event.button !== 0) return false;
  const item = chosen();
  const handle = item && nearest(items.handles(course, item), (one) => one.at, event);
  const other = handle ? null : nearest(items.items(course), (one) => items.centre(course, one), event);
  if (other) select(other.key);
  if (!handle && !other) return false;
  const grabbed = handle ?? { id: "move", at: items.centre(course, other) };
  held = other?.kind === "fence" ? null : { item: other ?? item, handle: grabbed, before: JSON.stringify(course) };
  if (held) view.canvas.setPointerCapture(event.pointerId);
  return true;
});
take("pointermove", (event) => {
  if (!held || !event.isPrimary) {
    const over = event.buttons === 0 && chosen() && nearest(items.handles(course, chosen()), (one) => one.at, event);
    document.body.toggleAttribute("data-picking", !!over);
    return false;
  }
  const { item, handle: { id, at, axis } } = held;
  const along = axis ?? (event.shiftKey ? [0, 0, 1] : null);
  const to = along ? items.onLine(pointed(event), at, along) : items.onLevel(pointed(event), at);
  if (to) {
    items.drag(course, item, id, to, { free: event.ctrlKey, surface: surface(event), floor_z_m: report.floor_z_m });
    drawOverlay();
    look();
  }
  return true;
});
for (const end of ["pointerup", "pointercancel"])
  take(end, (event) => {
    if (!held || !event.isPrimary) return false;
    if (held.before !== JSON.stringify(course)) {
      past.push(held.before);
      future = [];
    }
    held = null;
    look();
    return true;
  });
addEventListener("keydown", (event) => {
  if (event.target instanceof HTMLInputElement || event.target instanceof HTMLSelectElement) return;
  const isZ = event.code === "KeyZ" && (event.ctrlKey || event.metaKey);
  if (event.code === "Escape") select(null);
  else if (event.code === "Delete" || event.code === "Backspace") remove();
  else if (isZ) event.shiftKey ? travel(future, past) : travel(past, future);
});
addEventListener("beforeunload", (event) => {
  if (saved !== JSON.stringify(course)) event.preventDefault();
});

document.head.append(make("link", { rel: "stylesheet", href: "/panel.css" }), make("link", { rel: "stylesheet", href: "/course.css" }));
view.canvas.after(overlay);
document.body.append(panel);
document.getElementById("clock").hidden = false;
view.extra.grid = true;
report = await order("open");
course = report.course;
saved = JSON.stringify(course);
view.changed(false);
draw();
