// Replay bar: selects a recorded flight, a second one as a ghost, and the moment; returns to live; loads and saves
// flights as files.

import { clockText, make, makeButton, setText } from "./dom.js";
import { readFlight, writeFlight } from "./flight_file.js";
import { flightText, keepFlight, keptFlights } from "./flight_store.js";

/** @typedef {import("./flight_recording.js").FlightRecording} FlightRecording */
/** @typedef {import("./flight_file.js").About} About */
/** A selectable flight. @typedef {{ name: string, about: About, load: () => Promise<FlightRecording> }} Choice */

/** Minimum duration of a flight that can be replayed. [s] */
const SHORTEST_S = 1;
/** Step of an arrow key, and resolution of the slider. [s] */
const STEP_S = 0.02;

export class ReplayBar {
  /**
   * @param {FlightRecording} live the current flight
   * @param {(text: string) => void} tell shows an error
   */
  constructor(live, tell) {
    this.live = live;
    this.tell = tell;
    /** Recording that is replayed. */
    this.recording = live;
    /** Ghost and its track. @type {{ recording: FlightRecording, track: ReturnType<FlightRecording["track"]> } | null} */
    this.ghost = null;
    /** Description of the last watched flight. @type {About | null} */
    this.about = null;
    /** Stored flights, and flights from files. @type {Choice[]} */
    this.choices = [];
    /** Flights from files. @type {Choice[]} */
    this.files = [];
    /** Moment that is shown; null for live. [s since take-off] @type {number | null} */
    this.at_s = null;
    this.plays = false;
    this.painted_ms = 0;
    this.play = makeButton("replay", { id: "replay-play" });
    this.range = make("input", { id: "replay-at", type: "range", step: String(STEP_S), ariaLabel: "moment of the flight" });
    this.time = make("output", { id: "replay-time" });
    this.now = makeButton("now", { id: "replay-now", hidden: true, title: "back to live" });
    this.flight = make("select", { id: "replay-flight", ariaLabel: "flight", title: "which flight is shown" });
    this.beside = make("select", { id: "replay-ghost", ariaLabel: "ghost", title: "another flight as a ghost" });
    this.save = makeButton("save", { id: "replay-save", title: "this flight as a file" });
    this.open = makeButton("open", { id: "replay-open", title: "a flight from a file" });
    this.file = make("input", { id: "replay-file", type: "file", accept: ".json", hidden: true });
    this.element = make("div", { className: "replay", role: "group", ariaLabel: "replay of the flight", hidden: true },
      this.play, this.range, this.time, this.now, this.flight, this.beside, this.save, this.open, this.file);
    this.play.addEventListener("click", () => this.toggle());
    this.range.addEventListener("input", () => {
      this.plays = false;
      this.show(Number(this.range.value));
    });
    this.now.addEventListener("click", () => this.close());
    this.flight.addEventListener("change", () => this.choose());
    this.beside.addEventListener("change", () => this.chooseGhost());
    this.save.addEventListener("click", () => this.download());
    this.open.addEventListener("click", () => this.file.click());
    this.file.addEventListener("change", () => this.upload());
  }

  /** Whether the last watched flight can be replayed. */
  get hasLive() {
    return this.about != null && this.live.end_s - this.live.start_s >= SHORTEST_S;
  }

  /**
   * Offers replays between flights; in flight, hides the bar and ends a running replay.
   * @param {boolean} offered
   * @param {About | null} about the flight that has just ended, if any
   */
  offer(offered, about) {
    if (!offered) this.about = null;
    else if (about && !this.about && this.live.end_s - this.live.start_s >= SHORTEST_S) {
      this.about = about;
      keepFlight(about, writeFlight(this.live, about)).then(() => this.list(about.arena));
      this.close();
    }
    const hidden = !offered || !(this.hasLive || this.choices.length);
    if (hidden === this.element.hidden) return;
    this.element.hidden = hidden;
    this.close();
  }

  /** Lists the available flights of an arena. @param {string} arena */
  async list(arena) {
    const kept = await keptFlights(arena);
    // The newest stored flight is the one in memory.
    const older = kept.filter(({ at }) => at !== this.about?.at);
    this.choices = [...this.files, ...older.map((about) => ({
      name: named(about), about,
      load: async () => readFlight(await flightText(about.key)).recording,
    }))];
    this.fill();
  }

  fill() {
    const options = this.choices.map(({ name }, k) => [String(k), name]);
    const put = (/** @type {HTMLSelectElement} */ select, /** @type {string} */ first) => {
      const { value } = select;
      select.replaceChildren(...[["", first], ...options].map(([value, textContent]) => make("option", { value, textContent })));
      select.value = options.some(([of]) => of === value) ? value : "";
    };
    put(this.flight, this.hasLive ? "this flight" : "choose a flight");
    put(this.beside, "no ghost");
    this.flight.hidden = this.beside.hidden = !options.length;
    this.play.disabled = this.range.disabled = this.save.disabled = this.recording === this.live && !this.hasLive;
  }

  async choose() {
    await this.load(this.flight, (recording) => {
      this.recording = recording ?? this.live;
      this.plays = false;
      this.show(recording ? recording.start_s : null);
    });
    this.fill();
  }

  async chooseGhost() {
    await this.load(this.beside, (recording) => {
      this.ghost = recording && { recording, track: recording.track() };
      if (recording && this.at_s == null && this.hasLive) this.show(this.recording.start_s);
    });
  }

  /**
   * @param {HTMLSelectElement} select
   * @param {(recording: FlightRecording | null) => void} take
   */
  async load(select, take) {
    try {
      take(select.value === "" ? null : await this.choices[Number(select.value)].load());
    } catch (error) {
      select.value = "";
      take(null);
      this.tell(`this flight cannot be shown: ${error instanceof Error ? error.message : error}`);
    }
  }

  download() {
    const about = this.choices[Number(this.flight.value || -1)]?.about ?? this.about;
    if (!about) return;
    const url = URL.createObjectURL(new Blob([writeFlight(this.recording, about)], { type: "application/json" }));
    make("a", { href: url, download: `${about.arena}-${about.at.replaceAll(/[:.]/g, "-")}.flight.json` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  }

  async upload() {
    const [file] = this.file.files ?? [];
    this.file.value = "";
    if (!file) return;
    try {
      const { recording, about } = readFlight(await file.text());
      const choice = { name: `${file.name}: ${named(about)}`, about, load: async () => recording };
      this.files.unshift(choice);
      this.choices.unshift(choice);
      this.fill();
      this.flight.value = "0";
      await this.choose();
    } catch (error) {
      this.tell(`${file.name}: ${error instanceof Error ? error.message : error}`);
    }
  }

  close() {
    this.plays = false;
    this.recording = this.live;
    this.ghost = null;
    this.flight.value = this.beside.value = "";
    this.show(null);
    this.fill();
  }

  toggle() {
    this.plays = !this.plays;
    const { start_s, end_s } = this.recording;
    this.show(this.at_s == null || (this.plays && this.at_s >= end_s) ? start_s : this.at_s);
  }

  /** @param {number | null} at_s */
  show(at_s) {
    const { start_s, end_s } = this.recording;
    this.at_s = at_s;
    this.range.min = String(start_s);
    this.range.max = String(end_s);
    this.range.value = String(at_s ?? end_s);
    setText(this.time, `${clockText(at_s ?? end_s)} of ${clockText(end_s)}`);
    setText(this.play, this.plays ? "pause" : "replay");
    this.now.hidden = at_s == null;
  }

  /** Returns the moment to show; null for live. @param {number} now_ms */
  moment(now_ms) {
    const past_s = (now_ms - this.painted_ms) / 1000;
    this.painted_ms = now_ms;
    if (this.at_s == null) return null;
    if (this.plays) {
      const at_s = Math.min(this.recording.end_s, this.at_s + past_s);
      this.plays = at_s < this.recording.end_s;
      this.show(at_s);
    }
    return this.recording.at(this.at_s);
  }

  /** Returns the ghost at the shown moment, with its track. */
  ghostNow() {
    const moment = this.at_s == null ? null : this.ghost?.recording.at(this.at_s);
    return this.ghost && moment ? { pose: moment.pose, track: this.ghost.track } : null;
  }
}

/** @param {About} about */
function named({ at, outcome }) {
  const when = new Date(at);
  const time = Number.isNaN(when.getTime()) ? "" : when.toLocaleString([], { day: "numeric", month: "short", hour: "2-digit", minute: "2-digit", second: "2-digit" });
  return `${time} ${outcome}`.trim();
}
