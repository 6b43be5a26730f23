// Pairing a computer: a button for the instructor, a code to read aloud, and the result.

import { makeDialog } from "../dialog.js";
import { make, makeButton } from "../dom.js";
import { showHint } from "../panels/arena_view.js";
import { send, UNREACHABLE } from "../session.js";

/** @typedef {import("../messages").Pairing} Pairing */

const right = make("select", { id: "pair-right" });
const code = make("output", { className: "pair-code" });
const status = make("p", { className: "muted", role: "status" });
const command = make("kbd");
const begin = makeButton("show a code");
const end = makeButton("close");
const dialog = makeDialog(
  "pair a computer",
  make("label", {}, "right to fly and watch ", right),
  code,
  make("p", { className: "muted" }, "On the other computer run ", command, " and type the code."),
  status,
  make("p", { className: "choices" }, begin, end),
);

let timer = 0;
let opened = false;

// `localhost` would be wrong on another computer, and this computer's name is unknown here.
const host = /^(localhost|127\.|\[::1\])/.test(location.hostname) ? "HOST" : location.hostname;

/** @param {Pairing} pairing */
function show({ open, news, port }) {
  command.textContent = `vizflyt pair ${host}:${port}`;
  opened = open != null;
  code.textContent = open?.code ?? "";
  status.textContent = open
    ? `${open.right}: good for ${Math.ceil(open.left_s)} s, ${open.tries_left} tries; ${news}`
    : news;
  begin.hidden = opened;
  right.disabled = opened;
}

async function refresh() {
  try {
    const answer = await fetch("/api/pairing");
    if (answer.ok) show(await answer.json());
    else status.textContent = await answer.text();
  } catch {
    status.textContent = UNREACHABLE;
  }
}

/**
 * @param {"POST" | "DELETE"} method
 * @param {object} [body]
 */
async function change(method, body) {
  const { ok, text } = await send(method, "/api/pairing", body);
  if (ok) show(JSON.parse(text));
  else status.textContent = text;
}

begin.addEventListener("click", () => change("POST", { right: right.value }));
end.addEventListener("click", () => dialog.close());
dialog.addEventListener("close", () => {
  clearInterval(timer);
  // A code that is not visible any more must not stay valid.
  if (opened) change("DELETE");
});

const button = makeButton("pair a computer");
button.addEventListener("click", async () => {
  /** @type {import("../messages").VehicleLine[]} */
  const vehicles = await (await fetch("/api/vehicles")).json();
  right.replaceChildren(
    ...vehicles.map(({ name }) => new Option(`'${name}'`, `team:${name}`)),
    new Option("everything (an instructor)", "instructor"),
  );
  await refresh();
  dialog.openFrom(button);
  timer = setInterval(refresh, 1000);
});

/** Adds the button if the viewer may pair computers. */
async function addButton() {
  const answer = await fetch("/api/pairing");
  if (answer.ok) document.querySelector("footer")?.append(button);
  else if (answer.status === 401) showHint(await answer.text());
}
addButton();
