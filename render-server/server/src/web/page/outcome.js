// The banner: outcome of the flight, or an error of the page.

import { $, setText } from "./dom.js";

/**
 * Shows the banner.
 * @param {string} tone
 * @param {string} title
 * @param {string} text
 */
export function showOutcome(tone, title, text) {
  $("outcome").hidden = false;
  $("outcome").dataset.tone = tone;
  setText($("outcome-title"), title);
  setText($("outcome-text"), text);
}

let boot = "", flown = false;

/** @type {import("./panels.js").Part} */
export const outcome = {
  onArena(arena) {
    if (arena.boot === boot) return;
    [boot, flown] = [arena.boot, false];
    $("outcome").hidden = true;
  },
  onState({ outcome, landed, flight_s }) {
    // A new flight on the same server.
    if (flight_s == null && flown) $("outcome").hidden = true;
    flown = flight_s != null;
    if (outcome) showOutcome(outcome.tone, outcome.title, outcome.text + (landed ? "; the vehicle has landed" : ""));
    // The style sheet shows the outcome large enough for the whole room.
    document.body.dataset.outcome = outcome?.tone ?? "";
  },
};
