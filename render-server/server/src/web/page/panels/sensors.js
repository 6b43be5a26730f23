// Sensors other than cameras: newest readings, LiDAR and radar from above, and settings that can change in flight.
// Polls only while the panel is open.

import { context2d, fixed, make, makeFoldingPanel, setText } from "../dom.js";
import { send, vehicleUrl } from "../session.js";

/**
 * @typedef {import("../messages").SensorLine} SensorLine
 * @typedef {import("../messages").ReadingLine} ReadingLine
 * @typedef {{ fill(line: SensorLine): void, show(reading: ReadingLine | null): void, element: HTMLElement, url: string }} Row
 */

/** Polling interval of readings, and number of readings per update of the settings. */
const READINGS_MS = 200, SETTINGS_EVERY = 10;
/** Sides of the drawing. [px] */
const SIZE_PX = 220;

const list = make("div", { id: "sensor-list" });
const element = makeFoldingPanel("sensors", "sensors: newest readings, rate, range", list);
element.hidden = true;

let vehicle = "", turn = 0;
/** Rows by name. @type {Map<string, Row>} */
let rows = new Map();

/**
 * Draws points from above, with the nose up.
 * @param {CanvasRenderingContext2D} context
 * @param {[number, number, number][]} points_m
 * @param {number} range_m to the drawing's edge
 */
function drawAbove(context, points_m, range_m) {
  const half = SIZE_PX / 2, scale = half / range_m;
  context.clearRect(0, 0, SIZE_PX, SIZE_PX);
  context.strokeStyle = "#8886";
  for (const share of [1, 0.5]) {
    context.beginPath();
    context.arc(half, half, half * share - 0.5, 0, 2 * Math.PI);
    context.stroke();
  }
  context.fillStyle = context.canvas.ownerDocument.documentElement.dataset.theme === "light" ? "#05c" : "#6cf";
  for (const [ahead_m, left_m] of points_m) context.fillRect(half - left_m * scale - 0.5, half - ahead_m * scale - 0.5, 1.5, 1.5);
  context.fillStyle = "#e44";
  context.fillRect(half - 1.5, half - 5, 3, 8);
}

/**
 * @param {SensorLine} line
 * @returns {Row}
 */
function makeRow({ name, kind }) {
  const url = `${vehicleUrl(vehicle)}/sensors/${encodeURIComponent(name)}`;
  const value = make("span", { className: "sensor-value" }), model = make("span", { className: "muted" });
  const number = (/** @type {string} */ key) => make("input", { name: key, type: "number", step: "any", min: "0.1", required: true });
  const [rate, range] = [number("rate_hz"), number("max_range_m")];
  const enabled = make("input", { name: "enabled", type: "checkbox" });
  const status = make("span", { role: "status" });
  const apply = make("p", {}, make("button", { type: "submit", textContent: "apply" }), status);
  apply.dataset.for = "instructor";
  const form = make("form", { autocomplete: "off" },
    make("fieldset", {}, make("label", {}, "on ", enabled), make("label", {}, "rate ", rate, " Hz"), make("label", {}, "up to ", range, " m")),
    apply);
  const drawn = kind === "lidar" || kind === "radar";
  const canvas = make("canvas", { width: SIZE_PX, height: SIZE_PX, role: "img", ariaLabel: `${name} seen from above` });
  canvas.hidden = !drawn;
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const { ok, text } = await send("PATCH", url, { enabled: enabled.checked, rate_hz: +rate.value, max_range_m: +range.value });
    status.dataset.tone = ok ? "good" : "bad";
    setText(status, ok ? "applied" : text);
  });
  let reach_m = 1;
  return {
    url,
    element: make("section", { className: "sensor" }, make("h2", {}, `${name} `, model, " ", value), canvas, form),
    fill(line) {
      setText(model, `${line.kind.replace("_", " ")}, ${line.model}`);
      if (form.contains(document.activeElement)) return;
      enabled.checked = line.enabled;
      rate.value = String(+line.measures.rate_hz.toFixed(3));
      range.value = String(+line.measures.max_range_m.toFixed(3));
    },
    show(reading) {
      if (!reading) return setText(value, "no reading yet");
      const age = `${fixed(reading.age_s * 1e3, 0)} ms ago`;
      if (!drawn) return setText(value, reading.range_m == null ? `no echo, ${age}` : `${fixed(reading.range_m, 2)} m, ${age}`);
      setText(value, `${reading.records} returns, ${age}`);
      const furthest_m = Math.max(1, ...reading.points_m.map(([x, y]) => Math.hypot(x, y)));
      // In steps, so that the scale does not change constantly.
      reach_m = 2 ** Math.ceil(Math.log2(furthest_m));
      drawAbove(context2d(canvas), reading.points_m, reach_m);
      canvas.title = `${reach_m} m to the edge`;
    },
  };
}

/** @param {string} url */
async function ask(url) {
  const answer = await fetch(url);
  return answer.ok ? answer.json() : null;
}

async function refresh() {
  if (!vehicle || (element instanceof HTMLDetailsElement && !element.open && rows.size > 0)) return;
  try {
    if (turn++ % SETTINGS_EVERY === 0) {
      /** @type {SensorLine[] | null} */
      const lines = await ask(`${vehicleUrl(vehicle)}/sensors`);
      element.hidden = !lines?.length;
      const known = new Map((lines ?? []).map((line) => [line.name, rows.get(line.name) ?? makeRow(line)]));
      if ([...known.keys()].join() !== [...rows.keys()].join()) list.replaceChildren(...[...known.values()].map((row) => row.element));
      rows = known;
      for (const line of lines ?? []) rows.get(line.name)?.fill(line);
    }
    for (const row of rows.values()) row.show(await ask(`${row.url}/reading`));
  } catch {
    // The server is unreachable; the connection's state shows it already.
  }
}

async function follow() {
  await refresh();
  setTimeout(follow, rows.size > 0 ? READINGS_MS : READINGS_MS * SETTINGS_EVERY);
}
follow();

/** @type {import("../panels.js").Panel} */
export const sensors = {
  element,
  onArena(arena) {
    ({ vehicle } = arena);
    rows = new Map();
    turn = 0;
  },
};
