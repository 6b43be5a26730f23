// Header and footer: vehicle, phase and clock; renderer and runtime.

import { $, clockText, setText } from "./dom.js";
import { PHASES } from "./phases.js";

const list = $("vehicles", HTMLSelectElement);

/**
 * Shows the selection of vehicles, if there are several, or the selected one does not exist.
 * @param {string[]} names
 * @param {string | null} current
 */
export function showVehicles(names, current) {
  const options = names.map((name) => new Option(name, name, false, name === current));
  if (current == null) options.unshift(new Option("choose a vehicle", "", true, true));
  list.replaceChildren(...options);
  list.hidden = options.length < 2;
  $("vehicle").hidden = !list.hidden;
  $("estop-all").hidden = names.length < 2;
  setText($("estop-what"), names.length < 2 || current == null ? "" : current);
}
list.addEventListener("change", () => {
  if (list.value) chooseVehicle(list.value);
});

/** Selects a vehicle. @param {string} name */
export function chooseVehicle(name) {
  location.search = `?vehicle=${encodeURIComponent(name)}`;
}

let time_limit_s = 0;

/** @type {import("./panels.js").Part} */
export const header = {
  onArena(arena) {
    ({ time_limit_s } = arena);
    document.title = `${arena.vehicle} · ${arena.name} · VizFlyt`;
    showVehicles(arena.vehicles, arena.vehicle);
    setText($("arena"), arena.name);
    setText($("vehicle"), arena.vehicle);
  },
  onState({ runtime, report, flight_s, landed, renderer }) {
    const [tone, text] = runtime
      ? PHASES[report?.phase ?? "connecting"] ?? PHASES.connecting
      : ["idle", landed ? "landed" : "no runtime"];
    $("phase").dataset.tone = tone;
    setText($("phase-text"), text);
    setText($("clock"), clockText(flight_s ?? 0));
    const counts = time_limit_s > 0 && flight_s != null && !landed;
    setText($("clock-left"), counts ? `${Math.ceil(Math.max(0, time_limit_s - flight_s))} s left` : "");
    setText($("renderer"), `renderer: ${renderer.name} (${renderer.reason})`);
    setText($("runtime"), runtime ? `${runtime.program} at ${runtime.address}` : "no runtime connected");
  },
};
