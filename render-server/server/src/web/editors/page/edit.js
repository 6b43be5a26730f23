// The panel of `vizflyt scene edit --page`: a lasso or a box in the image selects splats. The server finds and colours
// them. The selection can be deleted, with undo, or named as a part of the scene.

import { view } from "/view.js";

const { canvas } = view;
let tool = null; // "lasso", "box", or null: the mouse turns the camera.
let drawn = null; // Corners on the screen, while the button is down. [px]
let shown = null; // Request of the shown image.
let report = null, busy = false;
view.listeners.push((request) => (shown = request));

// ---- the panel -------------------------------------------------------------------------------
const make = (tag, properties = {}, ...children) => {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
};
const button = (id, text, onclick) => make("button", { id, type: "button", textContent: text, onclick });
const row = (...children) => make("div", { className: "row" }, ...children);

const tools = { lasso: button("edit-lasso", "lasso", () => choose("lasso")), box: button("edit-box", "box", () => choose("box")) };
const visible = make("input", { id: "edit-visible", type: "checkbox", checked: true });
const counts = make("p", { id: "edit-counts" });
const orders = {
  invert: button("edit-invert", "invert", () => order("invert")),
  clear: button("edit-clear", "clear", () => order("clear")),
  delete: button("edit-delete", "delete", () => order("delete")),
  undo: button("edit-undo", "undo", () => order("undo")),
  save: button("edit-save", "save", () => order("save")),
};
const steps = make("ol", { id: "edit-steps" });
const output = make("p", { id: "edit-output" });
const name = make("input", { id: "edit-name", placeholder: "window 1", maxLength: 60 });
const kind = make("input", { id: "edit-class", placeholder: "part", maxLength: 60 });
const call = button("edit-call", "name it", () => order({ name: { name: name.value, class: kind.value || "part" } }));
const parts = make("ul", { id: "edit-parts" });
const overlay = make("canvas", { id: "lasso" });
overlay.ariaHidden = "true";
document.head.append(make("link", { rel: "stylesheet", href: "/edit.css" }));
document.body.append(overlay, make("section", { id: "edit", ariaLabel: "edit" },
  make("h2", { textContent: "edit" }),
  row(tools.lasso, tools.box),
  make("label", {}, visible, "only what is in front"),
  counts,
  row(orders.invert, orders.clear, orders.delete),
  row(orders.undo, orders.save),
  steps,
  output,
  make("details", { id: "edit-naming" },
    make("summary", { textContent: "parts, for data sets" }),
    make("label", {}, "name", name),
    make("label", {}, "class", kind),
    row(call),
    parts,
  ),
));
for (const input of [name, kind]) input.addEventListener("keydown", (event) => event.code === "Enter" && !call.disabled && call.click());

function choose(next) {
  tool = tool === next ? null : next;
  for (const [name, node] of Object.entries(tools)) node.setAttribute("aria-pressed", `${name === tool}`);
  document.body.classList.toggle("selects", tool !== null);
}

function show() {
  const count = (number) => number.toLocaleString("en");
  counts.textContent = report ? `${count(report.selected)} of ${count(report.splats)} splats selected` : "";
  const nothing = !report?.selected;
  orders.invert.disabled = orders.clear.disabled = orders.delete.disabled = busy || nothing;
  call.disabled = busy || nothing;
  orders.undo.disabled = busy || !report?.steps.length;
  orders.save.disabled = busy || !report || report.saved;
  steps.replaceChildren(...(report?.steps ?? []).map((text) => make("li", { textContent: text })));
  parts.replaceChildren(...(report?.parts ?? []).map((text) => make("li", { textContent: text })));
  output.textContent = report ? `${!report.saved ? "not saved yet:" : report.steps.length ? "saved as" : "saves to"} ${report.output}` : "";
}

// ---- the server ------------------------------------------------------------------------------
async function order(what) {
  if (busy) return;
  busy = true;
  show();
  try {
    const answer = await fetch("/api/edit", { method: "POST", body: JSON.stringify(what) });
    if (answer.ok) {
      report = await answer.json();
      if (what.name) name.value = "";
      if (report.said) view.announce(report.said);
    } else {
      view.announce(await answer.text());
    }
  } catch {
    view.announce("connection lost; restart the server, and reload this page");
  }
  busy = false;
  show();
  view.changed(false);
}

// ---- drawing ---------------------------------------------------------------------------------
function draw() {
  [overlay.width, overlay.height] = [innerWidth, innerHeight];
  const context = overlay.getContext("2d");
  if (!drawn) return;
  context.beginPath();
  for (const [x, y] of drawn) context.lineTo(x, y);
  context.closePath();
  context.fillStyle = "rgb(255 140 40 / .25)";
  context.fill();
  context.lineWidth = 2;
  context.strokeStyle = "#ff9a3c";
  context.stroke();
}

// Before the handlers of the view, which turn the camera.
const take = (type, handle) => canvas.addEventListener(type, (event) => {
  if (!tool && !drawn) return;
  event.stopImmediatePropagation();
  handle(event);
}, { capture: true });

take("pointerdown", (event) => {
  if (busy || !event.isPrimary) return;
  canvas.setPointerCapture(event.pointerId);
  drawn = [[event.clientX, event.clientY]];
});
take("pointermove", (event) => {
  if (!drawn || !event.isPrimary) return;
  const at = [event.clientX, event.clientY], [first] = drawn;
  if (tool === "box") drawn = [first, [at[0], first[1]], at, [first[0], at[1]]];
  else if (Math.hypot(at[0] - drawn.at(-1)[0], at[1] - drawn.at(-1)[1]) > 3 && drawn.length < 1500) drawn.push(at);
  draw();
});
take("pointerup", (event) => {
  const corners = drawn?.map(([x, y]) => [x / innerWidth, y / innerHeight]);
  drawn = null;
  draw();
  if (!corners || corners.length < 3 || !shown) return;
  order({ select: { request: shown, corners, visible: visible.checked, adds: event.shiftKey } });
});
take("pointercancel", () => {
  drawn = null;
  draw();
});
addEventListener("keydown", (event) => {
  if (event.target instanceof HTMLInputElement) return;
  if (event.code === "Escape") tool ? choose(tool) : order("clear");
  else if (event.code === "Delete" && report?.selected) order("delete");
  else if (event.code === "KeyZ" && (event.ctrlKey || event.metaKey) && report?.steps.length) order("undo");
});

show();
order("report");
