// Layout of the panels: visibility, column and order, stored in this browser.

import { makeDialog } from "../dialog.js";
import { $, make, makeButton } from "../dom.js";
import { moved, put, readLayout, toggled } from "../layout.js";
import { PANELS } from "../panels.js";

const KEPT = "panels";
const SIDES = /** @type {const} */ (["left", "right"]);
/** @type {Record<string, import("../panels.js").Panel>} */
const panels = { ...PANELS.left, ...PANELS.right };
const usual = { left: Object.keys(PANELS.left), right: Object.keys(PANELS.right), closed: [] };
let layout = readLayout(usual, localStorage.getItem(KEPT));
/** Name of the panel whose row is dragged; empty without one. */
let dragged = "";

const lists = { left: make("ol"), right: make("ol") };
const reset = makeButton("reset", { onclick: () => change({ ...usual }) });
const close = makeButton("close", { onclick: () => dialog.close() });
const dialog = makeDialog("panels",
  make("h3", { textContent: "left column" }), lists.left, make("h3", { textContent: "right column" }), lists.right,
  make("p", { className: "choices" }, reset, close));
dialog.classList.add("arrange");

/** Puts the panels into their places. */
function apply() {
  for (const side of SIDES) {
    const open = layout[side].filter((name) => !layout.closed.includes(name));
    $(side).replaceChildren(...open.map((name) => panels[name].element));
    lists[side].replaceChildren(...layout[side].map(makeRow));
  }
}

/** @param {import("../layout.js").Layout} next */
function change(next) {
  const focused = document.activeElement?.ariaLabel;
  layout = next;
  localStorage.setItem(KEPT, JSON.stringify(layout));
  apply();
  // Restore the focus, so that the same button can be pressed again.
  if (focused) /** @type {HTMLElement | null} */ (dialog.querySelector(`[aria-label="${CSS.escape(focused)}"]`))?.focus();
}

/** @param {string} name */
function makeRow(name) {
  const shown = make("input", { type: "checkbox", checked: !layout.closed.includes(name), ariaLabel: name, onchange: () => change(toggled(layout, name)) });
  const way = (/** @type {"up" | "down" | "over"} */ to, /** @type {string} */ sign, /** @type {string} */ words) =>
    makeButton(sign, { ariaLabel: `${name} ${words}`, title: words, onclick: () => change(moved(layout, name, to)) });
  const row = make("li", { draggable: true }, make("label", {}, shown, ` ${name}`),
    way("up", "↑", "up"), way("down", "↓", "down"), way("over", "⇄", "to the other column"));
  row.dataset.panel = name;
  row.addEventListener("dragstart", () => (dragged = name));
  row.addEventListener("dragend", () => (dragged = ""));
  return row;
}

/** Accepts dropped rows of both columns. @param {"left" | "right"} side */
function takeDrops(side) {
  const list = lists[side];
  /** Returns the row before which to drop. @param {DragEvent} event @returns {HTMLElement | undefined} */
  const below = ({ clientY }) =>
    /** @type {HTMLElement[]} */ ([...list.children]).find((row) => {
      const { top, height } = row.getBoundingClientRect();
      return clientY < top + height / 2;
    });
  list.addEventListener("dragover", (event) => {
    if (dragged) event.preventDefault();
  });
  list.addEventListener("drop", (event) => {
    event.preventDefault();
    if (dragged) change(put(layout, dragged, side, below(event)?.dataset.panel));
  });
}

SIDES.forEach(takeDrops);

apply();
$("arrange").addEventListener("click", () => dialog.openFrom($("arrange")));
