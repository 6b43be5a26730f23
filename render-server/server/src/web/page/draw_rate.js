// Detects whether a view is drawn too slowly to use.

/** Minimum usable frame rate. */
const USABLE_HZ = 10;
/** Duration of a measurement. [ms] */
const WINDOW_MS = 5000;

export class DrawRate {
  constructor() {
    /** Time of the first counted image. [ms] */
    this.since_ms = Number.NaN;
    this.images = 0;
  }

  /** Restarts the measurement: the view was hidden or replaced. */
  restart() {
    this.since_ms = Number.NaN;
    this.images = 0;
  }

  /**
   * Counts an image; returns whether the recent rate was too low, `null` while unknown.
   * @param {number} now_ms
   */
  note(now_ms) {
    if (Number.isNaN(this.since_ms)) this.since_ms = now_ms;
    const passed_ms = now_ms - this.since_ms;
    if (passed_ms < WINDOW_MS) {
      this.images++;
      return null;
    }
    const isSlow = this.images < (USABLE_HZ * passed_ms) / 1000;
    [this.since_ms, this.images] = [now_ms, 1];
    return isSlow;
  }
}
