// Dialogs and other layers over the page; escape closes the newest one. While any is open, escape does not stop a
// vehicle.

/** Functions that close each layer, the newest last. @type {(() => void)[]} */
const open = [];

/** Registers an opened layer. @param {() => void} close */
export function opened(close) {
  closed(close);
  open.push(close);
}

/** Removes a closed layer. @param {() => void} close */
export function closed(close) {
  const at = open.indexOf(close);
  if (at >= 0) open.splice(at, 1);
}

/**
 * Closes the newest layer; returns whether there was one. The browser closes an open select list. A layer that is
 * closed here is removed at once: a dialog's close event comes later, and the next escape must stop the vehicle.
 */
export function closeNewest() {
  if (CSS.supports("selector(select:open)") && document.querySelector("select:open")) return true;
  const close = open.pop();
  close?.();
  return close != null;
}
