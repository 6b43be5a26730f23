// The page: one WebSocket in, requests out. It shows the newest state; after a lost connection, the last state stays on
// the screen.

import { connect } from "./connection.js";
import { $ } from "./dom.js";
import { header } from "./header.js";
import { orders } from "./orders.js";
import { outcome } from "./outcome.js";
import { PANELS } from "./panels.js";
import { stopButton } from "./stop.js";
import { followTheme, switchTheme } from "./theme.js";
import "./dialogs/environment.js";
import "./dialogs/login.js";
import "./dialogs/pairing.js";
import "./dialogs/panels.js";
import "./dialogs/scene.js";

/** @type {import("./panels.js").Part[]} */
const parts = [stopButton, header, orders, outcome, ...Object.values(PANELS.left), ...Object.values(PANELS.right)];

/** @param {import("./messages").Message} message */
function receive(message) {
  for (const part of parts) {
    if (message.type === "arena") part.onArena?.(message);
    else if (message.type === "cameras") part.onCameras?.(message.cameras);
    else if (message.type === "track") part.onTrack?.(message.points, message.vehicle);
    else if (message.type === "events") part.onEvents?.(message.events);
    else if (message.type === "state") part.onState?.(message);
  }
}

/** @param {number} now_ms */
function paint(now_ms) {
  for (const part of parts) part.onFrame?.(now_ms);
  requestAnimationFrame(paint);
}

function restyle() {
  for (const part of parts) part.onTheme?.();
}
$("theme").addEventListener("click", () => {
  switchTheme();
  restyle();
});
followTheme(restyle);
restyle();
connect(receive, (kind, camera, jpeg) => {
  for (const part of parts) part.onImage?.(kind, camera, jpeg);
});
requestAnimationFrame(paint);
