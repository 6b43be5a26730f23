// The camera panel: colour and depth of one camera, or the objects in its view.

import { closed, opened } from "../closing.js";
import { context2d, make, setText } from "../dom.js";
import { showSettings } from "./camera_settings.js";

const [COLOUR, DEPTH, OBJECTS] = [0, 1, 2];

const tabs = make("nav", { id: "camera-tabs", ariaLabel: "cameras", hidden: true });
const name = make("span", { id: "camera-name", className: "muted" });
const colour = make("canvas", { id: "colour", width: 320, height: 240, role: "img", ariaLabel: "colour image" });
const depth = make("canvas", { id: "depth", width: 320, height: 240, role: "img", ariaLabel: "depth image" });
const kindButton = make("button", { id: "depth-kind", type: "button", className: "kind", hidden: true });
const word = make("span", { id: "depth-word", textContent: "depth" });
const scale = make("span", { className: "depth-scale", ariaLabel: "depth scale from 0.3 to 20 metres" },
  make("span", { textContent: "0.3" }), make("i"), make("span", { textContent: "20 m" }));
/** Sizes in addition to the column: side by side instead of all panels, or on the full screen. */
const SIZES = ["large", "full screen"];
const sizeButtons = SIZES.map((textContent) => make("button", { type: "button", textContent, ariaPressed: "false" }));
const element = make("section", { className: "cameras", ariaLabel: "what the vehicle sees" },
  tabs,
  make("figure", { className: "panel" }, colour,
    make("div", { className: "views", role: "group", ariaLabel: "size of the pictures" }, ...sizeButtons), make("figcaption", {}, "colour ", name)),
  make("figure", { className: "panel" }, depth, make("figcaption", {}, kindButton, word, " ", scale)),
);

/** @type {import("../messages").Camera[]} */
let cameras = [];
let picked = 0;
/** Kind of the second image. */
let second = DEPTH;
/** Kinds that are being decoded; images that arrive in the meantime are skipped. @type {Set<number>} */
const decoding = new Set();

/** @param {boolean} again whether the camera was shown before */
function showCamera(again) {
  const camera = cameras[picked];
  setText(name, camera ? `${camera.name} · ${camera.width_px} × ${camera.height_px}` : "");
  showSettings(camera, again);
}

/** @param {number} index */
function pick(index) {
  picked = index;
  for (const [k, tab] of [...tabs.children].entries()) tab.ariaPressed = String(k === index);
  showCamera(false);
}

/** @param {number} kind */
function showSecond(kind) {
  second = kind;
  setText(kindButton, kind === DEPTH ? "depth" : "objects");
  kindButton.ariaLabel = kind === DEPTH ? "show objects instead of depth" : "show depth instead of objects";
  scale.hidden = kind !== DEPTH;
}
kindButton.addEventListener("click", () => showSecond(second === DEPTH ? OBJECTS : DEPTH));
showSecond(DEPTH);

const shrink = () => showSize("");

/** @param {string} size one of `SIZES`; in the column, if it is empty */
async function showSize(size) {
  document.body.dataset.cameras = size ? "large" : "";
  for (const button of sizeButtons) button.ariaPressed = String(button.textContent === size);
  size ? opened(shrink) : closed(shrink);
  const isFull = document.fullscreenElement != null;
  if (size === "full screen" && !isFull) await document.documentElement.requestFullscreen().catch(() => {});
  else if (size !== "full screen" && isFull) await document.exitFullscreen();
}
for (const button of sizeButtons)
  button.addEventListener("click", () => showSize(button.ariaPressed === "true" ? "" : (button.textContent ?? "")));
// The browser uses escape to leave the full screen.
document.addEventListener("fullscreenchange", () => {
  if (!document.fullscreenElement) shrink();
});

/** @type {import("../panels.js").Panel} */
export const cameraImages = {
  element,
  onArena(arena) {
    ({ cameras } = arena);
    tabs.replaceChildren(
      ...cameras.map(({ name }, index) => make("button", { type: "button", textContent: name, onclick: () => pick(index) })),
    );
    tabs.hidden = cameras.length < 2;
    pick(Math.min(picked, cameras.length - 1));
  },
  onCameras(changed) {
    cameras = changed;
    showCamera(true);
  },
  async onImage(kind, camera, jpeg) {
    if (camera !== picked || decoding.has(kind)) return;
    if (kind === OBJECTS) {
      kindButton.hidden = false;
      word.hidden = true;
    }
    if (kind !== COLOUR && kind !== second) return;
    decoding.add(kind);
    try {
      const image = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
      const canvas = kind === COLOUR ? colour : depth;
      if (canvas.width !== image.width || canvas.height !== image.height)
        [canvas.width, canvas.height] = [image.width, image.height];
      context2d(canvas).drawImage(image, 0, 0);
      image.close();
    } catch {
      // Skip an image that does not decode; the next one follows.
    }
    decoding.delete(kind);
  },
};
