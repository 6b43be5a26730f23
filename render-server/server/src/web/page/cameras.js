// The cameras panel: one form for the camera that is shown. What is applied takes effect with the
// next image; another page's change fills the form anew unless someone is typing in it.

import { order } from "/controls.js";

const CALIBRATED = ["fx_px", "fy_px", "cx_px", "cy_px"];
const NUMBERS = ["width_px", "height_px", "near_m", "tilt_deg", "yaw_deg", "roll_deg"];
const LENS = { "brown-conrady": ["k1", "k2", "p1", "p2", "k3"], "kannala-brandt": ["k1", "k2", "k3", "k4"] };

export class CameraForm {
  constructor(form, said) {
    [this.form, this.said, this.camera] = [form, said, null];
    /** Where the vehicle is: `/api/vehicles/NAME`. */
    this.vehicle = null;
    form.model.addEventListener("change", () => this.showModel());
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.apply();
    });
  }

  /** Shows a camera, as `/api/vehicles/NAME/cameras` has it; `again` leaves what is being typed. */
  show(camera, again) {
    const same = this.camera?.name === camera?.name;
    this.camera = camera;
    if (!camera || (again && same && this.form.contains(document.activeElement))) return;
    const { form } = this;
    const set = (name, value) => (form[name].value = value == null ? "" : +(+value).toFixed(9));
    for (const name of NUMBERS) set(name, camera[name] ?? 0);
    set("rate_hz", camera.rate_hz);
    set("horizontal_fov_deg", camera.horizontal_fov_deg ?? 90);
    for (const name of CALIBRATED) set(name, camera.intrinsics[name]);
    const lens = camera.distortion;
    for (const name of ["k1", "k2", "k3", "k4", "p1", "p2"]) set(name, lens?.[name] ?? 0);
    ["x_m", "y_m", "z_m"].forEach((name, axis) => set(name, camera.position_m[axis]));
    form.model.value = lens?.model ?? (camera.fx_px == null ? "fov" : "pinhole");
    this.showModel();
    if (!same) this.said.textContent = "";
  }

  showModel() {
    const model = this.form.model.value;
    for (const label of this.form.querySelectorAll("[data-of]")) {
      label.hidden = !label.dataset.of.split(" ").includes(model);
      // What is not shown need not be valid.
      label.querySelector("input").disabled = label.hidden;
    }
  }

  /** Returns the whole camera that the form says. */
  read() {
    const { form } = this;
    const number = (name) => +form[name].value;
    const camera = { position_m: ["x_m", "y_m", "z_m"].map(number) };
    for (const name of NUMBERS) camera[name] = number(name);
    if (form.rate_hz.value !== "") camera.rate_hz = number("rate_hz");
    const model = form.model.value;
    if (model === "fov") camera.horizontal_fov_deg = number("horizontal_fov_deg");
    else for (const name of CALIBRATED) camera[name] = number(name);
    // What the form does not show stays as it is.
    for (const name of ["priority", "depth"]) if (this.camera[name] != null) camera[name] = this.camera[name];
    if (LENS[model]) {
      camera.distortion = { model };
      for (const name of LENS[model]) camera.distortion[name] = number(name);
    }
    return camera;
  }

  async apply() {
    if (!this.camera) return;
    let text, good = false;
    try {
      const answer = await order("PUT", `${this.vehicle}/cameras/${encodeURIComponent(this.camera.name)}`, this.read());
      good = answer.ok;
      text = good ? "applied" : await answer.text();
    } catch {
      text = "the server cannot be reached";
    }
    this.said.dataset.tone = good ? "good" : "bad";
    this.said.textContent = text;
  }
}
