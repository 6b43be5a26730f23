// The camera settings: one form for the shown camera. Settings take effect with the next image. A change by another
// page refills the form, unless someone is typing in it.

import { make, makeFoldingPanel } from "../dom.js";
import { send, vehicleUrl } from "../session.js";

/** @typedef {import("../messages").Camera} Camera */

const CALIBRATED = /** @type {const} */ (["fx_px", "fy_px", "cx_px", "cy_px"]);
const NUMBERS = /** @type {const} */ (["width_px", "height_px", "near_m", "tilt_deg", "yaw_deg", "roll_deg"]);
const POSITION = /** @type {const} */ (["x_m", "y_m", "z_m"]);
const COEFFICIENTS = /** @type {const} */ (["k1", "k2", "p1", "p2", "k3", "k4"]);
/** The coefficients of each lens model. @type {Record<string, (typeof COEFFICIENTS)[number][]>} */
const LENSES = { "brown-conrady": ["k1", "k2", "p1", "p2", "k3"], "kannala-brandt": ["k1", "k2", "k3", "k4"] };
const MODELS = [
  ["fov", "pinhole by field of view"], ["pinhole", "pinhole, calibrated"],
  ["brown-conrady", "Brown-Conrady, calibrated"], ["kannala-brandt", "Kannala-Brandt fisheye, calibrated"],
];

/** Named image sensors and depth cameras; a test compares them with the server's. */
const SENSORS = ["imx219", "imx477", "ov5647", "ov9281", "imx296"];
const DEPTHS = ["d435", "azure-kinect", "tofcam-635"];

// ---- the form ----------------------------------------------------------------------------
/** The number fields by name. @type {Map<string, HTMLInputElement>} */
const fields = new Map();
/** Labels of coefficients that only some lens models have. @type {{ label: HTMLLabelElement, input: HTMLInputElement, models: string[] }[]} */
const lensFields = [];

/**
 * @param {string} label
 * @param {string} name
 * @param {string} unit
 * @param {Partial<HTMLInputElement>} [limits]
 */
function numberField(label, name, unit, limits = {}) {
  const input = make("input", { name, type: "number", step: "any", ...limits });
  fields.set(name, input);
  return make("label", {}, `${label} `, input, ` ${unit}`);
}

/**
 * @param {string} label
 * @param {string} name
 * @param {string} unit
 * @param {string[]} models
 */
function lensField(label, name, unit, models, limits = {}) {
  const field = numberField(label, name, unit, limits);
  lensFields.push({ label: field, input: number(name), models });
  return field;
}

/** @param {string} name */
function number(name) {
  const input = fields.get(name);
  if (!input) throw new Error(`no field ${name}`);
  return input;
}

const required = { required: true };
const pixels = { min: "1", max: "8192", step: "1", ...required };
const model = make("select", { name: "model" }, ...MODELS.map(([value, text]) => new Option(text, value)));
/** @param {string} name @param {string[]} names */
const sensorSelect = (name, names) =>
  make("select", { name }, new Option("perfect", ""), ...names.map((value) => new Option(value, value)));
const sensor = sensorSelect("sensor", SENSORS);
const depthModel = sensorSelect("depth_model", DEPTHS);
const status = make("span", { id: "camera-status", role: "status" });
const submit = make("p", {}, make("button", { type: "submit", textContent: "apply from the next image on" }), status);
submit.dataset.for = "instructor";
const calibrated = MODELS.slice(1).map(([value]) => value);
const form = make("form", { id: "camera-form", autocomplete: "off" },
  make("fieldset", {}, make("legend", { textContent: "image" }),
    numberField("width", "width_px", "px", pixels),
    numberField("height", "height_px", "px", pixels),
    numberField("at most", "rate_hz", "Hz", { min: "0.1", max: "1000", placeholder: "all" }),
    numberField("near", "near_m", "m", { min: "0.001", max: "100", ...required })),
  make("fieldset", {}, make("legend", { textContent: "lens" }),
    make("label", { className: "whole" }, "model ", model),
    lensField("view", "horizontal_fov_deg", "°", ["fov"], { min: "1", max: "170" }),
    ...CALIBRATED.map((name) => lensField(name.slice(0, 2), name, "px", calibrated)),
    ...COEFFICIENTS.map((name) => lensField(name, name, "", Object.keys(LENSES).filter((lens) => LENSES[lens].includes(name))))),
  make("fieldset", {}, make("legend", { textContent: "sensor" }),
    make("label", {}, "image ", sensor), make("label", {}, "depth ", depthModel)),
  make("fieldset", {}, make("legend", { textContent: "mounting on the body" }),
    numberField("ahead", "x_m", "m", required), numberField("left", "y_m", "m", required), numberField("up", "z_m", "m", required),
    numberField("tilt up", "tilt_deg", "°", required), numberField("turn left", "yaw_deg", "°", required),
    numberField("roll", "roll_deg", "°", required)),
  submit,
);

// ---- shown values ------------------------------------------------------------------------
let vehicle = "";
/** @type {Camera | undefined} */
let shown;

/**
 * Fills the form.
 * @param {Camera | undefined} camera
 * @param {boolean} again whether the camera was shown before: then text that is being typed is kept
 */
export function showSettings(camera, again) {
  const same = shown?.name === camera?.name;
  shown = camera;
  if (!camera || (again && same && form.contains(document.activeElement))) return;
  const set = (/** @type {string} */ name, /** @type {number | null | undefined} */ value) =>
    (number(name).value = value == null ? "" : String(+value.toFixed(9)));
  for (const name of NUMBERS) set(name, camera[name] ?? 0);
  set("rate_hz", camera.rate_hz);
  set("horizontal_fov_deg", camera.horizontal_fov_deg ?? 90);
  for (const name of CALIBRATED) set(name, camera.intrinsics[name]);
  for (const name of COEFFICIENTS) set(name, camera.distortion?.[name] ?? 0);
  for (const [axis, name] of POSITION.entries()) set(name, camera.position_m[axis]);
  sensor.value = camera.imaging?.sensor ?? "";
  depthModel.value = camera.imaging?.depth?.model ?? "";
  model.value = camera.distortion?.model ?? (camera.fx_px == null ? "fov" : "pinhole");
  showModel();
  if (!same) status.textContent = "";
}

function showModel() {
  for (const { label, input, models } of lensFields) {
    label.hidden = !models.includes(model.value);
    // A disabled field need not be valid.
    input.disabled = label.hidden;
  }
}
model.addEventListener("change", showModel);

/**
 * Returns the imaging settings of the form; other settings of the sensor are kept.
 * @param {Camera["imaging"]} shown
 */
function readImaging(shown) {
  const { depth, ...light } = shown ?? {};
  return {
    ...((light.sensor ?? "") === sensor.value ? light : sensor.value !== "" && { sensor: sensor.value }),
    ...(depthModel.value !== "" && { depth: depth?.model === depthModel.value ? depth : { model: depthModel.value } }),
  };
}

/**
 * Returns the camera that the form describes; settings without a field are kept.
 * @param {Camera} shown
 */
function read({ priority, depth, imaging }) {
  const value = (/** @type {string} */ name) => +number(name).value;
  const pick = (/** @type {readonly string[]} */ names) => Object.fromEntries(names.map((name) => [name, value(name)]));
  return {
    position_m: POSITION.map(value),
    ...pick(NUMBERS),
    ...(number("rate_hz").value !== "" && pick(["rate_hz"])),
    ...pick(model.value === "fov" ? ["horizontal_fov_deg"] : CALIBRATED),
    ...(priority != null && { priority }),
    ...(depth != null && { depth }),
    ...((imaging != null || sensor.value !== "" || depthModel.value !== "") && { imaging: readImaging(imaging) }),
    ...(model.value in LENSES && { distortion: { model: model.value, ...pick(LENSES[model.value]) } }),
  };
}

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  if (!shown) return;
  const { ok, text } = await send("PUT", `${vehicleUrl(vehicle)}/cameras/${encodeURIComponent(shown.name)}`, read(shown));
  status.dataset.tone = ok ? "good" : "bad";
  status.textContent = ok ? "applied" : text;
});

/** @type {import("../panels.js").Panel} */
export const cameraSettings = {
  element: makeFoldingPanel("setup", "cameras: size, lens, sensor, mounting", form),
  onArena(arena) {
    ({ vehicle } = arena);
  },
};
