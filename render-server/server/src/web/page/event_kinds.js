// Names and colours of the kinds of events.

/** @typedef {import("./messages").EventLine} EventLine */

/** Colours of kinds that do not end a flight; the server sends the colour of the others. @type {Record<string, string>} */
const TONES = {
  pose_lost: "bad",
  pose_regained: "good",
  stage: "good",
  phase: "go",
  start: "go",
  plugin_output: "code",
};

/**
 * Returns the name of an event's kind, without its data.
 * @param {EventLine["kind"]} kind
 */
export const kindName = (kind) => (typeof kind === "string" ? kind : Object.keys(kind)[0]);

/**
 * Collects the passed stages from events. Stages of an earlier flight, which the server repeats, are dropped at the
 * next take-off.
 * @param {Set<number>} passed indices of the stages passed in this flight
 * @param {Pick<EventLine, "kind">[]} events in their order
 */
export function notePassed(passed, events) {
  for (const { kind } of events) {
    if (typeof kind !== "object") continue;
    if ("phase" in kind && kind.phase === "taking_off") passed.clear();
    if ("stage" in kind) passed.add(kind.stage.index);
  }
}

/**
 * Returns an event's colour by name; empty without one.
 * @param {EventLine} event
 */
export const toneOf = ({ kind, tone }) => tone ?? TONES[kindName(kind)] ?? "";
