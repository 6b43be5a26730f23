// The connection to the vehicle that is shown. A lost one comes back by itself.

import { $, setText } from "./dom.js";
import { showVehicles } from "./header.js";
import { showOutcome } from "./outcome.js";
import { fetchSession } from "./session.js";
import { openSocket } from "./socket.js";

/** The vehicle asked for; the first one, if none is. */
const wanted = new URLSearchParams(location.search).get("vehicle");

/**
 * Connects, and connects again whenever the connection ends.
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
    // The server says why it closes; of one that is gone nobody knows.
    showLink(code === TRY_AGAIN_LATER ? "warn" : "bad", reason || "server gone, reconnecting");
    document.body.dataset.stale = "";
    if (code === TRY_AGAIN_LATER) wait_ms = MAX_WAIT_MS;
    if (!opened) explainRefusal();
    setTimeout(connect, wait_ms, onMessage, onImage, Math.min(MAX_WAIT_MS, wait_ms * 1.6));
  };
}

/** Says why the server refuses the connection: no login, or no such vehicle. */
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
    // The server is gone: the link shows it already.
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

/** A close code (IANA's registry of RFC 6455): too many pages are open. */
const TRY_AGAIN_LATER = 1013;
const FIRST_WAIT_MS = 250;
const MAX_WAIT_MS = 3000;
