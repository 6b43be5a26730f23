// DOM helpers of the page's scripts.

/**
 * Returns the element with this id; it must be in the page's HTML.
 * @template {HTMLElement} [T=HTMLElement]
 * @param {string} id
 * @param {new () => T} [kind] its class
 * @returns {T}
 */
export function $(id, kind = /** @type {any} */ (HTMLElement)) {
  const found = document.getElementById(id);
  if (!(found instanceof kind)) throw new Error(`no ${kind.name} #${id} on the page`);
  return found;
}

/**
 * Returns a new element.
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {Partial<HTMLElementTagNameMap[K]>} [properties]
 * @param {(Node | string)[]} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function make(tag, properties = {}, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}

/**
 * Returns a button with a text.
 * @param {string} textContent
 * @param {Partial<HTMLButtonElement>} [properties]
 */
export function makeButton(textContent, properties = {}) {
  return make("button", { type: "button", className: "ghost worded", textContent, ...properties });
}

/**
 * Returns a panel that folds by its summary line.
 * @param {string} id
 * @param {string} summary
 * @param {(Node | string)[]} children
 */
export function makeFoldingPanel(id, summary, ...children) {
  return make("details", { className: "panel setup", id }, make("summary", { textContent: summary }), ...children);
}

/**
 * Sets an element's text if it differs, because unchanged text needs no new layout.
 * @param {Node} node
 * @param {string} text
 */
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/**
 * Returns a canvas' drawing context.
 * @param {HTMLCanvasElement} canvas
 * @returns {CanvasRenderingContext2D}
 */
export function context2d(canvas) {
  const context = canvas.getContext("2d");
  if (!context) throw new Error("this browser does not support canvas");
  return context;
}

/**
 * Returns a number with this many digits; a dash without a number. Adding zero turns -0 into 0.
 * @param {number | null | undefined} value
 * @param {number} digits
 */
export function fixed(value, digits) {
  return Number.isFinite(value) ? (+Number(value).toFixed(digits) + 0).toFixed(digits) : "–";
}

/**
 * Returns minutes and seconds.
 * @param {number} s
 */
export function clockText(s) {
  return `${Math.floor(s / 60)}:${(s % 60).toFixed(1).padStart(4, "0")}`;
}
