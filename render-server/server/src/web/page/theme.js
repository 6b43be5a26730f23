// Dark or light: what was chosen here last, else what the system prefers.

const light = matchMedia("(prefers-color-scheme: light)");

/** Sets the theme of the document. */
function apply() {
  document.documentElement.dataset.theme = localStorage.getItem("theme") ?? (light.matches ? "light" : "dark");
}

/** Returns the theme that is shown. */
export const theme = () => document.documentElement.dataset.theme;

/**
 * Keeps the document in the chosen theme.
 * @param {() => void} [changed] called after each change
 */
export function followTheme(changed = () => {}) {
  light.addEventListener("change", () => {
    apply();
    changed();
  });
  apply();
}

/** Changes to the other theme, and remembers it. */
export function switchTheme() {
  localStorage.setItem("theme", theme() === "light" ? "dark" : "light");
  apply();
}

/** Returns a function that reads colours of the style sheet by their names. */
export function cssColours() {
  const css = getComputedStyle(document.documentElement);
  return (/** @type {string} */ name) => css.getPropertyValue(name).trim();
}
