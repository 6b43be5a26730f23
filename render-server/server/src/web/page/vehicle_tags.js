// Name tags of vehicles in the views, if there are several. A click on a tag, or the vehicle's number on the keyboard,
// selects the vehicle.

import { make, setText } from "./dom.js";
import { PHASES } from "./phases.js";

/** @typedef {{ name: string, phase: string | null, at: readonly [number, number] | null }} Tagged at: position in the view, if visible [CSS px] */

export class VehicleTags {
  /** @param {((name: string) => void) | null} choose selects a vehicle; null without selection */
  constructor(choose) {
    this.choose = choose;
    this.element = make("div", { className: "tags" });
    /** Elements by name. @type {Map<string, HTMLElement>} */
    this.tags = new Map();
    /** All vehicles of the server. @type {string[]} */
    this.names = [];
    this.chosen = "";
    if (choose) addEventListener("keydown", (event) => this.onKey(event));
  }

  /** @param {string[]} names @param {string} chosen */
  setVehicles(names, chosen) {
    [this.names, this.chosen] = [names, chosen];
    this.tags.clear();
    this.element.replaceChildren();
  }

  /** Shows each vehicle's tag at the vehicle. @param {Tagged[]} vehicles */
  show(vehicles) {
    if (this.names.length < 2) return;
    const seen = new Set(vehicles.map(({ name }) => name));
    for (const [name, tag] of this.tags) if (!seen.has(name)) tag.hidden = true;
    for (const { name, phase, at } of vehicles) {
      const tag = this.tags.get(name) ?? this.add(name);
      tag.hidden = !at;
      if (!at) continue;
      setText(tag, `${this.names.indexOf(name) + 1} ${name}${phase && PHASES[phase] ? ` · ${PHASES[phase][1]}` : ""}`);
      tag.style.transform = `translate(${at[0].toFixed(1)}px, ${at[1].toFixed(1)}px)`;
    }
  }

  /** @param {string} name */
  add(name) {
    const isChosen = name === this.chosen;
    const { choose } = this;
    const tag = isChosen || !choose ? make("span") : make("button", { type: "button", title: "show this vehicle", onclick: () => choose(name) });
    if (isChosen) tag.dataset.chosen = "";
    this.element.append(tag);
    this.tags.set(name, tag);
    return tag;
  }

  /** @param {KeyboardEvent} event */
  onKey({ key, target, ctrlKey, metaKey, altKey }) {
    if (ctrlKey || metaKey || altKey || (target instanceof Element && target.closest("input, select, textarea, dialog"))) return;
    const name = this.names[Number(key) - 1];
    if (this.names.length > 1 && name && name !== this.chosen && this.tags.has(name)) this.choose?.(name);
  }
}
