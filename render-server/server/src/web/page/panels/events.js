// The events: what the server, the runtime and the plugin report, newest last.

import { clockText, make } from "../dom.js";
import { kindName, toneOf } from "../event_kinds.js";

/** Lines kept on the page. */
const MAX_LINES = 400;
/** What the buttons leave in the list: all, those of the flight, those of the plugin. */
const FEEDS = [["all", "all"], ["flight", "flight"], ["code", "plugin"]];

const list = make("ol", { id: "events", role: "log", ariaLive: "polite", tabIndex: 0 });
const choices = make("div", { className: "views", role: "group", ariaLabel: "which events" });
const title = make("h2", { id: "events-title", textContent: "events" });
const element = make("section", { className: "panel events" }, title, choices, list);
element.setAttribute("aria-labelledby", title.id);

let boot = "";
/** Indices of the events in the list. @type {Set<number>} */
const shown = new Set();

// The newest event stays in sight until someone scrolls up to read.
let following = true;
function follow() {
  if (following) list.scrollTop = list.scrollHeight;
}
list.addEventListener("scroll", () => {
  following = list.scrollTop + list.clientHeight >= list.scrollHeight - 40;
});
new ResizeObserver(follow).observe(list);

for (const [feed, textContent] of FEEDS) {
  const button = make("button", { type: "button", textContent, ariaPressed: String(feed === "all") });
  button.addEventListener("click", () => {
    list.dataset.feed = feed;
    for (const other of choices.children) other.ariaPressed = String(other === button);
    follow();
  });
  choices.append(button);
}

/** @type {import("../panels.js").Panel} */
export const events = {
  element,
  onArena(arena) {
    if (arena.boot === boot) return;
    ({ boot } = arena);
    shown.clear();
    list.replaceChildren();
  },
  onEvents(entries) {
    for (const entry of entries) {
      const { index, kind, text, at_s } = entry;
      if (shown.has(index)) continue;
      shown.add(index);
      const sentence = text || kindName(kind).replaceAll("_", " ");
      const line = make("li", {}, make("time", { textContent: clockText(at_s) }), make("span", { textContent: sentence }));
      line.dataset.tone = toneOf(entry);
      list.append(line);
    }
    while (list.childElementCount > MAX_LINES) list.firstChild?.remove();
    follow();
  },
};
