// The kinds of events: how the page colours and titles them.

/** @typedef {import("./messages").EventLine["kind"]} Kind */

/** @type {Record<string, { tone: string, title?: string }>} */
const KINDS = {
  collision: { tone: "bad", title: "Collision" },
  geofence: { tone: "bad", title: "Left the geofence" },
  emergency_stop: { tone: "bad", title: "Stopped by hand" },
  plugin_failed: { tone: "bad", title: "Plugin failed" },
  pose_lost: { tone: "bad", title: "Pose lost" },
  pose_regained: { tone: "good" },
  finished: { tone: "good", title: "Finished" },
  stage: { tone: "good" },
  time_limit: { tone: "warn", title: "Time is up" },
  land: { tone: "warn", title: "Landed by hand" },
  phase: { tone: "go" },
  start: { tone: "go" },
  plugin_output: { tone: "code" },
  note: { tone: "" },
};

/**
 * Returns the name of an event's kind, without what the kind carries.
 * @param {Kind} kind
 */
export const kindName = (kind) => (typeof kind === "string" ? kind : Object.keys(kind)[0]);

/**
 * Returns an event's colour, by name; empty for none.
 * @param {Kind} kind
 */
export const toneOf = (kind) => KINDS[kindName(kind)]?.tone ?? "";

/**
 * Returns the title of the banner for a flight that ended so.
 * @param {Kind} kind
 */
export const titleOf = (kind) => KINDS[kindName(kind)]?.title ?? kindName(kind);
