// Layout of the panels: columns, order, and closed panels, as stored in this browser. Pure; the page applies it.

/** @typedef {{ left: string[], right: string[], closed: string[] }} Layout names of panels, from top to bottom */

/**
 * Returns a stored layout, completed: unknown panels are dropped, missing panels get their default place.
 * @param {Layout} usual
 * @param {string | null} kept as `JSON.stringify` wrote it
 * @returns {Layout}
 */
export function readLayout(usual, kept) {
  const known = new Set([...usual.left, ...usual.right]);
  /** @type {Layout} */
  const layout = { left: [], right: [], closed: [] };
  const placed = new Set();
  const asked = parsed(kept);
  for (const side of /** @type {const} */ (["left", "right"]))
    for (const name of names(asked[side]))
      if (known.has(name) && !placed.has(name)) {
        placed.add(name);
        layout[side].push(name);
      }
  for (const side of /** @type {const} */ (["left", "right"]))
    for (const [k, name] of usual[side].entries()) if (!placed.has(name)) layout[side].splice(k, 0, name);
  layout.closed = [...new Set(names(asked.closed).filter((name) => known.has(name)))];
  return layout;
}

/** @param {string | null} kept @returns {Record<string, unknown>} */
function parsed(kept) {
  try {
    const value = JSON.parse(kept ?? "");
    return value && typeof value === "object" ? value : {};
  } catch {
    return {};
  }
}

/** @param {unknown} value @returns {string[]} */
const names = (value) => (Array.isArray(value) ? value.filter((name) => typeof name === "string") : []);

/**
 * Returns the layout with a panel moved: up or down in its column, or to the end of the other one.
 * @param {Layout} layout
 * @param {string} name
 * @param {"up" | "down" | "over"} way
 * @returns {Layout}
 */
export function moved(layout, name, way) {
  const side = layout.left.includes(name) ? "left" : "right";
  const other = side === "left" ? "right" : "left";
  const rest = layout[side].filter((one) => one !== name);
  if (way === "over") return { ...layout, [side]: rest, [other]: [...layout[other], name] };
  const at = layout[side].indexOf(name) + (way === "up" ? -1 : 1);
  if (at < 0 || at > rest.length) return layout;
  return { ...layout, [side]: [...rest.slice(0, at), name, ...rest.slice(at)] };
}

/**
 * Returns the layout with a panel put in a column before another one; without one, at its end.
 * @param {Layout} layout
 * @param {string} name
 * @param {"left" | "right"} side
 * @param {string} [before]
 * @returns {Layout}
 */
export function put(layout, name, side, before) {
  if (name === before || ![...layout.left, ...layout.right].includes(name)) return layout;
  const without = { ...layout, left: layout.left.filter((one) => one !== name), right: layout.right.filter((one) => one !== name) };
  const at = before === undefined ? -1 : without[side].indexOf(before);
  const place = at < 0 ? without[side].length : at;
  return { ...without, [side]: without[side].toSpliced(place, 0, name) };
}

/** Returns the layout with a panel closed, or reopened. @param {Layout} layout @param {string} name @returns {Layout} */
export function toggled(layout, name) {
  const closed = layout.closed.includes(name) ? layout.closed.filter((one) => one !== name) : [...layout.closed, name];
  return { ...layout, closed };
}
