// The kinds of events: how the page names and colours them.

/** @typedef {import("./messages").EventLine} EventLine */

/** The colours of the kinds that end no flight; of those that do, the server sends it. @type {Record<string, string>} */
const TONES = {
  pose_lost: "bad",
  pose_regained: "good",
  stage: "good",
  phase: "go",
  start: "go",
  plugin_output: "code",
};

/**
 * Returns the name of an event's kind, without what the kind carries.
 * @param {EventLine["kind"]} kind
 */
export const kindName = (kind) => (typeof kind === "string" ? kind : Object.keys(kind)[0]);

/**
 * Notes the stages that events tell of. Those of an earlier flight, which the server tells of too, end with the next take-off.
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
 * Returns an event's colour, by name; empty for none.
 * @param {EventLine} event
 */
export const toneOf = ({ kind, tone }) => tone ?? TONES[kindName(kind)] ?? "";
