// The timing panel: image age by stage, jitter, and dropped images. Polls once per second, only while the panel is
// open.

import { make, makeFoldingPanel } from "../dom.js";
import { UNREACHABLE } from "../session.js";

/** @typedef {import("../messages").Stats} Stats */
/** @typedef {NonNullable<Stats["timing"]>} Timing */
/** @typedef {Timing["waterfall"]["age"]} Percentiles */

/** @type {Record<keyof Timing["waterfall"]["stages"], string>} */
const STAGES = {
  pose: "measured, until rendering starts",
  render: "rendering all cameras",
  encode: "waiting for the encoder, and encoding",
  send: "until the first byte is with the runtime",
  receive: "until the last byte is",
  decode: "waiting for the decoder, and decoding",
  handover: "until the plugin starts on it",
  plugin: "inside the plugin",
  setpoint: "until the setpoint leaves for the autopilot",
};
/** @type {{ age: string, total: string }} */
const SUMS = { age: "pose to plugin", total: "pose to setpoint" };
/** @type {Record<keyof Stats["images"][number]["skipped"], string>} */
const REASONS = {
  no_room: "a newer one was rendered before there was room to send",
  failed: "not encoded",
  late: "given up on the way",
  stale: "a newer one had come before",
  broken: "did not decode",
  superseded: "a newer one came before the decoder was free",
  unasked: "a newer one was decoded before the plugin asked",
  overrun: "the plugin was still at an earlier one",
};
/** Edges of the jitter's bins, as in the runtime's reports. [ms] */
const EDGES = [2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 25, 30, 35, 40, 50, 70, 100, 200, 500];
const PERIOD_MS = 1000;

/**
 * Returns an object's keys and values.
 * @template {object} T
 * @param {T} object
 */
const entries = (object) => /** @type {[keyof T & string, T[keyof T]][]} */ (Object.entries(object));
/** @param {number} value */
const ms = (value) => (Number.isFinite(value) ? value.toFixed(value < 9.95 ? 2 : 1) : "–");
/**
 * @param {number} part
 * @param {number} whole
 */
const share = (part, whole) => `${(100 * Math.min(1, Math.max(0, part / whole))).toFixed(2)}%`;


const body = make("div", { id: "timing-body" });
const element = makeFoldingPanel("timing", "timing: where an image's age comes from", body);
let vehicle = "", timer = 0;

/** Shows the figures, and refreshes them every second while the panel is open. */
async function refresh() {
  clearTimeout(timer);
  if (!element.open) return;
  if (!document.hidden) await fetchStats();
  clearTimeout(timer);
  timer = setTimeout(refresh, PERIOD_MS);
}
element.addEventListener("toggle", refresh);

async function fetchStats() {
  try {
    const answer = await fetch(`/api/stats${vehicle && `?vehicle=${encodeURIComponent(vehicle)}`}`);
    if (answer.ok) show(await answer.json());
    else showText(await answer.text());
  } catch {
    showText(UNREACHABLE);
  }
}

/** @param {string} textContent */
function showText(textContent) {
  body.replaceChildren(make("p", { className: "muted", textContent }));
}

/** @param {Stats} stats */
function show({ runtime, timing, images, connection }) {
  if (!runtime && !timing) return showText("no runtime flies: there is nothing to time");
  if (!timing) return showText("the runtime has not reported yet");
  body.replaceChildren(waterfall(timing.waterfall), jitter(timing.intervals), ...images.map(delivery), facts(timing, connection));
}

/** @param {Timing["waterfall"]} waterfall */
function waterfall({ stages, age, total, images }) {
  const sum_ms = Object.values(stages).reduce((sum, { p50 }) => sum + p50, 0);
  const width_ms = Math.max(sum_ms, total.p99, age.p99, 0.1);
  const heads = ["stage", "", "p50", "p90", "p99", "max ms"].map((textContent) => make(textContent ? "th" : "td", { textContent }));
  const rows = [];
  let start_ms = 0;
  for (const [name, what] of entries(STAGES)) {
    rows.push(stageRow(name, what, start_ms, stages[name], width_ms));
    start_ms += stages[name].p50;
  }
  for (const [name, what] of entries(SUMS)) {
    const row = stageRow(name, what, 0, { age, total }[name], width_ms);
    row.className = "sum";
    rows.push(row);
  }
  return make("table", { className: "falls" },
    make("caption", { className: "away", textContent: `ages by stage of ${images} images` }),
    make("thead", {}, make("tr", {}, ...heads)), make("tbody", {}, ...rows));
}

/**
 * Returns a stage's row: the median as a full bar that starts at the end of the previous stages, then a bar up to the
 * 99th percentile.
 * @param {string} name
 * @param {string} what
 * @param {number} start_ms
 * @param {Percentiles} times
 * @param {number} width_ms
 */
function stageRow(name, what, start_ms, times, width_ms) {
  const median = make("i"), rest = make("i", { className: "rest" });
  median.style.left = share(start_ms, width_ms);
  median.style.width = share(Math.min(times.p50, width_ms - start_ms), width_ms);
  rest.style.left = share(start_ms + times.p50, width_ms);
  rest.style.width = share(Math.min(times.p99 - times.p50, width_ms - start_ms - times.p50), width_ms);
  return make("tr", { title: what },
    make("th", { textContent: name, scope: "row" }),
    make("td", { className: "bar" }, make("div", {}, rest, median)),
    ...entries(times).map(([key, value]) => make("td", { className: key, textContent: ms(value) })));
}

/** @param {Timing["intervals"]} intervals */
function jitter({ times, bins }) {
  const most = Math.max(1, ...bins), counted = bins.filter((n) => n > 0).length > 0;
  const first = Math.max(0, bins.findIndex((n) => n > 0) - 1);
  const last = Math.min(bins.length - 1, bins.findLastIndex((n) => n > 0) + 1);
  const columns = counted ? bins.slice(first, last + 1).map((n, k) => jitterColumn(n, first + k, most)) : [];
  const textContent = `between images: p50 ${ms(times.p50)}, p99 ${ms(times.p99)}, max ${ms(times.max)} ms`;
  return make("figure", { className: "jitter" }, make("figcaption", { textContent }), make("div", {}, ...columns));
}

/**
 * @param {number} n images in this bin
 * @param {number} bin
 * @param {number} most images in any bin
 */
function jitterColumn(n, bin, most) {
  const bar = make("i"), from = EDGES[bin - 1] ?? 0, to = EDGES[bin];
  // Square root, so that a few outliers among hundreds are visible.
  bar.style.height = share(Math.sqrt(n), Math.sqrt(most));
  const label = make("small", { textContent: to ? String(to) : `${from}+` });
  return make("span", { title: `${n} ${to ? `from ${from} to ${to} ms` : `over ${from} ms`}` }, bar, label);
}

/** Returns a row of a camera's delivered and dropped images. @param {Stats["images"][number]} images */
function delivery({ camera, drawn, delivered, under_way, skipped }) {
  const lost = Object.values(skipped).reduce((sum, n) => sum + n, 0);
  const lines = entries(REASONS).filter(([reason]) => skipped[reason] > 0).map(([reason, why]) =>
    make("li", {},
      make("b", { textContent: String(skipped[reason]) }),
      make("span", { textContent: `${reason.replace("_", " ")}: ${why}` })));
  const sum = `${camera}: ${drawn} rendered, ${delivered} delivered, ${lost} skipped, ${under_way} in flight`;
  return make("div", { className: "account" }, make("p", { textContent: sum }), ...(lines.length ? [make("ul", {}, ...lines)] : []));
}

/**
 * @param {Timing} timing
 * @param {Stats["connection"]} connection
 */
function facts({ clock, waterfall }, connection) {
  const list = make("dl", { className: "facts" });
  const add = (/** @type {string} */ name, /** @type {string} */ textContent) =>
    list.append(make("dt", { textContent: name }), make("dd", { textContent }));
  if (clock) {
    const outside = waterfall.out_of_bound ? `; ${waterfall.out_of_bound} images out of bound` : "";
    add("clocks", `known to ${clock.error_bound_ms.toFixed(3)} ms, drift ${clock.drift_ppm.toFixed(1)} ± ${clock.drift_bound_ppm.toFixed(1)} ppm${outside}`);
  }
  if (connection) {
    const { rtt_ms, mbit_s, packets_lost, packets_sent, mtu } = connection;
    add("connection", `round trip ${rtt_ms.toFixed(2)} ms, ${mbit_s.toFixed(1)} Mb/s, ${packets_lost} of ${packets_sent} packets lost, ${mtu} bytes each`);
  }
  return list;
}

/** @type {import("../panels.js").Panel} */
export const timing = {
  element,
  onArena(arena) {
    ({ vehicle } = arena);
  },
};
