// Other vehicles in the 3D view, and their paths.

import * as THREE from "/three/three.module.min.js";
import { movedOn } from "./fleet.js";
import { TrackLine } from "./space_track.js";

export class Others {
  constructor() {
    this.group = new THREE.Group();
    /** Models by name. @type {Map<string, { model: THREE.Group, track: TrackLine }>} */
    this.shown = new Map();
  }

  /** Removes all; they are recreated in the room's colours. */
  clear() {
    for (const { model, track } of this.shown.values()) {
      model.removeFromParent();
      track.dispose();
    }
    this.shown.clear();
  }

  /**
   * @param {import("./space_room.js").Room} room
   * @param {import("./fleet.js").Other[]} others
   * @param {number} now_ms
   */
  show(room, others, now_ms) {
    const grey = room.colour("--muted");
    const names = new Set(others.map(({ name }) => name));
    for (const [name, { model, track }] of this.shown) model.visible = track.line.visible = names.has(name);
    for (const { name, pose, track } of others) {
      const other = this.shown.get(name) ?? this.add(room, name);
      other.model.position.set(...movedOn(pose, now_ms));
      other.model.quaternion.set(...pose.rotation);
      other.track.show(track, () => grey);
    }
  }

  /** @param {import("./space_room.js").Room} room @param {string} name */
  add(room, name) {
    const other = { model: room.addVehicle(1, "--muted"), track: new TrackLine() };
    other.model.visible = true;
    this.group.add(other.track.line);
    this.shown.set(name, other);
    return other;
  }
}
