// A recorded flight, which can be replayed without the server.

/** @typedef {import("./messages").State} State */
/** @typedef {Pick<NonNullable<State["pose"]>, "p_world_m" | "rotation" | "v_world_mps" | "yaw_rad">} FlownPose */
/**
 * @typedef {object} Moment
 * @property {number} flight_s since take-off
 * @property {FlownPose} pose
 * @property {State["objects"]} objects
 * @property {Set<number>} passed indices of the stages passed so far
 */

/** Half an hour of states at 20 Hz; longer flights are cut at the end. */
const MAX_MOMENTS = 36_000;
/** Maximum points of a track, as in the views. */
const MAX_TRACK = 3000;

/**
 * Interpolates two lists of numbers.
 * @template {number[]} T
 * @param {T} a
 * @param {T} b
 * @param {number} share of the second
 * @returns {T}
 */
const between = (a, b, share) => /** @type {T} */ (a.map((value, k) => value + (b[k] - value) * share));

/**
 * Interpolates two rotations that are close to each other.
 * @param {FlownPose["rotation"]} a
 * @param {FlownPose["rotation"]} b
 * @param {number} share of the second
 */
function rotationBetween(a, b, share) {
  const isOpposite = a.reduce((sum, value, k) => sum + value * b[k], 0) < 0;
  const mixed = between(a, isOpposite ? /** @type {typeof b} */ (b.map((value) => -value)) : b, share);
  const length = Math.hypot(...mixed) || 1;
  return /** @type {typeof a} */ (mixed.map((value) => value / length));
}

export class FlightRecording {
  constructor() {
    /** Ordered by time. @type {Moment[]} */
    this.moments = [];
  }

  /** Start of the recording: later than take-off, if the page was opened in flight. [s since take-off] */
  get start_s() {
    return this.moments[0]?.flight_s ?? 0;
  }

  /** End of the recording. [s since take-off] */
  get end_s() {
    return this.moments.at(-1)?.flight_s ?? 0;
  }

  clear() {
    this.moments = [];
  }

  /**
   * Adds a state of the flight. Ignores states before take-off, without a pose, or not newer than the last.
   * @param {Pick<State, "flight_s" | "pose" | "objects">} state
   * @param {Set<number>} passed indices of the stages passed by now
   */
  add({ flight_s, pose, objects }, passed) {
    const last = this.moments.at(-1);
    if (flight_s == null || !pose || (last && flight_s <= last.flight_s) || this.moments.length >= MAX_MOMENTS) return;
    const same = last?.passed.size === passed.size;
    this.moments.push({ flight_s, pose, objects, passed: same ? last.passed : new Set(passed) });
  }

  /** Returns the flown track with its speeds; a long flight is thinned. @returns {import("./messages").Track["points"]} */
  track() {
    const every = Math.ceil(this.moments.length / MAX_TRACK);
    const kept = this.moments.filter((_, k) => k % every === 0);
    return kept.map(({ pose: { p_world_m: [x, y, z], v_world_mps } }) => [x, y, z, Math.hypot(...v_world_mps)]);
  }

  /**
   * Returns the state at a time: interpolated poses, and the rest of the preceding state. Times outside return the
   * first or last state; an empty recording returns null.
   * @param {number} flight_s
   * @returns {Moment | null}
   */
  at(flight_s) {
    const { moments } = this;
    if (!moments.length) return null;
    let low = 0, high = moments.length - 1;
    while (low < high) {
      const middle = Math.ceil((low + high) / 2);
      if (moments[middle].flight_s <= flight_s) low = middle;
      else high = middle - 1;
    }
    const before = moments[low], after = moments[low + 1] ?? before;
    const span_s = after.flight_s - before.flight_s;
    const share = span_s > 0 ? Math.min(1, Math.max(0, (flight_s - before.flight_s) / span_s)) : 0;
    const turn = after.pose.yaw_rad - before.pose.yaw_rad;
    const pose = {
      p_world_m: between(before.pose.p_world_m, after.pose.p_world_m, share),
      v_world_mps: between(before.pose.v_world_mps, after.pose.v_world_mps, share),
      rotation: rotationBetween(before.pose.rotation, after.pose.rotation, share),
      yaw_rad: before.pose.yaw_rad + Math.atan2(Math.sin(turn), Math.cos(turn)) * share,
    };
    return { ...before, flight_s: before.flight_s + span_s * share, pose };
  }
}
