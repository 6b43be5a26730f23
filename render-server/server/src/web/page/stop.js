// The stop buttons, and their keys: space and escape, which closes first what lies over the page.

import { closeNewest } from "./closing.js";
import { $ } from "./dom.js";
import { showOutcome } from "./outcome.js";
import { vehicleUrl } from "./session.js";

/** The vehicle that is shown. @type {string | null} */
let vehicle = null;
/** A server that changes its scene answers 503 for a while: asked again so often. */
const RETRIES = 20, RETRY_MS = 250;

/**
 * Stops the vehicle shown, or all of them.
 * @param {boolean} all
 */
async function stop(all) {
  const button = $(all ? "estop-all" : "estop");
  button.dataset.pressed = "";
  announce("stopping");
  try {
    // Before the page knows which vehicle it shows, the button stops whoever flies.
    const url = all || vehicle == null ? "/api/estop" : `${vehicleUrl(vehicle)}/estop`;
    // Not through `send`: the stop button waits for nothing.
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
  // Space on another focused control is that control's own.
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
