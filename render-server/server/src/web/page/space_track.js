// A track in the 3D view: a line with a colour for each point. [m, world]

import * as THREE from "/three/three.module.min.js";
import { speedColour } from "./top_view.js";

/** @typedef {import("./top_view.js").TrackPoint} TrackPoint */

/** Maximum points of a track, as in the top view. */
const MAX_POINTS = 3000;

export class TrackLine {
  constructor() {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * MAX_POINTS), 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(3 * MAX_POINTS), 3));
    geometry.setDrawRange(0, 0);
    this.line = new THREE.Line(geometry, new THREE.LineBasicMaterial({ vertexColors: true }));
    this.line.frustumCulled = false;
    this.forget();
  }

  /** Forces a full redraw of the next track. */
  forget() {
    /** Part that is drawn already. @type {{ length: number, end: TrackPoint | undefined }} */
    this.drawn = { length: -1, end: undefined };
  }

  /**
   * Shows a track.
   * @param {TrackPoint[]} track
   * @param {(speed_mps: number) => THREE.Color} colourOf
   */
  show(track, colourOf) {
    const { length } = track, end = track.at(-1);
    if (length === this.drawn.length && end === this.drawn.end) return;
    this.drawn = { length, end };
    const { position, color } = this.line.geometry.attributes;
    const count = Math.min(length, MAX_POINTS);
    for (let k = 0; k < count; k++) {
      const [x, y, z, speed] = track[k];
      position.setXYZ(k, x, y, z);
      const colour = colourOf(speed);
      color.setXYZ(k, colour.r, colour.g, colour.b);
    }
    position.needsUpdate = color.needsUpdate = true;
    this.line.geometry.setDrawRange(0, count);
  }

  dispose() {
    this.line.removeFromParent();
    this.line.geometry.dispose();
    this.line.material.dispose();
  }
}

/** Returns a function from speed to colour. @param {number} fastest_mps */
export function speedColours(fastest_mps) {
  const colour = new THREE.Color();
  return (/** @type {number} */ speed_mps) => colour.setStyle(speedColour(speed_mps / Math.max(1, fastest_mps)).replaceAll(/(\d) (?=\d)/g, "$1,"));
}
