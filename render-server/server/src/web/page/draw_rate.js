// Whether a view is drawn so seldom that it is hard to use.

/** Fewer images a second are too few. */
const USABLE_HZ = 10;
/** Over so long. [ms] */
const WINDOW_MS = 5000;

export class DrawRate {
  constructor() {
    /** When the first of the images was drawn that are counted. [ms] */
    this.since_ms = Number.NaN;
    this.images = 0;
  }

  /** Forgets what was drawn before: the view was out of sight, or is another one. */
  restart() {
    this.since_ms = Number.NaN;
    this.images = 0;
  }

  /**
   * Notes an image; returns whether there were too few of late, `null` while that is not known.
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
