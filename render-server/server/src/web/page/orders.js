// Orders to the vehicle: start, land, reset. Each is shown only if it is possible.

import { $ } from "./dom.js";
import { send, vehicleUrl } from "./session.js";
import { announce } from "./stop.js";

const ORDERS = ["start", "land", "reset"];
const AIRBORNE = ["taking_off", "flying", "holding"];
let vehicle = "";

for (const order of ORDERS) {
  const button = $(order, HTMLButtonElement);
  button.addEventListener("click", async () => {
    button.disabled = true;
    const { ok, text } = await send("POST", `${vehicleUrl(vehicle)}/${order}`);
    announce(text);
    $("order-status").textContent = ok ? "" : text;
    button.disabled = false;
  });
}

/** @type {import("./panels.js").Part} */
export const orders = {
  onArena(arena) {
    ({ vehicle } = arena);
  },
  onState({ runtime, report, flight_s, outcome }) {
    const phase = runtime ? (report?.phase ?? "connecting") : "none";
    const airborne = AIRBORNE.includes(phase);
    const begun = flight_s != null || outcome != null;
    $("start").hidden = phase !== "waiting";
    $("land").hidden = !airborne;
    $("reset").hidden = airborne || phase === "landing" || !begun;
  },
};
