// The stop buttons and their keys: space and escape. Escape first closes open dialogs.

import { closeNewest } from "./closing.js";
import { $ } from "./dom.js";
import { showOutcome } from "./outcome.js";
import { vehicleUrl } from "./session.js";

/** Vehicle that is shown. @type {string | null} */
let vehicle = null;
/** Retries and interval while the server changes its scene (status 503). */
const RETRIES = 20, RETRY_MS = 250;

/**
 * Stops the shown vehicle, or all vehicles.
 * @param {boolean} all
 */
async function stop(all) {
  const button = $(all ? "estop-all" : "estop");
  button.dataset.pressed = "";
  announce("stopping");
  try {
    // Before the page has received its vehicle, the button stops all vehicles.
    const url = all || vehicle == null ? "/api/estop" : `${vehicleUrl(vehicle)}/estop`;
    // Not through `send`: stopping must not wait for a token.
    let answer = await fetch(url, { method: "POST" });
    for (let tries = 0; answer.status === 503 && tries < RETRIES; tries++) {
      await new Promise((done) => setTimeout(done, RETRY_MS));
      answer = await fetch(url, { method: "POST" });
    }
    const text = await answer.text();
    announce(text);
    if (!answer.ok) showOutcome("warn", "Not stopped", text);
  } catch {
    showOutcome("bad", "Not stopped", "the server cannot be reached: use the pilot's transmitter");
  }
  setTimeout(() => delete button.dataset.pressed, 400);
}

$("estop").addEventListener("click", () => stop(false));
$("estop-all").addEventListener("click", () => stop(true));
addEventListener("keydown", (event) => {
  if (event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
  // Another focused control handles the space key itself.
  const control = event.target instanceof Element ? event.target.closest("button, input, select, summary, textarea") : null;
  const elsewhere = control && control !== $("estop");
  if (event.code === "Escape" || (event.code === "Space" && !elsewhere)) {
    event.preventDefault();
    if (event.code !== "Escape" || !closeNewest()) stop(false);
  }
});

/**
 * Announces a text to screen readers.
 * @param {string} text
 */
export function announce(text) {
  $("announcement").textContent = text;
}

/** @type {import("./panels.js").Part} */
export const stopButton = {
  onArena(arena) {
    ({ vehicle } = arena);
  },
};
