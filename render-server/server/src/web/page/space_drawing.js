// Canvas of the 3D view, its renderer, and a line about the renderer if the server draws, or if the browser draws so
// slowly that the server could.

import { make, makeButton } from "./dom.js";

/** @typedef {import("./messages").Arena} Arena */
/** @typedef {import("./space_view.js").SpaceView} SpaceView */
/** @typedef {import("./space_view.js").Drawer} Drawer */

const NO_WEBGL = "this browser has no WebGL 2", LOST = "this browser's graphics have failed";
/** Local storage key: the user has chosen the server as renderer. */
const CHOICE = "drawer";

function makeCanvas() {
  return make("canvas", {
    id: "space", role: "img", tabIndex: 0, hidden: true,
    ariaLabel: "view in space; arrows turn, plus and minus zoom, 0 goes back, F follows",
  });
}

export class SpaceDrawing {
  constructor() {
    this.canvas = makeCanvas();
    /** @type {SpaceView | null} */
    this.view = null;
    this.said = make("span");
    this.other = makeButton("", { onclick: () => this.choose(this.drawer === "server" ? "" : "server") });
    this.note = make("p", { className: "drawer", role: "status", hidden: true }, this.said, this.other);
    /** @type {Drawer} */
    this.drawer = "card";
    /** Reason for which the server draws; empty if the user has chosen so. */
    this.reason = "";
    /** Reason for which the server's image is missing. */
    this.trouble = "";
    /** Last requested view. @type {{ arena: Arena, theme: string | undefined, mode: import("./space_view.js").Mode } | null} */
    this.shown = null;
    document.addEventListener("visibilitychange", () => this.view?.rate.restart());
  }

  get isHidden() {
    return this.canvas.hidden;
  }

  set isHidden(isHidden) {
    this.canvas.hidden = isHidden;
    this.showNote();
  }

  /** Whether a graphics card is available. */
  async hasCard() {
    return (await import("./space_view.js")).ableDrawer() === "card";
  }

  /**
   * Creates the view, if it does not exist.
   * @param {Arena} arena
   * @param {string | undefined} theme
   * @param {import("./space_view.js").Mode} mode
   */
  async open(arena, theme, mode) {
    this.shown = { arena, theme, mode };
    const { SpaceView, ableDrawer } = await import("./space_view.js");
    if (!this.view) {
      const able = ableDrawer();
      if (able === "server") this.reason ||= NO_WEBGL;
      this.drawer = this.reason || localStorage.getItem(CHOICE) === "server" ? "server" : able;
      const { canvas } = this;
      canvas.addEventListener("webglcontextlost", () => canvas === this.canvas && this.lose());
      try {
        this.view = new SpaceView(canvas, arena, theme, this.drawer, (trouble) => {
          this.trouble = trouble;
          this.showNote();
        });
      } catch (error) {
        if (this.drawer === "server") throw error;
        this.lose();
        return;
      }
    }
    this.view.setMode(mode);
    this.showNote();
  }

  /** @param {Arena} arena @param {string | undefined} theme */
  setArena(arena, theme) {
    if (this.shown) Object.assign(this.shown, { arena, theme });
    this.view?.setArena(arena, theme);
  }

  /** @param {Parameters<SpaceView["draw"]>[0]} shown */
  draw(shown) {
    const was = this.view?.isSlow;
    this.view?.draw(shown);
    if (this.view?.isSlow !== was) this.showNote();
  }

  /** Handles a lost graphics context. */
  lose() {
    this.reason = LOST;
    this.renew();
  }

  /** @param {"server" | ""} drawer the server; empty: automatic */
  choose(drawer) {
    localStorage.setItem(CHOICE, drawer);
    this.reason = "";
    this.renew();
  }

  /** Recreates the view on a new canvas, because a canvas cannot change its kind of context. */
  renew() {
    const { canvas } = this, hadFocus = document.activeElement === this.other;
    this.view?.dispose();
    this.view = null;
    this.trouble = "";
    this.canvas = makeCanvas();
    this.canvas.hidden = canvas.hidden;
    canvas.replaceWith(this.canvas);
    if (this.shown) this.open(this.shown.arena, this.shown.theme, this.shown.mode).then(() => hadFocus && this.canvas.focus());
  }

  showNote() {
    const byServer = this.drawer === "server", isSlow = this.view?.isSlow === true;
    const isInstructors = document.body.dataset.role === "instructor";
    this.note.hidden = this.isHidden || !this.view || !(byServer || (isSlow && isInstructors));
    if (!byServer) this.said.textContent = "this browser draws fewer than 10 images a second";
    else if (!isInstructors) this.said.textContent = `drawn without the twin${this.reason && `: ${this.reason}`}`;
    else if (this.trouble) this.said.textContent = `no picture from the server: ${this.trouble}`;
    else this.said.textContent = this.reason ? `drawn by the server: ${this.reason}` : "drawn by the server, twice a second at most";
    this.other.textContent = byServer ? "draw here" : "let the server draw";
    this.other.hidden = this.reason === NO_WEBGL;
  }
}
