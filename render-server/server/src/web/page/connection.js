// Connection to the shown vehicle, with automatic reconnection.

import { $, setText } from "./dom.js";
import { showVehicles } from "./header.js";
import { showOutcome } from "./outcome.js";
import { fetchSession } from "./session.js";
import { openSocket } from "./socket.js";

/** Requested vehicle; without one, the server selects the first. */
const wanted = new URLSearchParams(location.search).get("vehicle");

/**
 * Connects, and reconnects whenever the connection ends.
 * @param {(message: import("./messages").Message) => void} onMessage
 * @param {(kind: number, camera: number, jpeg: Uint8Array<ArrayBuffer>) => void} onImage kind: 0 colour, 1 depth, 2 objects
 */
export function connect(onMessage, onImage, wait_ms = FIRST_WAIT_MS) {
  const socket = openSocket(wanted, onMessage, onImage);
  let opened = false;
  socket.onopen = () => {
    opened = true;
    wait_ms = FIRST_WAIT_MS;
    showLink("good", "live");
    delete document.body.dataset.stale;
  };
  socket.onclose = ({ code, reason }) => {
    // The server gives a reason when it closes; a lost server does not.
    showLink(code === TRY_AGAIN_LATER ? "warn" : "bad", reason || "server gone, reconnecting");
    document.body.dataset.stale = "";
    if (code === TRY_AGAIN_LATER) wait_ms = MAX_WAIT_MS;
    if (!opened) explainRefusal();
    setTimeout(connect, wait_ms, onMessage, onImage, Math.min(MAX_WAIT_MS, wait_ms * 1.6));
  };
}

/** Shows why the server rejects the connection: no login, or an unknown vehicle. */
async function explainRefusal() {
  const { role } = await fetchSession();
  if (!role) showLink("warn", "not logged in");
  if (wanted == null) return;
  try {
    /** @type {import("./messages").VehicleLine[]} */
    const vehicles = await (await fetch("/api/vehicles")).json();
    const names = vehicles.map(({ name }) => name);
    if (names.includes(wanted)) return;
    showLink("warn", "no such vehicle");
    showVehicles(names, null);
    showOutcome("warn", `No vehicle '${wanted}'`, `here fly ${names.join(", ")}`);
  } catch {
    // The server is unreachable; the link's state shows it already.
  }
}

/**
 * @param {string} tone
 * @param {string} text
 */
function showLink(tone, text) {
  $("link").dataset.tone = tone;
  setText($("link-text"), text);
}

/** Close code for too many open pages (IANA's registry of RFC 6455). */
const TRY_AGAIN_LATER = 1013;
const FIRST_WAIT_MS = 250;
const MAX_WAIT_MS = 3000;
