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
 * Returns an event's colour, by name; empty for none.
 * @param {EventLine} event
 */
export const toneOf = ({ kind, tone }) => tone ?? TONES[kindName(kind)] ?? "";
