// Objects of one arena in the 3D view: fence, stages, goal, and the vehicle; floor and solid cells until the twin is
// loaded. World x east, y north, z up; [m, world] throughout.

import * as THREE from "/three/three.module.min.js";
import { cssColours } from "./theme.js";

/** @typedef {import("./messages").Arena} Arena */
/** @typedef {[x: number, y: number, z: number]} Point */

/** @param {readonly [number, number, number]} p */
export const vec = (p) => new THREE.Vector3(...p);

/**
 * Combines two points axis by axis.
 * @param {Point} a
 * @param {Point} b
 * @param {(a: number, b: number) => number} join
 * @returns {Point}
 */
export const joined = (a, b, join) => [join(a[0], b[0]), join(a[1], b[1]), join(a[2], b[2])];

/** Returns a function that reads colours of the style sheet by their names. */
function readColours() {
  const read = cssColours();
  return (/** @type {string} */ name) => new THREE.Color(read(name));
}

/** Returns the fence's box and its rotation; without a box, the map's area up to 4 m. @param {Arena} arena */
function fenceBox(arena) {
  if ("cuboid" in arena.fence) {
    const { center_m, half_m, rotation } = arena.fence.cuboid;
    const [lo, hi] = [joined(center_m, half_m, (c, h) => c - h), joined(center_m, half_m, (c, h) => c + h)];
    return { lo, hi, turn: new THREE.Quaternion(...rotation) };
  }
  /** @type {[Point, Point]} */
  const [lo, hi] = [[...arena.map_min_m, 0], [...arena.map_max_m, 4]];
  return { lo, hi, turn: new THREE.Quaternion() };
}

export class Room {
  /**
   * @param {Arena} arena
   * @param {string | undefined} theme
   */
  constructor(arena, theme) {
    this.arena = arena;
    this.colour = readColours();
    this.group = new THREE.Group();
    const { lo, hi, turn } = fenceBox(arena);
    /** Minimum corner of the fence. */
    this.lo = lo;
    this.size = joined(hi, lo, (h, l) => h - l);
    this.middle = vec(joined(lo, hi, (l, h) => (l + h) / 2));
    this.fenceTurn = turn;
    this.disposed = false;
    /** Placeholders until the twin is loaded. */
    this.stand = new THREE.Group();
    this.group.add(this.stand);
    this.addFloor(theme);
    this.fenceColour = this.addFence();
    /** Functions that set the colour of a stage. */
    this.stages = arena.stages.map((stage) => this.addStage(stage));
    if (arena.goal_m) this.addGoal(arena.goal_m);
    this.vehicle = this.addVehicle();
    /** Model of the ghost's vehicle, transparent. */
    this.ghost = this.addVehicle(0.4);
    this.shadow = this.addShadow();
  }

  /** @param {string | undefined} theme */
  addFloor(theme) {
    const { map_min_m: min, map_max_m: max, boot } = this.arena;
    const geometry = new THREE.PlaneGeometry(max[0] - min[0], max[1] - min[1]);
    const material = new THREE.MeshBasicMaterial({ color: this.colour("--floor"), side: THREE.DoubleSide });
    const floor = new THREE.Mesh(geometry, material);
    floor.position.set((min[0] + max[0]) / 2, (min[1] + max[1]) / 2, this.floorHeight() - 0.01);
    this.stand.add(floor);
    new THREE.TextureLoader().load(`/api/map?${boot}`, (texture) => {
      texture.colorSpace = THREE.SRGBColorSpace;
      material.map = texture;
      material.color.set(theme === "light" ? 0xffffff : 0x9aa4ae);
      material.needsUpdate = true;
    });
  }

  floorHeight() {
    return Math.max(0, this.lo[2]);
  }

  /** Adds the fence; returns its colour. */
  addFence() {
    const edges = new THREE.EdgesGeometry(new THREE.BoxGeometry(...this.size));
    const material = new THREE.LineBasicMaterial({ color: this.colour("--warn") });
    const fence = new THREE.LineSegments(edges, material);
    fence.position.copy(this.middle);
    fence.quaternion.copy(this.fenceTurn);
    this.group.add(fence);
    return material.color;
  }

  /**
   * Adds a stage: its opening, and an arrow in the direction of flight. Returns a function that sets its colour.
   * @param {Arena["stages"][number]} stage
   */
  addStage(stage) {
    const normal = vec(stage.normal).normalize();
    const up = Math.abs(normal.z) > 0.9 ? new THREE.Vector3(0, 1, 0) : new THREE.Vector3(0, 0, 1);
    const across = new THREE.Vector3().crossVectors(up, normal).normalize();
    const above = new THREE.Vector3().crossVectors(normal, across);
    const [w, h] = [stage.width_m / 2, stage.height_m / 2];
    const center = vec(stage.center_m);
    // To the left and up from the centre, in the direction of flight. [m]
    const corners = stage.polygon_m?.length ? stage.polygon_m : [[-w, -h], [w, -h], [w, h], [-w, h]];
    const outline = corners.map(([x, y]) => center.clone().addScaledVector(across, x).addScaledVector(above, y));
    const colour = this.colour("--accent");
    const frameMaterial = new THREE.LineBasicMaterial({ color: colour, linewidth: 2 });
    const paneMaterial = new THREE.MeshBasicMaterial({ color: colour, transparent: true, opacity: 0.16, side: THREE.DoubleSide, depthWrite: false });
    const shape = new THREE.Shape(corners.map(([x, y]) => new THREE.Vector2(x, y)));
    const pane = new THREE.Mesh(new THREE.ShapeGeometry(shape), paneMaterial);
    pane.position.copy(center);
    pane.quaternion.setFromRotationMatrix(new THREE.Matrix4().makeBasis(across, above, normal));
    const arrow = new THREE.ArrowHelper(normal, center, Math.max(0.3, w), colour, 0.16, 0.1);
    this.group.add(new THREE.LineLoop(new THREE.BufferGeometry().setFromPoints(outline), frameMaterial), pane, arrow);
    return (/** @type {THREE.Color} */ colour) => {
      for (const material of [frameMaterial, paneMaterial]) material.color.copy(colour);
      arrow.setColor(colour);
    };
  }

  /** @param {Point} at */
  addGoal(at) {
    const material = new THREE.MeshBasicMaterial({ color: this.colour("--good"), transparent: true, opacity: 0.22, depthWrite: false });
    const goal = new THREE.Mesh(new THREE.SphereGeometry(Math.max(0.15, this.arena.goal_radius_m), 24, 16), material);
    goal.position.set(...at);
    this.group.add(goal);
  }

  bodyRadius() {
    return Math.max(0.08, this.arena.body_radius_m);
  }

  /** Adds four rotors, a body and a nose, as large as the sphere that encloses the vehicle. @param {number} [opacity] @param {string} [colour] */
  addVehicle(opacity = 1, colour = "--accent") {
    const r = this.bodyRadius();
    const vehicle = new THREE.Group();
    const accent = new THREE.MeshLambertMaterial({ color: this.colour(colour), transparent: opacity < 1, opacity });
    const dark = new THREE.MeshLambertMaterial({ color: this.colour("--text"), transparent: opacity < 1, opacity });
    const body = new THREE.Mesh(new THREE.BoxGeometry(0.9 * r, 0.5 * r, 0.3 * r), accent);
    const nose = new THREE.Mesh(new THREE.ConeGeometry(0.24 * r, 0.6 * r, 12), accent);
    nose.rotation.z = -Math.PI / 2;
    nose.position.x = 0.7 * r;
    vehicle.add(body, nose);
    for (const [x, y] of [[1, 1], [1, -1], [-1, 1], [-1, -1]]) {
      const rotor = new THREE.Mesh(new THREE.CylinderGeometry(0.36 * r, 0.36 * r, 0.05 * r, 20), dark);
      rotor.rotation.x = Math.PI / 2;
      rotor.position.set(0.6 * r * x, 0.6 * r * y, 0.16 * r);
      vehicle.add(rotor);
    }
    vehicle.visible = false;
    this.group.add(vehicle);
    return vehicle;
  }

  /** Adds the vehicle's shadow on the floor. */
  addShadow() {
    const material = new THREE.MeshBasicMaterial({ color: 0x000000, transparent: true, opacity: 0.35, depthWrite: false });
    const shadow = new THREE.Mesh(new THREE.CircleGeometry(this.bodyRadius(), 24), material);
    shadow.visible = false;
    this.group.add(shadow);
    return shadow;
  }

  /** Fetches the solid cells, and adds them as boxes coloured by height. */
  async addSolid() {
    try {
      const answer = await fetch(`/api/shell?${this.arena.boot}`);
      if (!answer.ok) return;
      const bytes = await answer.arrayBuffer();
      if (this.disposed || bytes.byteLength <= 16) return;
      const [x0, y0, z0, cell] = new Float32Array(bytes, 0, 4);
      const places = new Uint16Array(bytes, 16);
      const count = places.length / 3;
      const mesh = new THREE.InstancedMesh(new THREE.BoxGeometry(cell, cell, cell), new THREE.MeshLambertMaterial(), count);
      const at = new THREE.Matrix4(), colour = new THREE.Color();
      const [low, high] = [this.colour("--solid-low"), this.colour("--solid-high")];
      const height = Math.max(0.1, this.size[2]);
      for (let k = 0; k < count; k++) {
        const z = z0 + (places[3 * k + 2] + 0.5) * cell;
        at.setPosition(x0 + (places[3 * k] + 0.5) * cell, y0 + (places[3 * k + 1] + 0.5) * cell, z);
        mesh.setMatrixAt(k, at);
        mesh.setColorAt(k, colour.lerpColors(low, high, Math.min(1, Math.max(0, (z - this.lo[2]) / height))));
      }
      this.stand.add(mesh);
    } catch {
      // Everything else is drawn without them.
    }
  }

  dispose() {
    this.disposed = true;
    this.group.traverse((node) => {
      if (!(node instanceof THREE.Mesh || node instanceof THREE.Line)) return;
      node.geometry.dispose();
      node.material.map?.dispose();
      node.material.dispose();
    });
    this.group.removeFromParent();
  }
}
