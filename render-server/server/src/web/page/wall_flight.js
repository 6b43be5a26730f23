// One flying vehicle on the wall: the image of its first camera, its team, clock and stages.

import { clockText, context2d, make, setText } from "./dom.js";
import { notePassed } from "./event_kinds.js";
import { extended, received } from "./fleet.js";
import { PHASES } from "./phases.js";
import { openSocket } from "./socket.js";

/** @typedef {import("./messages").State} State */
/** @typedef {State & { pose: NonNullable<State["pose"]> }} PlacedState */

export class WallFlight {
  /** @param {string} name of the vehicle @param {(state: PlacedState) => void} onState for each state with a pose */
  constructor(name, onState) {
    this.name = name;
    this.onState = onState;
    /** @type {import("./messages").Arena | null} */
    this.arena = null;
    /** @type {State | null} */
    this.state = null;
    /** @type {import("./fleet.js").ShownPose | null} */
    this.pose = null;
    /** @type {import("./top_view.js").TrackPoint[]} */
    this.track = [];
    /** Indices of the passed stages. @type {Set<number>} */
    this.passed = new Set();
    this.decodes = false;
    this.canvas = make("canvas", { width: 320, height: 240, role: "img", ariaLabel: `what ${name} sees` });
    this.team = make("strong", { textContent: name });
    this.attempt = make("span");
    this.stages = make("span");
    this.clock = make("output");
    this.element = make("figure", { className: "panel" }, this.canvas, make("figcaption", {}, this.team, this.attempt, this.stages, this.clock));
    this.socket = openSocket(name, (message) => this.receive(message), (kind, camera, jpeg) => this.show(kind, camera, jpeg));
  }

  /** Whether the server has closed the connection; a new one is opened then. */
  get hasEnded() {
    return this.socket.readyState === WebSocket.CLOSED;
  }

  close() {
    this.socket.close();
    this.element.remove();
  }

  /** @param {import("./messages").Message} message */
  receive(message) {
    if (message.type === "arena") this.arena = message;
    else if (message.type === "track" && message.vehicle === this.name) this.track = message.points;
    else if (message.type === "state") this.takeState(message);
    else if (message.type === "events") notePassed(this.passed, message.events);
  }

  /** @param {State} state */
  takeState(state) {
    if (state.flight_s == null && this.state?.flight_s != null) {
      // A new flight.
      this.track = [];
      this.passed.clear();
    }
    this.state = state;
    if (!state.pose) return;
    this.pose = received(state.pose, performance.now());
    this.track = extended(this.track, state.pose);
    this.onState({ ...state, pose: state.pose });
  }

  /** @param {number} kind @param {number} camera @param {Uint8Array<ArrayBuffer>} jpeg */
  async show(kind, camera, jpeg) {
    if (kind !== 0 || camera !== 0 || this.decodes) return;
    this.decodes = true;
    try {
      const image = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
      [this.canvas.width, this.canvas.height] = [image.width, image.height];
      context2d(this.canvas).drawImage(image, 0, 0);
      image.close();
    } catch {
      // Skip an image that does not decode; the next one follows.
    }
    this.decodes = false;
  }

  /** Shows the team of the flight. @param {import("./messages").Leaderboard["vehicles"][number]} flyer */
  showTeam({ team, attempt }) {
    setText(this.team, team ?? this.name);
    setText(this.attempt, team ? attempt : "");
  }

  showClock() {
    const { state, arena } = this;
    if (!state) return;
    const phase = state.report?.phase ?? "connecting";
    // The goal is the last stage, as in the standings.
    const goal = arena?.goal_m ? 1 : 0;
    const reached = state.outcome?.outcome === "finished" ? goal : 0;
    const count = (arena?.stages.length ?? 0) + goal;
    setText(this.stages, count ? `${this.passed.size + reached}/${count}` : "");
    setText(this.clock, state.outcome?.title ?? (state.flight_s == null ? (PHASES[phase] ?? PHASES.connecting)[1] : clockText(state.flight_s)));
    this.element.dataset.tone = state.outcome?.tone ?? "";
  }
}
