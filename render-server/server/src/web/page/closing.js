// What lies over the page and is closed by escape, the newest first. While anything is open, escape stops no vehicle.

/** How each is closed, the newest last. @type {(() => void)[]} */
const open = [];

/** Notes what has opened. @param {() => void} close */
export function opened(close) {
  closed(close);
  open.push(close);
}

/** Notes what has closed. @param {() => void} close */
export function closed(close) {
  const at = open.indexOf(close);
  if (at >= 0) open.splice(at, 1);
}

/**
 * Closes the newest; returns whether there was one. A list of choices that hangs open is the browser's to close. What is closed
 * here counts as closed at once: a dialog tells so only later, and the next escape must stop the vehicle.
 */
export function closeNewest() {
  if (CSS.supports("selector(select:open)") && document.querySelector("select:open")) return true;
  const close = open.pop();
  close?.();
  return close != null;
}
