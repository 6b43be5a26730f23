// The crash card: what the last flight that failed looked like at its end. Fetched when the server
// says that there is another one; the images are played, or looked at one by one.

const $ = (id) => document.getElementById(id);
const make = (tag, props = {}, ...children) => {
  const node = Object.assign(document.createElement(tag), props);
  node.append(...children);
  return node;
};
const TITLES = {
  collided: "Collision", geofence: "Left the geofence", timeout: "Time is up", landed: "Stopped",
  plugin_failed: "Plugin failed", error: "Flight failed",
};
/** How long the last image stays before the next round. [ms] */
const REST_MS = 1200;
const ago = (s) => `${Math.max(0, s).toFixed(1)} s before the end`;

/** The images of the last two seconds, with what plays them. */
class Replay {
  constructor(url, card) {
    [this.url, this.card, this.camera, this.kind, this.timer] = [url, card, 0, "colour", 0];
    this.picture = make("img", { width: 480, height: 360 });
    this.said = make("span");
    this.slider = make("input", { type: "range", min: 0, step: 1, oninput: () => (this.pause(), this.show()) });
    this.slider.setAttribute("aria-label", "time of the image");
    this.button = make("button", { type: "button", className: "ghost worded", onclick: () => (this.timer ? this.pause() : this.play()) });
    this.other = make("button", { type: "button", className: "ghost worded", onclick: () => this.turn() });
    const names = card.images.map(({ camera }, k) => new Option(camera, k));
    this.cameras = make("select", { onchange: () => this.pick(Number(this.cameras.value)) }, ...names);
    this.cameras.setAttribute("aria-label", "camera");
    this.cameras.hidden = names.length < 2;
    const bar = make("div", { className: "bar" }, this.button, this.slider, this.other, this.cameras);
    this.figure = make("figure", {}, this.picture, make("figcaption", {}, this.said), bar);
  }

  /** Shows a camera's images from the last one on. */
  pick(camera) {
    this.camera = camera;
    this.before_s = this.card.images[camera].before_s;
    this.slider.max = this.before_s.length - 1;
    this.slider.value = this.before_s.length - 1;
    this.turn(this.kind);
  }

  /** Shows depth instead of colour, or the other way round. */
  turn(kind = this.kind === "colour" ? "depth" : "colour") {
    this.kind = kind;
    this.other.textContent = kind === "colour" ? "show depth" : "show colour";
    // All of them now: a replay does not wait for each.
    this.images = this.before_s.map((_, k) => make("img", { src: `${this.url}/crash/${this.card.id}/${this.camera}/${kind}/${k}` }));
    this.show();
  }

  show() {
    const k = Number(this.slider.value), when = ago(this.before_s[k]);
    this.picture.src = this.images[k].src;
    this.picture.alt = `${this.kind} image of ${this.card.images[this.camera].camera}, ${when}`;
    this.slider.setAttribute("aria-valuetext", when);
    this.said.textContent = when;
    this.button.textContent = this.timer ? "pause" : "play";
  }

  play() {
    const last = this.before_s.length - 1;
    const next = () => {
      // Whoever leaves the page, or a newer card, ends it.
      if (!this.figure.isConnected) return this.pause();
      const k = Number(this.slider.value), following = k < last ? k + 1 : 0;
      this.slider.value = following;
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

/** A drawing of the server's, as a part of this page: its colours are the style sheet's. */
function drawing(svg, caption) {
  const node = new DOMParser().parseFromString(svg.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" '), "image/svg+xml");
  return make("figure", {}, document.importNode(node.documentElement, true), make("figcaption", { textContent: caption }));
}

function details(title, lines) {
  return make("details", {}, make("summary", { textContent: title }), make("pre", { textContent: lines.join("\n") }));
}

function fill(url, card) {
  const { verdict } = card;
  $("crash-title").textContent = TITLES[verdict.outcome] ?? verdict.outcome;
  const time = new Date(card.ended_unix_ms).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit" });
  $("crash-when").textContent = `${verdict.seconds.toFixed(1)} s after take-off, ${verdict.stages_passed} of ${verdict.stages.length} stages, at ${time}`;
  const parts = [make("p", { className: "cause", textContent: card.cause })];
  const figures = make("div", { className: "plots" });
  const filmed = card.images.findIndex(({ before_s }) => before_s.length);
  let replay = null;
  if (filmed >= 0) {
    replay = new Replay(url, card);
    replay.pick(filmed);
    replay.cameras.value = filmed;
    figures.append(replay.figure);
  } else {
    parts.push(make("p", { className: "muted", textContent: "No image was drawn in its last two seconds." }));
  }
  figures.append(
    drawing(card.clearance_svg, "clearance of the body (blue), speed (orange)"),
    drawing(card.top_svg, `from above, obstacles at ${card.top_height_m.toFixed(2)} m height`),
  );
  const story = card.events.map(({ before_s, text }) => `${(-before_s).toFixed(2).padStart(8)} s  ${text}`);
  parts.push(figures, details("what happened", story));
  if (card.printed.length) parts.push(details("what the plugin printed", card.printed));
  $("crash-body").replaceChildren(...parts);
  $("crash").hidden = false;
  if (replay && !matchMedia("(prefers-reduced-motion: reduce)").matches) replay.play();
}

/** The card that is shown: its number and address. */
let shown = "";
/** Shows the vehicle's newest crash card, by its number; null where no flight has failed. */
export async function showCrash(url, id) {
  const wanted = id == null ? "" : `${url} ${id}`;
  if (wanted === shown) return;
  shown = wanted;
  if (!wanted) {
    $("crash").hidden = true;
    return;
  }
  try {
    const answer = await fetch(`${url}/crash`);
    if (!answer.ok) throw new Error(await answer.text());
    const card = await answer.json();
    // A newer one may have come meanwhile: it is fetched by itself.
    if (wanted === shown && card.id === id) fill(url, card);
  } catch {
    // Asked for again with the next state.
    setTimeout(() => wanted === shown && (shown = "?"), 1000);
  }
}
