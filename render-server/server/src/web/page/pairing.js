// Pairing a computer: a button for the instructor, a code to read out, and what came of it.

import { order, panel } from "/controls.js";

const make = (tag, props = {}, ...children) => {
  const node = Object.assign(document.createElement(tag), props);
  node.append(...children);
  return node;
};

const ask = async (method, body) => {
  const answer = await (method === "GET" ? fetch("/api/pairing") : order(method, "/api/pairing", body));
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
};

const right = make("select", { id: "pair-right" });
const code = make("output", { className: "pair-code" });
const news = make("p", { className: "muted" });
news.setAttribute("role", "status");
const command = make("kbd");
const begin = make("button", { type: "button", className: "ghost worded", textContent: "show a code" });
const end = make("button", { type: "button", className: "ghost worded", textContent: "close" });
const dialog = panel(
  "pair a computer",
  make("label", {}, "it shall fly and watch ", right),
  code,
  make("p", { className: "muted" }, "On the other computer run ", command, " and type the code."),
  news,
  make("p", { className: "choices" }, begin, end),
);

let timer = 0;
let opened = false;

// From another computer this one is not `localhost`; what it is called there, a person knows.
const host = /^(localhost|127\.|\[::1\])/.test(location.hostname) ? "HOST" : location.hostname;

function show({ open, news: text, port }) {
  command.textContent = `vizflyt pair ${host}:${port}`;
  opened = open != null;
  code.textContent = opened ? open.code : "";
  news.textContent = opened
    ? `${open.right}: good for ${Math.ceil(open.left_s)} s, ${open.tries_left} tries; ${text}`
    : text;
  begin.hidden = opened;
  right.disabled = opened;
}

async function look() {
  try {
    show(await ask("GET"));
  } catch (error) {
    news.textContent = error.message;
  }
}

async function act(method, body) {
  try {
    show(await ask(method, body));
  } catch (error) {
    news.textContent = error.message;
  }
}

begin.addEventListener("click", () => act("POST", { right: right.value }));
end.addEventListener("click", () => dialog.close());
dialog.addEventListener("close", () => {
  clearInterval(timer);
  // A code that nobody looks at any more is worth nothing.
  if (opened) act("DELETE");
});

async function openDialog({ currentTarget }) {
  const button = currentTarget;
  const vehicles = await (await fetch("/api/vehicles")).json();
  right.replaceChildren(
    ...vehicles.map(({ name }) => new Option(`'${name}'`, `team:${name}`)),
    new Option("everything (an instructor)", "instructor"),
  );
  await look();
  dialog.open_from(button);
  timer = setInterval(look, 1000);
}

// Whoever may not pair does not see the button.
const known = await fetch("/api/pairing");
if (known.ok) {
  const button = make("button", { type: "button", className: "ghost worded", textContent: "pair a computer" });
  button.addEventListener("click", openDialog);
  document.querySelector("footer").append(button);
} else if (known.status === 401) {
  document.getElementById("hint").textContent = await known.text();
  document.getElementById("hint").hidden = false;
}
