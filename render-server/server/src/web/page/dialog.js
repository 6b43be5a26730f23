// Dialogs over the page. The stop button stays visible; escape closes the dialog first, and stops only then.

import { closed, opened } from "./closing.js";
import { make, makeButton } from "./dom.js";

/**
 * Returns a closed dialog. `openFrom` opens it, and returns the focus to the button when it closes.
 * @param {string} title
 * @param {(Node | string)[]} content
 */
export function makeDialog(title, ...content) {
  const heading = make("h2", { textContent: title, id: `dialog-${title.replaceAll(" ", "-")}` });
  const dialog = make("dialog", { className: "panel sheet" }, heading, ...content);
  dialog.setAttribute("aria-labelledby", heading.id);
  document.body.append(dialog);
  /** @type {HTMLElement | null} */
  let opener = null;
  const close = () => dialog.close();
  dialog.addEventListener("close", () => {
    closed(close);
    opener?.focus();
  });
  return Object.assign(dialog, {
    /** @param {HTMLElement} button */
    openFrom(button) {
      opener = button;
      if (!dialog.open) dialog.show();
      opened(close);
    },
  });
}

/**
 * Returns a dialog with a form: its fields, a status line, and two buttons.
 * @param {string} title
 * @param {string} action the name of the button that submits
 * @param {"alert" | "status"} role of the status line
 * @param {(Node | string)[]} fields
 */
export function makeFormDialog(title, action, role, ...fields) {
  const status = make("p", { className: "dialog-status", role });
  const close = makeButton("close", { onclick: () => dialog.close() });
  const submit = makeButton(action, { type: "submit" });
  const form = make("form", {}, ...fields, status, make("p", { className: "choices" }, submit, close));
  form.addEventListener("submit", (event) => event.preventDefault());
  const dialog = makeDialog(title, form);
  return { dialog, form, status };
}

/**
 * Returns a label for a field with an id.
 * @param {HTMLElement} field
 * @param {string} textContent
 */
export const makeLabel = (field, textContent) => make("label", { htmlFor: field.id, textContent });

/**
 * Fills a list of choices.
 * @param {HTMLSelectElement} select
 * @param {string[]} names
 * @param {string | null} [chosen]
 */
export function fillChoices(select, names, chosen) {
  select.replaceChildren(...names.map((name) => new Option(name, name, false, name === chosen)));
}
