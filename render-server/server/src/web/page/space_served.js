// Image of the twin from the server, for browsers that do not draw it: one image at a time, for the newest camera, and
// none while the camera rests.

import * as THREE from "/three/three.module.min.js";

/** Interval of the server's images. [ms] */
const EVERY_MS = 500;
/** Retry interval after a failure. [ms] */
const RETRY_MS = 2000;
/** Maximum size of the server's images. [px] */
const MAX_SIDE_PX = 960, MAX_PX = 960 * 540;
/** Three's cameras have y up and look along -z, the server's y down and look along z. */
const CAMERA_TURN = new THREE.Quaternion(1, 0, 0, 0);

/** An image and its query. @typedef {{ bitmap: ImageBitmap, camera: THREE.PerspectiveCamera, query: string }} Picture */

export class ServedTwin {
  /** @param {(text: string) => void} report receives the reason for which the image is missing; empty if it is not */
  constructor(report) {
    this.report = report;
    /** Newest image. @type {Picture | null} */
    this.picture = null;
    /** Query of the wanted image. */
    this.query = "";
    this.waits = false;
    this.due_ms = -Infinity;
    this.disposed = false;
  }

  /**
   * Prepares a frame: requests an image, if none exists for this camera.
   * @param {THREE.PerspectiveCamera} camera
   * @param {THREE.Vector2} viewport [px]
   * @param {import("./space_room.js").Room} room
   * @param {boolean} cut whether to omit what is between camera and fence
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

  /** Whether the image shows the wanted camera's view. */
  isCurrent() {
    return this.picture?.query === this.query;
  }

  dispose() {
    this.disposed = true;
    if (!this.waits) this.picture?.bitmap.close();
  }
}

/**
 * Returns the query of an image.
 * @param {THREE.PerspectiveCamera} camera
 * @param {THREE.Vector2} viewport [px]
 * @param {THREE.Color} background
 * @param {boolean} cut
 */
function query(camera, viewport, background, cut) {
  const scale = Math.min(1, MAX_SIDE_PX / viewport.x, MAX_SIDE_PX / viewport.y, Math.sqrt(MAX_PX / viewport.x / viewport.y));
  const [width, height] = [viewport.x, viewport.y].map((side) => Math.max(16, Math.floor(side * scale)));
  const [p, q] = [camera.position, camera.quaternion.clone().multiply(CAMERA_TURN)];
  // Resolution of a millimetre and half a pixel: smaller changes request no new image.
  return new URLSearchParams({
    x_m: p.x.toFixed(3), y_m: p.y.toFixed(3), z_m: p.z.toFixed(3),
    qx: q.x.toFixed(4), qy: q.y.toFixed(4), qz: q.z.toFixed(4), qw: q.w.toFixed(4),
    fov_deg: `${camera.fov}`, width_px: `${width}`, height_px: `${height}`, cut: `${cut}`, background: background.getHexString(),
  }).toString();
}
