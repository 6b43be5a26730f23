// Dark or light theme: the last choice in this browser, otherwise the system's preference.

const light = matchMedia("(prefers-color-scheme: light)");

/** Sets the theme of the document. */
function apply() {
  document.documentElement.dataset.theme = localStorage.getItem("theme") ?? (light.matches ? "light" : "dark");
}

/** Returns the current theme. */
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

/** Switches to the other theme, and stores the choice. */
export function switchTheme() {
  localStorage.setItem("theme", theme() === "light" ? "dark" : "light");
  apply();
}

/** Returns a function that reads colours of the style sheet by their names. */
export function cssColours() {
  const css = getComputedStyle(document.documentElement);
  return (/** @type {string} */ name) => css.getPropertyValue(name).trim();
}
