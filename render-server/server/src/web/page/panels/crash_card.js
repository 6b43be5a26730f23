// The crash card: the end of the last failed flight. Fetched when the server has a new one; its images play
// automatically, or step by step.

import { make, makeButton } from "../dom.js";
import { vehicleUrl } from "../session.js";

/** @typedef {import("../messages").CrashCard} CrashCard */
/** @typedef {"colour" | "depth"} Kind */

/** Pause at the last image before the replay repeats. [ms] */
const REST_MS = 1200;
/** Retry interval after a failed fetch. [ms] */
const RETRY_MS = 1000;
/** @param {number} s */
const ago = (s) => `${Math.max(0, s).toFixed(1)} s before the end`;

/** Replay of the images of the last two seconds. */
class Replay {
  /**
   * @param {string} url of the vehicle
   * @param {CrashCard} card
   * @param {number} camera index of the first camera
   */
  constructor(url, card, camera) {
    this.card = card;
    this.timer = 0;
    /** @type {Kind} */
    this.kind = "colour";
    // Load all images now: the replay does not wait for them, and a demo's server ends soon after its flight.
    /** Images by camera. @type {Record<Kind, HTMLImageElement[]>[]} */
    this.images = card.images.map(({ before_s }, camera) => {
      /** @param {Kind} kind */
      const all = (kind) => before_s.map((_, k) => make("img", { src: `${url}/crash/${card.id}/${camera}/${kind}/${k}`, width: 480, height: 360 }));
      return { colour: all("colour"), depth: all("depth") };
    });
    /** Image that is shown. */
    this.picture = this.images[camera].colour[0];
    this.when = make("span");
    this.slider = make("input", { type: "range", min: "0", step: "1", ariaLabel: "time of the image" });
    this.slider.addEventListener("input", () => this.pause());
    this.playButton = makeButton("", { onclick: () => (this.timer ? this.pause() : this.play()) });
    this.kindButton = makeButton("", { onclick: () => this.showKind(this.kind === "colour" ? "depth" : "colour") });
    // Cameras without images cannot be selected.
    const options = card.images.map(({ camera, before_s }, k) => make("option", { value: String(k), textContent: camera, disabled: !before_s.length }));
    this.cameras = make("select", { ariaLabel: "camera" }, ...options);
    this.cameras.addEventListener("change", () => this.showCamera(Number(this.cameras.value)));
    this.cameras.hidden = card.images.length < 2;
    this.cameras.value = String(camera);
    const bar = make("div", { className: "bar" }, this.playButton, this.slider, this.kindButton, this.cameras);
    this.figure = make("figure", {}, this.picture, make("figcaption", {}, this.when), bar);
    this.camera = camera;
    this.before_s = card.images[camera].before_s;
    this.showCamera(camera);
  }

  /** Shows a camera's images, the last one first. @param {number} camera */
  showCamera(camera) {
    this.camera = camera;
    this.before_s = this.card.images[camera].before_s;
    this.slider.max = String(this.before_s.length - 1);
    this.slider.value = this.slider.max;
    this.showKind(this.kind);
  }

  /** @param {Kind} kind */
  showKind(kind) {
    this.kind = kind;
    this.kindButton.textContent = kind === "colour" ? "show depth" : "show colour";
    this.show();
  }

  show() {
    const k = Number(this.slider.value), when = ago(this.before_s[k]);
    const picture = this.images[this.camera][this.kind][k];
    this.picture.replaceWith(picture);
    this.picture = picture;
    picture.alt = `${this.kind} image of ${this.card.images[this.camera].camera}, ${when}`;
    this.slider.setAttribute("aria-valuetext", when);
    this.when.textContent = when;
    this.playButton.textContent = this.timer ? "pause" : "play";
  }

  play() {
    const next = () => {
      // End when the page is left, or a newer card is shown.
      if (!this.figure.isConnected) return this.pause();
      const last = this.before_s.length - 1;
      const k = Number(this.slider.value), following = k < last ? k + 1 : 0;
      this.slider.value = String(following);
      const wait_ms = following < last ? (this.before_s[following] - this.before_s[following + 1]) * 1000 : REST_MS;
      this.timer = setTimeout(next, wait_ms);
      this.show();
    };
    next();
  }

  pause() {
    clearTimeout(this.timer);
    this.timer = 0;
    this.show();
  }
}

/**
 * Returns a drawing of the server as part of this page, with the colours of the style sheet.
 * @param {string} svg
 * @param {string} caption
 */
function drawing(svg, caption) {
  const parsed = new DOMParser().parseFromString(svg.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" '), "image/svg+xml");
  return make("figure", {}, document.importNode(parsed.documentElement, true), make("figcaption", { textContent: caption }));
}

/**
 * @param {string} title
 * @param {string[]} lines
 */
function details(title, lines) {
  return make("details", {}, make("summary", { textContent: title }), make("pre", { textContent: lines.join("\n") }));
}

const title = make("b", { id: "crash-title" }), when = make("span", { id: "crash-when" }), body = make("div", { id: "crash-body" });
const element = make("section", { id: "crash", hidden: true },
  make("details", { className: "panel setup", open: true }, make("summary", {}, "crash card: ", title, " ", when), body));
element.setAttribute("aria-labelledby", title.id);

/**
 * @param {string} url of the vehicle
 * @param {CrashCard} card
 */
function show(url, card) {
  const { verdict } = card;
  title.textContent = card.title;
  const time = new Date(card.ended_unix_ms).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit" });
  when.textContent = `${verdict.seconds.toFixed(1)} s after take-off, ${verdict.stages_passed} of ${verdict.stages.length} stages, at ${time}`;
  const parts = [make("p", { className: "cause", textContent: card.cause })];
  const figures = make("div", { className: "plots" });
  const filmed = card.images.findIndex(({ before_s }) => before_s.length);
  const replay = filmed < 0 ? null : new Replay(url, card, filmed);
  if (replay) figures.append(replay.figure);
  else parts.push(make("p", { className: "muted", textContent: "No image was rendered in its last two seconds." }));
  figures.append(
    drawing(card.clearance_svg, "clearance of the body (blue), speed (orange)"),
    drawing(card.top_svg, `from above, obstacles at ${card.top_height_m.toFixed(2)} m height`),
  );
  const story = card.events.map(({ before_s, text }) => `${(-before_s).toFixed(2).padStart(8)} s  ${text}`);
  body.replaceChildren(...parts, figures, details("what happened", story));
  if (card.printed.length) body.append(details("what the plugin printed", card.printed));
  element.hidden = false;
  if (replay && !matchMedia("(prefers-reduced-motion: reduce)").matches) replay.play();
}

let url = "";
/** Address and number of the shown card. */
let shown = "";

/**
 * Shows the vehicle's newest card by its number; hides the panel without one.
 * @param {number | null} id
 */
async function showCard(id) {
  const wanted = id == null ? "" : `${url} ${id}`;
  if (wanted === shown) return;
  shown = wanted;
  if (!wanted) {
    element.hidden = true;
    return;
  }
  try {
    const answer = await fetch(`${url}/crash`);
    if (!answer.ok) throw new Error(await answer.text());
    /** @type {CrashCard} */
    const card = await answer.json();
    // A newer card may exist by now; it is fetched separately.
    if (wanted === shown && card.id === id) show(url, card);
  } catch {
    // Retried with a later state.
    setTimeout(() => {
      if (wanted === shown) shown = "?";
    }, RETRY_MS);
  }
}

/** @type {import("../panels.js").Panel} */
export const crashCard = {
  element,
  onArena(arena) {
    url = vehicleUrl(arena.vehicle);
  },
  onState({ crash }) {
    showCard(crash);
  },
};
