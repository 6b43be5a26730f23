// The ghost of the wall: the best official run of the course, as this screen has recorded it. The server stores
// results, not paths; a best run that was flown while no wall was open has no ghost.

/** @typedef {import("./messages").Leaderboard} Leaderboard */
/** A moment of a run: time since take-off and position. [s; m, world] @typedef {[t_s: number, x: number, y: number, z: number]} Moment */
/** @typedef {{ run: string, team: string, moments: Moment[] }} Ghost */

/** Minimum interval of moments. [s] */
const EVERY_S = 0.1;
/** Maximum difference between the server's flight time and the recorded one. [s] */
const SAME_FLIGHT_S = 2;
/** Latest start of a complete recording, after take-off. [s] */
const LATEST_START_S = 1;
/** Ten minutes of moments. */
const MAX_MOMENTS = 6000;

/**
 * Returns the ghost of stored JSON; null if it is invalid.
 * @param {string | null} kept
 * @returns {Ghost | null}
 */
export function readGhost(kept) {
  try {
    const { run, team, moments } = JSON.parse(kept ?? "");
    const isMoment = (/** @type {unknown} */ moment) => Array.isArray(moment) && moment.length === 4 && moment.every(Number.isFinite);
    if (typeof run !== "string" || typeof team !== "string" || !Array.isArray(moments) || !moments.every(isMoment)) return null;
    return { run, team, moments };
  } catch {
    return null;
  }
}

/**
 * Returns the position of a ghost, and its path so far; nothing before its first moment.
 * @param {Ghost} ghost
 * @param {number} flight_s since take-off
 */
export function ghostAt({ moments }, flight_s) {
  const past = moments.filter(([t_s]) => t_s <= flight_s);
  const before = past.at(-1);
  if (!before) return null;
  const after = moments[past.length] ?? before;
  const share = after[0] > before[0] ? (flight_s - before[0]) / (after[0] - before[0]) : 0;
  const between = (/** @type {1 | 2 | 3} */ k) => before[k] + (after[k] - before[k]) * share;
  return { p_world_m: /** @type {[number, number, number]} */ ([between(1), between(2), between(3)]), way: past };
}

export class BestRun {
  /** @param {Ghost | null} kept stored by an earlier page */
  constructor(kept) {
    /** Ghost of the best official run, if it was recorded. @type {Ghost | null} */
    this.ghost = null;
    this.kept = kept;
    /** Current flight of each vehicle, and the run that it belongs to. @type {Map<string, { run: string | null, moments: Moment[] }>} */
    this.flights = new Map();
  }

  /** @param {string} vehicle @param {number | null} flight_s @param {[number, number, number]} p_world_m */
  watch(vehicle, flight_s, [x, y, z]) {
    const last_s = this.flights.get(vehicle)?.moments.at(-1)?.[0] ?? Infinity;
    // Before take-off, or a new flight.
    if (flight_s == null || flight_s < last_s) this.flights.set(vehicle, { run: null, moments: [] });
    const moments = this.flights.get(vehicle)?.moments;
    if (flight_s == null || !moments || moments.length >= MAX_MOMENTS) return;
    if (!moments.length || flight_s >= last_s + EVERY_S) moments.push([flight_s, x, y, z]);
  }

  /** Assigns runs to flights, and updates the best run; returns whether a new ghost must be stored. @param {Leaderboard} board */
  take({ newest, official, vehicles }) {
    for (const { vehicle, flight_s } of vehicles) {
      const flight = this.flights.get(vehicle);
      const run = newest.find((run) => run.vehicle === vehicle);
      const last_s = flight?.moments.at(-1)?.[0] ?? -Infinity;
      if (flight && run?.state === "flying" && flight_s != null && Math.abs(flight_s - last_s) < SAME_FLIGHT_S) flight.run = run.id;
    }
    const [best] = official;
    if (best && this.kept?.run !== best.run)
      for (const { run, moments } of this.flights.values())
        if (run === best.run && moments[0]?.[0] <= LATEST_START_S) {
          this.kept = this.ghost = { run, team: best.team, moments };
          return true;
        }
    this.ghost = best && this.kept?.run === best.run ? this.kept : null;
    return false;
  }
}
