// Light and weather of the scene: a named environment takes effect at once, a visibility with the button.

import { fillChoices, makeFormDialog, makeLabel } from "../dialog.js";
import { $, make } from "../dom.js";
import { send } from "../session.js";

/** @typedef {import("../messages").Environment} Environment */

/** Entry of an environment without a name. */
const OWN = "own";

const choice = make("select", { id: "environment-choice" });
const visibility = make("input", { id: "environment-sight", type: "number", min: "0", max: "1000", step: "0.5" });
const { dialog, form, status } = makeFormDialog(
  "light and weather", "change", "status",
  makeLabel(choice, "what the cameras see the scene in, from the next image on"), choice,
  makeLabel(visibility, "visibility of fog [m]; 0 is clear air"), visibility,
);
/** @type {Environment | null} */
let environment = null;

/** @param {Environment} now */
function show(now) {
  environment = now;
  fillChoices(choice, now.name ? now.names : [...now.names, OWN], now.name ?? OWN);
  visibility.value = String(now.fog_visibility_m);
}

/** @param {object} wanted */
async function change(wanted) {
  const { ok, text } = await send("PUT", "/api/environment", wanted);
  status.textContent = ok ? "changed" : text;
  if (ok) show(JSON.parse(text));
}

choice.addEventListener("change", () => {
  if (choice.value !== OWN) change({ name: choice.value });
});
form.addEventListener("submit", () => {
  if (!environment) return;
  // All its settings except the name, with another visibility.
  const wanted = Object.entries(environment).filter(([key]) => key !== "name" && key !== "names");
  change({ ...Object.fromEntries(wanted), fog_visibility_m: Number(visibility.value) });
});
$("environment").addEventListener("click", async () => {
  const answer = await fetch("/api/environment");
  status.textContent = answer.ok ? "" : await answer.text();
  if (answer.ok) show(await answer.json());
  dialog.openFrom($("environment"));
  choice.focus();
});
