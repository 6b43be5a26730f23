// The bar that a flight is looked at again with: play, the moment, back to what is now.

import { clockText, make, makeButton, setText } from "./dom.js";

/** What was watched for less is not looked at again. [s] */
const SHORTEST_S = 1;
/** What an arrow key moves by, and how finely the bar is dragged. [s] */
const STEP_S = 0.02;

export class ReplayBar {
  /** @param {import("./flight_recording.js").FlightRecording} recording */
  constructor(recording) {
    this.recording = recording;
    /** The moment that is shown; none while what is now is. [s since take-off] @type {number | null} */
    this.at_s = null;
    this.plays = false;
    this.painted_ms = 0;
    this.play = makeButton("replay", { id: "replay-play" });
    this.range = make("input", { id: "replay-at", type: "range", step: String(STEP_S), ariaLabel: "moment of the flight" });
    this.time = make("output", { id: "replay-time" });
    this.now = makeButton("now", { id: "replay-now", hidden: true, title: "back to what is now" });
    this.element = make("div", { className: "replay", role: "group", ariaLabel: "replay of the flight", hidden: true },
      this.play, this.range, this.time, this.now);
    this.play.addEventListener("click", () => this.toggle());
    this.range.addEventListener("input", () => {
      this.plays = false;
      this.show(Number(this.range.value));
    });
    this.now.addEventListener("click", () => this.close());
  }

  /** Offers the replay, or takes it away; that ends one that runs. @param {boolean} offered */
  offer(offered) {
    const { start_s, end_s } = this.recording;
    const hidden = !offered || end_s - start_s < SHORTEST_S;
    if (hidden === this.element.hidden) return;
    this.element.hidden = hidden;
    this.close();
  }

  close() {
    this.plays = false;
    this.show(null);
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

  /** Returns the moment to show, if it is not what is now. @param {number} now_ms */
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
}
