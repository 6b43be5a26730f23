// Role of the viewer, and requests that change something: they carry the token of the cookie.

import { $ } from "./dom.js";

/** @typedef {import("./messages").Session} Session */

/** @type {Partial<Session>} */
let session = {};

/** Fetches the viewer's role; the style sheet hides the controls that the viewer may not use. */
export async function fetchSession() {
  try {
    const answer = await fetch("/api/session");
    if (answer.ok) session = await answer.json();
  } catch {
    // The server is unreachable; the connection's state shows it already.
  }
  document.body.dataset.role = session.role ?? "";
  // Hide the login if it is not required, or no password is set.
  $("login").hidden = session.by === "here" || session.by === "password" || !session.password;
  $("logout").hidden = session.by !== "password";
  return session;
}

/** Resolves with the viewer's session. */
export const known = fetchSession();

/**
 * @typedef {object} Reply
 * @property {boolean} ok
 * @property {string} text body of the answer, or the reason of a failure
 */

/**
 * Sends a request that changes something; renews an outdated token once. Never throws.
 * @param {"POST" | "PUT" | "PATCH" | "DELETE"} method
 * @param {string} url
 * @param {object} [body] sent as JSON
 * @returns {Promise<Reply>}
 */
export async function send(method, url, body) {
  const once = async () => {
    const headers = new Headers();
    if (body) headers.set("content-type", "application/json");
    if (session.token) headers.set("x-vizflyt-token", session.token);
    const answer = await fetch(url, { method, headers, body: body && JSON.stringify(body) });
    return { ok: answer.ok, status: answer.status, text: await answer.text() };
  };
  await known;
  try {
    const reply = await once();
    if (reply.status !== 403 || !reply.text.includes("X-VizFlyt-Token")) return reply;
    await fetchSession();
    return await once();
  } catch {
    return { ok: false, text: UNREACHABLE };
  }
}

/**
 * Returns the base URL of a vehicle's requests.
 * @param {string} name
 */
export const vehicleUrl = (name) => `/api/vehicles/${encodeURIComponent(name)}`;

export const UNREACHABLE = "the server cannot be reached";
