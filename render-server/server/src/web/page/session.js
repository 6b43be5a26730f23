// Who looks at the page, and the requests that change something: they carry the token that belongs to the cookie.

import { $ } from "./dom.js";

/** @typedef {import("./messages").Session} Session */

/** @type {Partial<Session>} */
let session = {};

/** Asks the server who the viewer is; the style sheet hides what the viewer may not do. */
export async function fetchSession() {
  try {
    const answer = await fetch("/api/session");
    if (answer.ok) session = await answer.json();
  } catch {
    // The server is gone: the connection's state shows it already.
  }
  document.body.dataset.role = session.role ?? "";
  // No login where none is needed, nor where there is no password.
  $("login").hidden = session.by === "here" || session.by === "password" || !session.password;
  $("logout").hidden = session.by !== "password";
  return session;
}

/** Resolves with who the viewer is. */
export const known = fetchSession();

/**
 * @typedef {object} Reply
 * @property {boolean} ok
 * @property {string} text the answer's body, or why there is none
 */

/**
 * Sends a request that changes something; an outdated token is renewed once. Never throws.
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
 * Returns where a vehicle's requests go.
 * @param {string} name
 */
export const vehicleUrl = (name) => `/api/vehicles/${encodeURIComponent(name)}`;

export const UNREACHABLE = "the server cannot be reached";
