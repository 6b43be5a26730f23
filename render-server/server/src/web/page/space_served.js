// The twin in the view in space where the browser does not draw it: pictures that the server draws, one at a time, for the
// newest camera, and none while the camera rests.

import * as THREE from "/three/three.module.min.js";

/** As many as the server draws. [ms] */
const EVERY_MS = 500;
/** After a picture that did not come. [ms] */
const RETRY_MS = 2000;
/** The largest that the server draws. [px] */
const MAX_SIDE_PX = 960, MAX_PX = 960 * 540;
/** Three's cameras have y up and look along -z, the server's y down and look along z. */
const CAMERA_TURN = new THREE.Quaternion(1, 0, 0, 0);

/** A picture, and what it was asked for with. @typedef {{ bitmap: ImageBitmap, camera: THREE.PerspectiveCamera, query: string }} Picture */

export class ServedTwin {
  /** @param {(text: string) => void} report told why there is no picture; nothing, if there is one */
  constructor(report) {
    this.report = report;
    /** The newest. @type {Picture | null} */
    this.picture = null;
    /** What the picture that is wanted now is asked for with. */
    this.query = "";
    this.waits = false;
    this.due_ms = -Infinity;
    this.disposed = false;
  }

  /**
   * Prepares for an image: asks for a picture, if none is there of this camera.
   * @param {THREE.PerspectiveCamera} camera
   * @param {THREE.Vector2} viewport [px]
   * @param {import("./space_room.js").Room} room
   * @param {boolean} cut whether what lies between camera and fence is left out
   */
  place(camera, viewport, room, cut) {
    this.query = query(camera, viewport, room.colour("--map-bg"), cut);
    const now_ms = performance.now();
    if (this.waits || now_ms < this.due_ms || this.query === this.picture?.query) return;
    this.waits = true;
    this.due_ms = now_ms + EVERY_MS;
    this.fetch(camera.clone(), this.query);
  }

  /** @param {THREE.PerspectiveCamera} camera @param {string} query */
  async fetch(camera, query) {
    try {
      const answer = await fetch(`/api/twin?${query}`);
      if (!answer.ok) throw new Error(await answer.text());
      const bitmap = await createImageBitmap(await answer.blob());
      this.picture?.bitmap.close();
      this.picture = { bitmap, camera, query };
      if (!this.disposed) this.report("");
    } catch (error) {
      this.due_ms = performance.now() + RETRY_MS;
      if (!this.disposed) this.report(error instanceof Error ? error.message : String(error));
    }
    this.waits = false;
    if (this.disposed) this.picture?.bitmap.close();
  }

  /** Whether the picture is of the camera that is wanted now. */
  isCurrent() {
    return this.picture?.query === this.query;
  }

  dispose() {
    this.disposed = true;
    if (!this.waits) this.picture?.bitmap.close();
  }
}

/**
 * Returns what a picture is asked for with.
 * @param {THREE.PerspectiveCamera} camera
 * @param {THREE.Vector2} viewport [px]
 * @param {THREE.Color} background
 * @param {boolean} cut
 */
function query(camera, viewport, background, cut) {
  const scale = Math.min(1, MAX_SIDE_PX / viewport.x, MAX_SIDE_PX / viewport.y, Math.sqrt(MAX_PX / viewport.x / viewport.y));
  const [width, height] = [viewport.x, viewport.y].map((side) => Math.max(16, Math.floor(side * scale)));
  const [p, q] = [camera.position, camera.quaternion.clone().multiply(CAMERA_TURN)];
  // A millimetre, and half a pixel: less is no other picture.
  return new URLSearchParams({
    x_m: p.x.toFixed(3), y_m: p.y.toFixed(3), z_m: p.z.toFixed(3),
    qx: q.x.toFixed(4), qy: q.y.toFixed(4), qz: q.z.toFixed(4), qw: q.w.toFixed(4),
    fov_deg: `${camera.fov}`, width_px: `${width}`, height_px: `${height}`, cut: `${cut}`, background: background.getHexString(),
  }).toString();
}
