// The events of server, runtime and plugin, newest last; repeated events are one line.

import { clockText, make, setText } from "../dom.js";
import { EventGroups } from "../event_groups.js";
import { kindName, toneOf } from "../event_kinds.js";

/** Maximum lines on the page. */
const MAX_LINES = 400;
/** Filters of the list: all, flight, plugin. */
const FEEDS = [["all", "all"], ["flight", "flight"], ["code", "plugin"]];

const list = make("ol");
const log = make("div", { id: "events", role: "log", ariaLive: "polite", ariaLabel: "events", tabIndex: 0 }, list);
const choices = make("div", { className: "views", role: "group", ariaLabel: "which events" });
const title = make("h2", { id: "events-title", textContent: "events" });
const element = make("section", { className: "panel events" }, title, choices, log);
element.setAttribute("aria-labelledby", title.id);

let boot = "";
/** Indices of the events in the list. @type {Set<number>} */
const shown = new Set();
let groups = new EventGroups();
/** Line of each group. @type {WeakMap<import("../event_groups.js").Group, HTMLElement>} */
const lines = new WeakMap();

/** Shows an event in its group's line, and moves the line to the end. @param {import("../messages").EventLine} entry */
function showEvent(entry) {
  const tone = toneOf(entry);
  const sentence = entry.text || kindName(entry.kind).replaceAll("_", " ");
  const group = groups.add(tone, sentence, entry.at_s);
  const line = lines.get(group) ?? make("li", {}, make("time"), make("span"));
  lines.set(group, line);
  const [time, words] = line.children;
  setText(time, clockText(group.at_s));
  words.replaceChildren(sentence, ...(group.count > 1 ? [" ", make("b", { className: "count", textContent: `×${group.count}` })] : []));
  if (group.count > 1) line.title = `${group.count} times since ${clockText(group.first_s)}`;
  line.dataset.tone = tone;
  list.append(line);
}

// Scrolls to the newest event, unless someone has scrolled up.
let following = true;
function follow() {
  if (following) log.scrollTop = log.scrollHeight;
}
log.addEventListener("scroll", () => {
  following = log.scrollTop + log.clientHeight >= log.scrollHeight - 40;
});
new ResizeObserver(follow).observe(log);

for (const [feed, textContent] of FEEDS) {
  const button = make("button", { type: "button", textContent, ariaPressed: String(feed === "all") });
  button.addEventListener("click", () => {
    log.dataset.feed = feed;
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
    groups = new EventGroups();
    list.replaceChildren();
  },
  onEvents(entries) {
    for (const entry of entries) {
      if (shown.has(entry.index)) continue;
      shown.add(entry.index);
      showEvent(entry);
    }
    while (list.childElementCount > MAX_LINES) list.firstChild?.remove();
    follow();
  },
};
