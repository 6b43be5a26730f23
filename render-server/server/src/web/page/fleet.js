// Other vehicles of the server that the viewer may see: their positions and paths in this flight.

/** @typedef {import("./messages").State} State */
/** @typedef {import("./messages").Track["points"]} Points */
/** The newest pose, and its arrival time; -Infinity if it is too old to extrapolate. @typedef {NonNullable<State["pose"]> & { received_ms: number }} ShownPose */
/** @typedef {{ name: string, phase: string, pose: ShownPose, track: Points }} Other */

/** Maximum age of a pose that is extrapolated. [s] */
const FRESH_S = 0.5;
/** Maximum number of points of a track. */
const MAX_POINTS = 3000;
/** Minimum spacing of points of a track. [m] */
const SPACING_M = 0.04;

/**
 * Returns a pose with its arrival time.
 * @param {NonNullable<State["pose"]>} pose
 * @param {number} now_ms
 * @returns {ShownPose}
 */
export const received = (pose, now_ms) => ({ ...pose, received_ms: pose.age_s < FRESH_S ? now_ms : -Infinity });

/**
 * Returns the current position of a vehicle: extrapolated at its speed between two messages, so that motion is smooth
 * at any frame rate.
 * @param {ShownPose} pose
 * @param {number} now_ms
 * @returns {[number, number, number]} [m, world]
 */
export function movedOn({ p_world_m: [x, y, z], v_world_mps: [vx, vy, vz], received_ms }, now_ms) {
  const dt_s = Math.min(0.1, Math.max(0, (now_ms - received_ms) / 1000));
  return [x + vx * dt_s, y + vy * dt_s, z + vz * dt_s];
}

/**
 * Returns a track with one more point, thinned as on the server, so that a long flight draws as fast as a short one.
 * @param {Points} track
 * @param {NonNullable<State["pose"]>} pose
 */
export function extended(track, { p_world_m: [x, y, z], v_world_mps, age_s }) {
  const last = track.at(-1);
  if (age_s >= FRESH_S || (last && Math.hypot(x - last[0], y - last[1]) < SPACING_M)) return track;
  track.push([x, y, z, Math.hypot(...v_world_mps)]);
  return track.length > MAX_POINTS ? track.filter((_, k) => k % 2 === 0) : track;
}

export class Fleet {
  constructor() {
    /** Vehicles with a pose, in the server's order. @type {Other[]} */
    this.others = [];
    /** Tracks by name. @type {Map<string, { points: Points, flown: boolean }>} */
    this.tracks = new Map();
  }

  clear() {
    this.others = [];
    this.tracks.clear();
  }

  /** Sets the track that a vehicle has flown before the page was opened. @param {string} name @param {Points} points */
  setTrack(name, points) {
    this.tracks.set(name, { points, flown: true });
  }

  /** @param {State["others"]} others @param {number} now_ms */
  update(others, now_ms) {
    this.others = others.flatMap(({ name, phase, pose, flight_s }) => {
      if (!pose) return [];
      let track = this.tracks.get(name) ?? { points: [], flown: false };
      // A new flight.
      if (flight_s == null && track.flown) track = { points: [], flown: false };
      track.points = extended(track.points, pose);
      track.flown = flight_s != null;
      this.tracks.set(name, track);
      return [{ name, phase, pose: received(pose, now_ms), track: track.points }];
    });
  }
}
