// Selection of the scene: the page reconnects when the server has loaded it.

import { fillChoices, makeFormDialog, makeLabel } from "../dialog.js";
import { $, make } from "../dom.js";
import { known, send } from "../session.js";

const choice = make("select", { id: "scene-choice" });
const label = makeLabel(choice, "the twin that is flown in, with its light, course and rules");
const { dialog, form, status } = makeFormDialog("change scene", "change", "alert", label, choice);

/** @returns {Promise<import("../messages").SceneChoice>} */
async function fetchScenes() {
  const answer = await fetch("/api/scenes");
  return answer.ok ? answer.json() : { now: null, scenes: [] };
}

form.addEventListener("submit", async () => {
  const { ok, text } = await send("PUT", "/api/scene", { name: choice.value });
  status.textContent = ok ? "" : text;
  if (ok) dialog.close();
});

$("scenes").addEventListener("click", async () => {
  const { now, scenes } = await fetchScenes();
  fillChoices(choice, scenes, now);
  status.textContent = "";
  dialog.openFrom($("scenes"));
  choice.focus();
});
known.then(async ({ role }) => {
  if (role === "instructor") $("scenes").hidden = (await fetchScenes()).scenes.length < 2;
});
