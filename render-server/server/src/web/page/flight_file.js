// Reads and writes flights as files. Text: JSON of one object; numbers as sent by the server. [s since take-off; m and
// m/s, world; quaternions x, y, z, w]

import { FlightRecording } from "./flight_recording.js";

/** @typedef {import("./flight_recording.js").Moment} Moment */
/**
 * Description of a flight.
 * @typedef {object} About
 * @property {string} arena its name
 * @property {string} vehicle its name
 * @property {string} outcome short text
 * @property {string} at end time, ISO 8601
 */

const VERSION = 1;
/** Maximum length; half an hour uses a fifth of it. [characters] */
const MAX_LENGTH = 100e6;

/**
 * Returns the text of a flight's file.
 * @param {FlightRecording} recording
 * @param {About} about
 */
export function writeFlight({ moments }, { arena, vehicle, outcome, at }) {
  const row = (/** @type {Moment} */ { flight_s, pose: { p_world_m, v_world_mps, rotation, yaw_rad }, objects, passed }) =>
    [flight_s, p_world_m, v_world_mps, rotation, yaw_rad, [...passed], objects];
  return JSON.stringify({ vizflyt_flight: VERSION, arena, vehicle, outcome, at, moments: moments.map(row) });
}

/**
 * Reads a flight's file.
 * @param {string} text
 * @returns {{ recording: FlightRecording, about: About }}
 * @throws {Error} what is wrong with it
 */
export function readFlight(text) {
  if (text.length > MAX_LENGTH) throw new Error("the file is too long for a flight");
  /** @type {any} */
  let file;
  try {
    file = JSON.parse(text);
  } catch {
    throw new Error("the file is not a flight: no JSON");
  }
  if (file?.vizflyt_flight == null) throw new Error("the file is no flight of VizFlyt");
  if (file.vizflyt_flight !== VERSION) throw new Error(`the flight is of version ${Number(file.vizflyt_flight)}; this page reads ${VERSION}`);
  const recording = new FlightRecording();
  for (const [k, row] of list(file.moments, "its moments").entries()) {
    const what = `moment ${k}`;
    const [flight_s, p, v, q, yaw_rad, passed, objects] = list(row, what);
    const rotation = numbers(q, 4, what);
    if (Math.abs(Math.hypot(...rotation) - 1) > 0.01) throw new Error(`${what} is wrong: a rotation must be a unit quaternion`);
    const pose = {
      p_world_m: /** @type {[number, number, number]} */ (numbers(p, 3, what)),
      v_world_mps: /** @type {[number, number, number]} */ (numbers(v, 3, what)),
      rotation: /** @type {[number, number, number, number]} */ (rotation),
      yaw_rad: number(yaw_rad, what), age_s: 0,
    };
    const before = recording.moments.length;
    recording.add(
      { flight_s: number(flight_s, what), pose: /** @type {any} */ (pose), objects: list(objects, what).map((one) => object(one, what)) },
      new Set(list(passed, what).map((index) => number(index, what))),
    );
    if (recording.moments.length === before) throw new Error(`${what} is wrong: its time must be after the previous one`);
  }
  const word = (/** @type {unknown} */ value) => String(value ?? "").slice(0, 80);
  const about = { arena: word(file.arena), vehicle: word(file.vehicle), outcome: word(file.outcome), at: word(file.at) };
  return { recording, about };
}

/** @param {unknown} value @param {string} what @returns {unknown[]} */
function list(value, what) {
  if (!Array.isArray(value)) throw new Error(`${what} is wrong: no list`);
  return value;
}

/** @param {unknown} value @param {string} what */
function number(value, what) {
  if (typeof value !== "number" || !Number.isFinite(value) || Math.abs(value) > 1e6) throw new Error(`${what} is wrong: a number is missing`);
  return value;
}

/** @param {unknown} value @param {number} count @param {string} what */
function numbers(value, count, what) {
  const all = list(value, what).map((one) => number(one, what));
  if (all.length !== count) throw new Error(`${what} is wrong: ${count} numbers are needed`);
  return all;
}

/** @param {any} value @param {string} what @returns {Moment["objects"][number]} */
function object(value, what) {
  const three = (/** @type {unknown} */ list) => /** @type {[number, number, number]} */ (numbers(list, 3, what));
  return {
    name: String(value?.name ?? "").slice(0, 80), id: number(value?.id, what),
    p_world_m: three(value?.p_world_m), min_m: three(value?.min_m), max_m: three(value?.max_m),
    q_xyzw: /** @type {[number, number, number, number]} */ (numbers(value?.q_xyzw, 4, what)),
  };
}
