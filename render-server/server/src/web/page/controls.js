// Who looks at the page, and what they may order: login, start, land, reset, scene, light and fog. Every request
// that changes something goes through `order`, which shows the token that belongs to the cookie.

const make = (tag, props = {}, ...children) => {
  const node = Object.assign(document.createElement(tag), props);
  node.append(...children);
  return node;
};
const $ = (id) => document.getElementById(id);

let session = {};

/** Asks the server who we are; tells it to the style sheet. */
export async function ask() {
  try {
    const answer = await fetch("/api/session");
    if (answer.ok) session = await answer.json();
  } catch {
    // The server is gone: that is told already.
  }
  document.body.dataset.role = session.role ?? "";
  // Nobody logs in where nobody need, nor where there is no password.
  $("login").hidden = session.by === "here" || session.by === "password" || !session.password;
  $("logout").hidden = session.by !== "password";
  return session;
}

/** Sends what changes something; returns the answer. An old token is renewed once. */
export async function order(method, url, body) {
  const send = () =>
    fetch(url, {
      method,
      headers: { ...(body && { "content-type": "application/json" }), ...(session.token && { "x-vizflyt-token": session.token }) },
      body: body && JSON.stringify(body),
    });
  await known;
  let answer = await send();
  if (answer.status === 403 && (await answer.clone().text()).includes("X-VizFlyt-Token")) {
    await ask();
    answer = await send();
  }
  return answer;
}

/** A panel over the page that leaves the stop button, and its keys, where they are. */
export function panel(title, ...content) {
  const heading = make("h2", { textContent: title, id: `panel-${title.replaceAll(" ", "-")}` });
  const dialog = make("dialog", { className: "panel sheet" }, heading, ...content);
  dialog.setAttribute("aria-labelledby", heading.id);
  document.body.append(dialog);
  let opener = null;
  dialog.addEventListener("close", () => opener?.focus());
  return Object.assign(dialog, {
    open_from(button) {
      opener = button;
      if (!dialog.open) dialog.show();
    },
  });
}

// ---- orders to a vehicle -----------------------------------------------------------------
let vehicle = null;
const say = (text) => ($("said").textContent = text);

async function tell(what, button) {
  button.disabled = true;
  try {
    const answer = await order("POST", `/api/vehicles/${encodeURIComponent(vehicle)}/${what}`);
    const text = await answer.text();
    say(text);
    $("order-said").textContent = answer.ok ? "" : text;
  } catch {
    $("order-said").textContent = "the server cannot be reached";
  }
  button.disabled = false;
}
for (const what of ["start", "land", "reset"]) $(what).addEventListener("click", ({ currentTarget }) => tell(what, currentTarget));

/** Shows the orders that make sense now. */
export function showOrders(name, state) {
  vehicle = name;
  const phase = state.runtime ? (state.report?.phase ?? "connecting") : "none";
  const airborne = ["taking_off", "flying", "holding"].includes(phase);
  const begun = state.flight_s != null || state.outcome != null;
  $("start").hidden = phase !== "waiting";
  $("land").hidden = !airborne;
  $("reset").hidden = airborne || phase === "landing" || !begun;
}

// ---- login -------------------------------------------------------------------------------
const password = make("input", { type: "password", id: "password", autocomplete: "current-password", required: true });
const said = make("p", { className: "said" });
said.setAttribute("role", "alert");
const form = make(
  "form",
  {},
  make("label", { htmlFor: "password", textContent: "instructor's password" }),
  password,
  said,
  make("p", { className: "choices" },
    make("button", { type: "submit", className: "ghost worded", textContent: "log in" }),
    make("button", { type: "button", className: "ghost worded", textContent: "close", onclick: () => sheet.close() })),
);
const sheet = panel("log in", form);

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  said.textContent = "";
  try {
    const answer = await fetch("/api/login", {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify({ password: password.value }),
    });
    if (answer.ok) {
      // What the page was refused before, it asks for again.
      location.reload();
      return;
    }
    said.textContent = await answer.text();
  } catch {
    said.textContent = "the server cannot be reached";
  }
  password.value = "";
  password.focus();
});
$("login").addEventListener("click", ({ currentTarget }) => {
  sheet.open_from(currentTarget);
  password.focus();
});
$("logout").addEventListener("click", async () => {
  await order("POST", "/api/logout");
  location.reload();
});

/** Resolves with who we are. */
export const known = ask();

// ---- scene -------------------------------------------------------------------------------
const choice = make("select", { id: "scene-choice" });
const sceneSaid = make("p", { className: "said" });
sceneSaid.setAttribute("role", "alert");
const sceneForm = make(
  "form",
  {},
  make("label", { htmlFor: "scene-choice", textContent: "the twin that is flown in, with its light, course and rules" }),
  choice,
  sceneSaid,
  make("p", { className: "choices" },
    make("button", { type: "submit", className: "ghost worded", textContent: "change" }),
    make("button", { type: "button", className: "ghost worded", textContent: "close", onclick: () => scenes.close() })),
);
const scenes = panel("change scene", sceneForm);
sceneForm.addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    const answer = await order("PUT", "/api/scene", { name: choice.value });
    sceneSaid.textContent = answer.ok ? "" : await answer.text();
    if (answer.ok) scenes.close();
  } catch {
    sceneSaid.textContent = "the server cannot be reached";
  }
});
async function askScenes() {
  const answer = await fetch("/api/scenes");
  return answer.ok ? answer.json() : { scenes: [] };
}
$("scenes").addEventListener("click", async ({ currentTarget }) => {
  const button = currentTarget, { now, scenes: names } = await askScenes();
  choice.replaceChildren(...names.map((name) => new Option(name, name, false, name === now)));
  sceneSaid.textContent = "";
  scenes.open_from(button);
  choice.focus();
});
known.then(async ({ role }) => {
  if (role === "instructor") $("scenes").hidden = (await askScenes()).scenes.length < 2;
});

// ---- light and fog -----------------------------------------------------------------------
const light = make("select", { id: "environment-choice" });
const sight = make("input", { id: "environment-sight", type: "number", min: 0, max: 1000, step: 0.5 });
const airSaid = make("p", { className: "said" });
airSaid.setAttribute("role", "status");
let air = {};
const airForm = make(
  "form",
  {},
  make("label", { htmlFor: light.id, textContent: "what the cameras see the scene in, from the next image on" }),
  light,
  make("label", { htmlFor: sight.id, textContent: "how far one sees [m]; 0 is clear air" }),
  sight,
  airSaid,
  make("p", { className: "choices" },
    make("button", { type: "submit", className: "ghost worded", textContent: "change" }),
    make("button", { type: "button", className: "ghost worded", textContent: "close", onclick: () => airs.close() })),
);
const airs = panel("light and fog", airForm);
const OWN = "own";

function showAir(told) {
  air = told;
  const names = told.name ? told.names : [...told.names, OWN];
  light.replaceChildren(...names.map((name) => new Option(name, name, false, name === (told.name ?? OWN))));
  sight.value = told.fog_visibility_m;
}
async function changeAir(wish) {
  try {
    const answer = await order("PUT", "/api/environment", wish);
    airSaid.textContent = answer.ok ? "changed" : await answer.text();
    if (answer.ok) showAir(await answer.json());
  } catch {
    airSaid.textContent = "the server cannot be reached";
  }
}
// A name takes effect at once; the sight with the button.
light.addEventListener("change", () => light.value !== OWN && changeAir({ name: light.value }));
airForm.addEventListener("submit", (event) => {
  event.preventDefault();
  changeAir({ light: air.light, fog: air.fog, fog_visibility_m: Number(sight.value) });
});
$("environment").addEventListener("click", async ({ currentTarget }) => {
  const button = currentTarget, answer = await fetch("/api/environment");
  airSaid.textContent = answer.ok ? "" : await answer.text();
  if (answer.ok) showAir(await answer.json());
  airs.open_from(button);
  light.focus();
});
