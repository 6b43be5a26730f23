// The figures: height, speed, ages, rates, battery, localization.

import { context2d, fixed, make, setText } from "../dom.js";
import { cssColours } from "../theme.js";

/** @typedef {import("../messages").State} State */

/** Maximum and minimum time span of a line. [ms] */
const SPAN_MS = 30_000, MIN_SPAN_MS = 5000;
/** Drawing interval of the lines. [ms] */
const EVERY_MS = 100;
/** Maximum age of a pose. [s] */
const FRESH_S = 0.5;
/** Ages above this are coloured. [ms] */
const LATE_MS = 80;

/** One figure: value, unit, and a note; a wide one also has a line of the last half minute. */
class Figure {
  /**
   * @param {string} id
   * @param {string} name
   * @param {string} unit
   */
  constructor(id, name, unit, wide = false) {
    this.value = make("b", { id, textContent: "–" });
    this.unit = make("u", { textContent: unit });
    this.note = make("s");
    this.name = make("dt", { textContent: name });
    this.box = make("div", { className: wide ? "panel wide" : "panel" }, this.name, make("dd", {}, this.value, this.unit, this.note));
    this.canvas = wide ? make("canvas", { ariaHidden: "true" }) : null;
    if (this.canvas) this.box.append(this.canvas);
    /** Time and value. @type {[t_ms: number, value: number][]} */
    this.points = [];
  }

  /**
   * @param {string} value
   * @param {string} [note]
   * @param {"" | "warn" | "bad"} [tone]
   */
  show(value, note = "", tone = "") {
    setText(this.value, value);
    setText(this.note, note);
    this.box.dataset.tone = tone;
  }

  /** @param {number} value */
  push(value) {
    const now_ms = performance.now();
    this.points.push([now_ms, value]);
    while (this.points[0][0] < now_ms - SPAN_MS) this.points.shift();
  }

  /**
   * @param {number} now_ms
   * @param {string} colour
   */
  draw(now_ms, colour) {
    const { canvas, points } = this;
    if (!canvas) return;
    const ratio = Math.min(2, devicePixelRatio || 1);
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(w * ratio)) [canvas.width, canvas.height] = [Math.round(w * ratio), Math.round(h * ratio)];
    const g = context2d(canvas);
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, w, h);
    if (points.length < 2) return;
    const top = Math.max(...points.map(([, value]) => value), 1e-3) * 1.15;
    const span_ms = Math.max(MIN_SPAN_MS, Math.min(SPAN_MS, now_ms - points[0][0]));
    const x = (/** @type {number} */ t_ms) => w - ((now_ms - t_ms) / span_ms) * w;
    const fade = g.createLinearGradient(0, 0, w, 0);
    fade.addColorStop(0, "transparent");
    fade.addColorStop(0.5, colour);
    g.beginPath();
    for (const [t_ms, value] of points) g.lineTo(x(t_ms), h - 3 - (Math.max(0, value) / top) * (h - 12));
    g.strokeStyle = fade;
    g.lineWidth = 1.6;
    g.stroke();
    g.lineTo(w, h);
    g.lineTo(x(points[0][0]), h);
    g.closePath();
    g.globalAlpha = 0.14;
    g.fillStyle = fade;
    g.fill();
    g.globalAlpha = 1;
  }
}

const altitude = new Figure("altitude", "altitude", "m", true);
const speed = new Figure("speed", "speed", "m/s", true);
const age = new Figure("age", "pose to plugin", "ms", true);
const images = new Figure("rate", "images", "Hz");
const render = new Figure("render", "render", "ms");
const battery = new Figure("battery", "battery", "%");
const localization = new Figure("poses", "localization ", "Hz");
const figureList = [altitude, speed, age, images, render, battery, localization];
const tagsView = make("a", { id: "tags-view", target: "_blank", rel: "noopener", textContent: "live view", hidden: true });
localization.name.append(tagsView);
const element = make("section", { className: "figures", ariaLabel: "figures" }, make("dl", {}, ...figureList.map(({ box }) => box)));

/** @param {State} state */
function showMotion({ pose }) {
  if (!pose) return;
  const speed_mps = Math.hypot(...pose.v_world_mps);
  altitude.show(fixed(pose.p_world_m[2], 2));
  altitude.push(pose.p_world_m[2]);
  speed.show(fixed(speed_mps, 2));
  speed.push(speed_mps);
}

/** @param {State} state */
function showImages({ report, render: render_ms, stream_hz, stream_mbit_s }) {
  const received = report?.images.delivered ? report.images : null;
  if (received) {
    age.show(fixed(received.age_ms_p50, 1), `p99 ${fixed(received.age_ms_p99, 1)}`, received.age_ms_p99 > LATE_MS ? "warn" : "");
    age.push(received.age_ms_p50);
  } else age.show("–");
  images.show(fixed(received ? received.rate_hz : stream_hz, 0), stream_mbit_s > 0.05 ? `${fixed(stream_mbit_s, 1)} Mb/s` : "");
  render.show(render_ms.p50 ? fixed(render_ms.p50, 1) : "–", render_ms.p99 ? `p99 ${fixed(render_ms.p99, 1)}` : "");
}

/** @param {State} state */
function showBattery({ report }) {
  const { battery_v = 0, battery_fraction = -1 } = report?.vehicle ?? {};
  // Without a fraction, the autopilot measures only the voltage, or nothing.
  const volts = battery_v > 0, known = volts && battery_fraction >= 0;
  setText(battery.unit, volts && !known ? "V" : "%");
  if (!known) return battery.show(volts ? fixed(battery_v, 1) : "–");
  const tone = battery_fraction < 0.15 ? "bad" : battery_fraction < 0.3 ? "warn" : "";
  battery.show(fixed(battery_fraction * 100, 0), `${fixed(battery_v, 1)} V`, tone);
}

/** @param {State} state */
function showLocalization({ pose, source, source_hz, quality }) {
  const lost = !pose || pose.age_s >= FRESH_S;
  const { bad_packets, lost_frames, occluded, tags } = source;
  const note = !pose ? "no pose yet"
    : lost ? `lost ${fixed(pose.age_s, 1)} s`
    : bad_packets ? `${bad_packets} bad`
    : lost_frames ? `${lost_frames} lost`
    : occluded ? `${occluded} unseen`
    : quality.age_ms == null ? ""
    : `±${fixed(quality.position_sigma_mm, 1)} mm${quality.imu ? ", IMU" : ""}`;
  localization.show(fixed(source_hz, 0), note, lost ? "bad" : "");
  tagsView.hidden = !tags?.view;
  if (tags?.view) tagsView.href = `//${tags.view}/`;
  localization.box.title = localizationDetails(quality, tags);
}

/**
 * Returns a line for each source, one for the filter, one for tags.
 * @param {State["quality"]} quality
 * @param {State["source"]["tags"]} tags
 */
function localizationDetails(quality, tags) {
  const lines = quality.sources.map(({ name, source, rate_hz, latency_ms, believed, rejected }) => {
    const refused = Object.entries(rejected).filter(([, count]) => count).map(([why, count]) => `${count} ${why}`);
    return `${name || `source ${source}`}: ${fixed(rate_hz, 0)} Hz, ${fixed(latency_ms, 1)} ms late, ` +
      `${believed} accepted${refused.length ? `, rejected: ${refused.join(", ")}` : ""}`;
  });
  if (quality.age_ms != null)
    lines.push(`innovation ${fixed(quality.innovation_sigmas, 1)} sigma, attitude ±${fixed(quality.rotation_sigma_deg, 2)}°, ${quality.resets} resets`);
  if (tags)
    lines.push(`${tags.tags} tags in ${tags.cameras} cameras, corners ${fixed(tags.rms_px, 2)} px off, ${fixed(tags.image_ms, 1)} ms per image`);
  return lines.join("\n");
}

let drawn_ms = 0, accent = "";

/** @type {import("../panels.js").Panel} */
export const figures = {
  element,
  onState(state) {
    showMotion(state);
    showImages(state);
    showBattery(state);
    showLocalization(state);
  },
  onFrame(now_ms) {
    if (now_ms - drawn_ms < EVERY_MS) return;
    drawn_ms = now_ms;
    for (const figure of figureList) figure.draw(now_ms, accent);
  },
  onTheme() {
    accent = cssColours()("--accent");
  },
};
