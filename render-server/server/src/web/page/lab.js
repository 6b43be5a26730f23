// The lab day: checklist, queue of teams, several vehicles, and one STOP for all. Polls every second. Rows keep their
// place, so that a finger or the keyboard focus does not lose them.

import "./dialogs/login.js";
import { $, make, makeButton, setText } from "./dom.js";
import { known, send, UNREACHABLE, vehicleUrl } from "./session.js";
import { followTheme } from "./theme.js";

/** @typedef {import("./messages").LabDay} LabDay */
/** @typedef {LabDay["checks"][number]} Check */
/** @typedef {LabDay["vehicles"][number]} Vehicle */
/** @typedef {LabDay["queue"][number]} Booking */

const EVERY_MS = 1000;
/** @type {Record<string, string>} */
const TONES = { ok: "good", failed: "bad", outdated: "warn", not_done: "idle" };
/** Texts of a check's button: to begin, and to end. @type {Record<string, [string, string]>} */
const WORDS = { signed: ["sign", "take back"], guided: ["begin", "cancel"], pressed: ["STOP it", "STOP it"] };
/** @type {Record<string, string>} */
const STATES = { ok: "ok", failed: "failed", outdated: "outdated", not_done: "not done" };
const signer = $("signer", HTMLInputElement);
signer.value = localStorage.getItem("signer") ?? "";
signer.addEventListener("change", () => localStorage.setItem("signer", signer.value.trim()));

/** @param {number | null} unix_ms */
const clock = (unix_ms) => {
  if (unix_ms == null) return "–";
  return new Date(unix_ms).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
};

/**
 * Sends an order, and shows the result.
 * @param {"POST" | "PUT" | "DELETE"} method
 * @param {string} url
 * @param {object} [body]
 */
async function order(method, url, body) {
  const { ok, text } = await send(method, url, body);
  const status = $("lab-status");
  status.dataset.tone = ok ? "good" : "bad";
  setText(status, text);
  await refresh();
  return ok;
}

// ---- checks ----

/** Rows by vehicle and check. @type {Map<string, (check: Check, day: LabDay) => void>} */
const rows = new Map();
/** Headings by vehicle. @type {Map<string, (vehicle: Vehicle) => void>} */
const headings = new Map();

/**
 * Returns a check's row, and a function that updates it.
 * @param {Check} check
 * @returns {[HTMLElement, (check: Check, day: LabDay) => void]}
 */
function makeRow({ check, title, how, vehicle }) {
  const state = make("span", { className: "state" }), evidence = make("p"), todo = make("p", { className: "todo" });
  const when = make("small", { className: "muted" });
  const act = makeButton("", { hidden: how === "live" || how === "brought" });
  act.dataset.for = "instructor";
  let isActive = false;
  act.addEventListener("click", () => {
    if (how === "signed") {
      return order("POST", "/api/lab/sign", { vehicle, check, name: signer.value, take_back: isActive });
    }
    if (how === "guided") return order("POST", "/api/lab/axes", { vehicle, begin: !isActive });
    return order("POST", `${vehicleUrl(vehicle)}/estop`);
  });
  const told = make("div", {}, make("h3", { textContent: title }), evidence, todo);
  const row = make("li", { className: "check" }, state, told, make("div", { className: "act" }, act, when));
  row.dataset.check = check;
  return [row, (now, day) => {
    row.dataset.state = now.state;
    state.dataset.tone = TONES[now.state];
    setText(state, STATES[now.state]);
    const guide = how === "guided" && day.axes?.vehicle === vehicle ? day.axes : null;
    isActive = how === "signed" ? now.state === "ok" : guide != null;
    const [begin, end] = WORDS[how] ?? WORDS.pressed;
    setText(act, isActive ? end : begin);
    // Full label for screen readers.
    act.ariaLabel = `${act.textContent}: ${title}${vehicle && ` of ${vehicle}`}`;
    setText(evidence, guide ? guide.seen : now.evidence);
    setText(todo, guide ? `do: ${guide.ask}` : now.state === "ok" ? "" : now.todo || now.ask);
    setText(when, now.at_unix_ms == null ? "" : `${clock(now.at_unix_ms)}, ${now.by}`);
  }];
}

/**
 * Returns a vehicle's heading, and a function that updates it.
 * @param {string} name
 * @returns {[HTMLElement, (vehicle: Vehicle) => void]}
 */
function makeHeading(name) {
  const phase = make("span", { className: "muted" }), badge = make("span", { className: "badge" });
  const hint = make("p", { className: "hint-line" });
  const start = makeButton("start", { hidden: true }), land = makeButton("land", { hidden: true });
  start.ariaLabel = `start ${name}`;
  land.ariaLabel = `land ${name}`;
  start.dataset.for = "instructor";
  start.addEventListener("click", () => order("POST", `${vehicleUrl(name)}/start`));
  land.addEventListener("click", () => order("POST", `${vehicleUrl(name)}/land`));
  const head = make("div", { className: "group" }, make("h2", { textContent: name }), badge, phase, start, land, hint);
  return [head, (vehicle) => {
    setText(badge, vehicle.is_ready ? "ready to fly" : "not ready");
    badge.dataset.tone = vehicle.is_ready ? "good" : "warn";
    setText(phase, vehicle.runtime ? vehicle.phase.replace("_", " ") : "no runtime");
    start.hidden = vehicle.phase !== "waiting" || !vehicle.runtime;
    land.hidden = !["taking_off", "flying", "holding"].includes(vehicle.phase);
    const { called, checked_in, must_wait } = vehicle;
    const isOther = called && checked_in && called !== checked_in;
    const stranger = isOther ? `${called} is called, but ${checked_in} is checked in here. ` : "";
    setText(hint, stranger + (start.hidden ? "" : must_wait ?? ""));
  }];
}

/** @param {LabDay} day */
function showChecks(day) {
  const column = $("lab-checks");
  const names = ["", ...day.vehicles.map(({ name }) => name)];
  if (names.some((name) => name && !headings.has(name)) || rows.size !== day.checks.length) {
    rows.clear();
    headings.clear();
    column.replaceChildren(...names.map((name) => {
      const section = make("section", { className: "panel" });
      if (name) {
        const [head, update] = makeHeading(name);
        headings.set(name, update);
        section.append(head);
      } else section.append(make("div", { className: "group" }, make("h2", { textContent: "the room" })));
      section.ariaLabel = name ? `checks of ${name}` : "checks of the room";
      section.append(make("ul", {}, ...day.checks.filter(({ vehicle }) => vehicle === name).map((check) => {
        const [row, update] = makeRow(check);
        rows.set(`${name}/${check.check}`, update);
        return row;
      })));
      return section;
    }));
  }
  for (const check of day.checks) rows.get(`${check.vehicle}/${check.check}`)?.(check, day);
  for (const vehicle of day.vehicles) headings.get(vehicle.name)?.(vehicle);
}

// ---- the queue ----

/**
 * Fills a list if its content has changed.
 * @param {HTMLElement} list
 * @param {unknown} shown
 * @param {() => Node[]} children
 */
function fill(list, shown, children) {
  const key = JSON.stringify(shown);
  if (list.dataset.shown === key) return;
  list.dataset.shown = key;
  list.replaceChildren(...children());
}

/** @param {Booking} booking */
function makeBooking({ id, team, vehicle, state, place, booked_unix_ms, called_unix_ms, ended_unix_ms, passed_over, is_own }) {
  const where = state === "called" ? "now" : state === "waiting" ? String(place) : state === "done" ? "flown" : "left";
  const open = state === "called" ? `called ${clock(called_unix_ms)}` : `booked ${clock(booked_unix_ms)}`;
  const times = state === "waiting" || state === "called" ? open : clock(ended_unix_ms);
  const note = passed_over ? `, passed over ${passed_over}×` : "";
  const leave = makeButton("withdraw", { hidden: state !== "waiting" || !is_own, ariaLabel: `take ${team} out of the queue` });
  leave.addEventListener("click", () => order("DELETE", `/api/lab/queue/${id}`));
  const cells = [where, team, vehicle, times + note].map((textContent) => make("td", { textContent }));
  const row = make("tr", {}, ...cells, make("td", {}, leave));
  row.dataset.state = state;
  return row;
}

/** @param {Vehicle} vehicle */
function makeTurn({ name, called }) {
  const text = make("span", { textContent: called ? `${name}: ${called}` : `${name}: no team is called` });
  const turn = (/** @type {string} */ word, /** @type {string} */ turn, /** @type {boolean} */ shown) => {
    const button = makeButton(word, { hidden: !shown, ariaLabel: `${word}, ${name}` });
    button.addEventListener("click", () => order("POST", "/api/lab/turn", { vehicle: name, turn }));
    return button;
  };
  const buttons = [turn("call next", "next", !called), turn("end", "end", !!called), turn("pass over", "pass_over", !!called)];
  return make("div", { className: "turn" }, text, ...buttons);
}

/** @param {LabDay} day */
function showQueue(day) {
  const { queue, vehicles } = day;
  fill($("lab-turns"), vehicles.map(({ name, called }) => [name, called]), () => vehicles.map(makeTurn));
  const isOpen = (/** @type {Booking} */ { state }) => state === "waiting" || state === "called";
  const over = queue.filter((booking) => !isOpen(booking)).slice(-5);
  const called = queue.filter(({ state }) => state === "called");
  const waiting = queue.filter(({ state }) => state === "waiting");
  const shown = [...called, ...waiting, ...over];
  const none = () => make("tr", {}, make("td", { colSpan: 5, className: "muted", textContent: "no bookings" }));
  fill($("lab-queue"), shown, () => (shown.length ? shown.map(makeBooking) : [none()]));
  const list = book.elements.namedItem("vehicle");
  if (list instanceof HTMLSelectElement) {
    fill(list, vehicles.map(({ name }) => name), () => vehicles.map(({ name }) => new Option(name, name)));
    list.hidden = vehicles.length < 2;
  }
}

const book = $("book-form", HTMLFormElement);
book.addEventListener("submit", async (event) => {
  event.preventDefault();
  if (await order("POST", "/api/lab/queue", Object.fromEntries(new FormData(book)))) book.reset();
});

// ---- several vehicles ----

const formation = $("formation-form", HTMLFormElement);
formation.addEventListener("submit", (event) => {
  event.preventDefault();
  const asked = new FormData(formation);
  const names = String(asked.get("order")).split(",").map((name) => name.trim()).filter(Boolean);
  const separation = String(asked.get("separation"));
  order("PUT", "/api/lab/formation", {
    order: { vehicles: names, until: asked.get("until") },
    separation_m: separation ? Number(separation) : null,
  });
});

/** @param {LabDay} day */
function showFormation({ order: { vehicles, until }, separation_m, distances, vehicles: all }) {
  $("formation").hidden = all.length < 2;
  const key = JSON.stringify([vehicles, until, separation_m]);
  if (formation.dataset.shown !== key) {
    formation.dataset.shown = key;
    const set = (/** @type {string} */ name, /** @type {string} */ value) => {
      const field = formation.elements.namedItem(name);
      if (field instanceof HTMLInputElement || field instanceof HTMLSelectElement) field.value = value;
    };
    set("order", vehicles.join(", "));
    set("until", until);
    set("separation", separation_m == null ? "" : String(separation_m));
  }
  const apart = distances.map(({ first, second, apart_m }) => `${first} – ${second}: ${apart_m.toFixed(2)} m`);
  setText($("lab-distances"), apart.length ? apart.join(", ") : "no two vehicles are in the air");
}

// ---- all of it ----

/** @param {LabDay} day */
function show(day) {
  setText($("lab-arena"), day.arena);
  setText($("lab-link"), `since ${new Date(day.began_unix_ms).toLocaleString([], { dateStyle: "medium", timeStyle: "short" })}`);
  showChecks(day);
  showQueue(day);
  showFormation(day);
  fill($("lab-story"), day.story, () => day.story.map(({ at_unix_ms, text }) => {
    const at = make("small", { className: "muted", textContent: clock(at_unix_ms) });
    return make("li", {}, at, ` ${text}`);
  }));
}

async function refresh() {
  try {
    const answer = await fetch("/api/lab");
    if (answer.ok) show(await answer.json());
    else if (answer.status === 401) setText($("lab-link"), "log in, or open the address that you were given");
    else setText($("lab-link"), await answer.text());
    document.body.toggleAttribute("data-stale", !answer.ok);
  } catch {
    setText($("lab-link"), UNREACHABLE);
    document.body.toggleAttribute("data-stale", true);
  }
}

async function repeat() {
  await refresh();
  setTimeout(repeat, EVERY_MS);
}

$("lab-begin").addEventListener("click", () => {
  if (confirm("Begin a new day? Checks and queue are reset; the file of the previous day is kept.")) order("POST", "/api/lab/begin");
});

/** Stops all vehicles; a team stops only its own. */
async function stopAll() {
  const button = $("estop"), status = $("lab-status");
  button.dataset.pressed = "";
  try {
    // Not through `send`: stopping must not wait for a token.
    let answer = await fetch("/api/estop", { method: "POST" });
    if (answer.status === 403) {
      const [own] = headings.keys();
      answer = await fetch(`${vehicleUrl(own)}/estop`, { method: "POST" });
    }
    status.dataset.tone = answer.ok ? "good" : "bad";
    setText(status, await answer.text());
  } catch {
    status.dataset.tone = "bad";
    setText(status, "not stopped: the server cannot be reached; use the pilot's transmitter");
  }
  setTimeout(() => delete button.dataset.pressed, 400);
}
$("estop").addEventListener("click", stopAll);
addEventListener("keydown", (event) => {
  if (event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
  // Another focused control handles the space key itself.
  const control = event.target instanceof Element ? event.target.closest("button, a, input, select, summary, textarea") : null;
  const isElsewhere = control && control !== $("estop");
  if (event.code === "Escape" || (event.code === "Space" && !isElsewhere)) {
    event.preventDefault();
    stopAll();
  }
});

followTheme();
known.then(repeat);
