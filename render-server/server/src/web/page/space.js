// The view in space: floor, what is solid, fence, gates, goal, moving objects, trail, vehicle. World
// x east, y north, z up; [m, world] throughout. Drag turns, right drag or two fingers shift, the
// wheel zooms; with the keyboard: arrows turn, + and - zoom, 0 goes back, F follows the vehicle.

import * as THREE from "/three.module.min.js";
import { speedColour } from "/map.js";

/** Points of the trail at most; as many as the top view keeps. */
const MOST_POINTS = 3000;
/** Thirty pictures a second are smooth, and leave a machine without a card to the flight. [ms] */
const EVERY_MS = 1000 / 31;

const vec = (p) => new THREE.Vector3(...p);

/** Returns whether a graphics card draws; in software it would take the processor from the flight. */
export function hasCard() {
  const canvas = document.createElement("canvas");
  const gl = canvas.getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  if (!gl) return false;
  const told = gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER;
  const name = String(gl.getParameter(told));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|software/i.test(name);
}

export class SpaceView {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.02, 500);
    this.camera.up.set(0, 0, 1);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x445566, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(-0.4, -0.7, 1);
    this.scene.add(sun);
    this.room = new THREE.Group();
    this.moving = new THREE.Group();
    this.scene.add(this.room, this.moving);
    this.drawn_at = -1e9;
    this.follows = false;
    this.trailLength = -1;
    this.makeTrail();
    this.listen();
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  // ---- what stands -----------------------------------------------------------------------
  setArena(arena, style) {
    this.arena = arena;
    this.style = style;
    this.dispose(this.room);
    this.objects = [];
    this.moving.clear();
    const box = arena.fence.cuboid;
    const [lo, hi] = box
      ? [box.center_m.map((c, k) => c - box.half_m[k]), box.center_m.map((c, k) => c + box.half_m[k])]
      : [[...arena.map_min_m, 0], [...arena.map_max_m, 4]];
    this.lo = lo;
    this.hi = hi;
    this.addFloor();
    this.addFence(box);
    this.stages = arena.stages.map((stage) => this.addStage(stage));
    if (arena.goal_m) this.addGoal();
    this.addVehicle();
    this.addShell();
    this.home();
    this.resize();
  }

  colour(name) {
    return new THREE.Color(this.style[name]);
  }

  line(points, colour, width = 1, closed = false) {
    const geometry = new THREE.BufferGeometry().setFromPoints(points.map(vec));
    const material = new THREE.LineBasicMaterial({ color: colour, linewidth: width });
    return closed ? new THREE.LineLoop(geometry, material) : new THREE.Line(geometry, material);
  }

  addFloor() {
    const [min, max] = [this.arena.map_min_m, this.arena.map_max_m];
    const geometry = new THREE.PlaneGeometry(max[0] - min[0], max[1] - min[1]);
    const material = new THREE.MeshBasicMaterial({ color: this.colour("floor"), side: THREE.DoubleSide });
    const floor = new THREE.Mesh(geometry, material);
    floor.position.set((min[0] + max[0]) / 2, (min[1] + max[1]) / 2, Math.max(0, this.lo[2]) - 0.01);
    this.room.add(floor);
    new THREE.TextureLoader().load(`/api/map?${this.arena.boot}`, (texture) => {
      texture.colorSpace = THREE.SRGBColorSpace;
      material.map = texture;
      material.color.set(this.style.theme === "light" ? 0xffffff : 0x9aa4ae);
      material.needsUpdate = true;
    });
  }

  addFence(box) {
    const size = this.hi.map((h, k) => h - this.lo[k]);
    const edges = new THREE.EdgesGeometry(new THREE.BoxGeometry(...size));
    this.fence = new THREE.LineSegments(edges, new THREE.LineBasicMaterial({ color: this.colour("warn") }));
    this.fence.position.set(...this.lo.map((l, k) => (l + this.hi[k]) / 2));
    if (box?.rotation) this.fence.quaternion.set(...box.rotation);
    this.room.add(this.fence);
  }

  /** A gate: its opening, and an arrow the way it is to be flown. */
  addStage(stage) {
    const normal = vec(stage.normal).normalize();
    const up = Math.abs(normal.z) > 0.9 ? new THREE.Vector3(0, 1, 0) : new THREE.Vector3(0, 0, 1);
    const across = new THREE.Vector3().crossVectors(up, normal).normalize();
    const above = new THREE.Vector3().crossVectors(normal, across);
    const [w, h] = [stage.width_m / 2, (stage.height_m ?? stage.width_m) / 2];
    const c = vec(stage.center_m);
    // To the left and up from the centre, as one flies through. [m]
    const outline = stage.polygon_m?.length ? stage.polygon_m : [[-w, -h], [w, -h], [w, h], [-w, h]];
    const corner = ([x, y]) => c.clone().addScaledVector(across, x).addScaledVector(above, y).toArray();
    const colour = this.colour("accent");
    const frame = this.line(outline.map(corner), colour, 2, true);
    const pane = new THREE.Mesh(
      new THREE.ShapeGeometry(new THREE.Shape(outline.map(([x, y]) => new THREE.Vector2(x, y)))),
      new THREE.MeshBasicMaterial({ color: colour, transparent: true, opacity: 0.16, side: THREE.DoubleSide, depthWrite: false }),
    );
    pane.position.copy(c);
    pane.quaternion.setFromRotationMatrix(new THREE.Matrix4().makeBasis(across, above, normal));
    const arrow = new THREE.ArrowHelper(normal, c, Math.max(0.3, w), colour, 0.16, 0.1);
    this.room.add(frame, pane, arrow);
    return (tone) => {
      for (const part of [frame, pane]) part.material.color.copy(this.colour(tone));
      arrow.setColor(this.colour(tone));
    };
  }

  addGoal() {
    const material = new THREE.MeshBasicMaterial({ color: this.colour("good"), transparent: true, opacity: 0.22, depthWrite: false });
    const goal = new THREE.Mesh(new THREE.SphereGeometry(Math.max(0.15, this.arena.goal_radius_m), 24, 16), material);
    goal.position.set(...this.arena.goal_m);
    this.room.add(goal);
  }

  /** Four rotors, a body and a nose, as large as the sphere that encloses the vehicle. */
  addVehicle() {
    const r = Math.max(0.08, this.arena.body_radius_m);
    this.vehicle = new THREE.Group();
    const accent = new THREE.MeshLambertMaterial({ color: this.colour("accent") });
    const dark = new THREE.MeshLambertMaterial({ color: this.colour("text") });
    const body = new THREE.Mesh(new THREE.BoxGeometry(0.9 * r, 0.5 * r, 0.3 * r), accent);
    const nose = new THREE.Mesh(new THREE.ConeGeometry(0.24 * r, 0.6 * r, 12), accent);
    nose.rotation.z = -Math.PI / 2;
    nose.position.x = 0.7 * r;
    this.vehicle.add(body, nose);
    for (const [x, y] of [[1, 1], [1, -1], [-1, 1], [-1, -1]]) {
      const rotor = new THREE.Mesh(new THREE.CylinderGeometry(0.36 * r, 0.36 * r, 0.05 * r, 20), dark);
      rotor.rotation.x = Math.PI / 2;
      rotor.position.set(0.6 * r * x, 0.6 * r * y, 0.16 * r);
      this.vehicle.add(rotor);
    }
    this.vehicle.visible = false;
    this.shadow = new THREE.Mesh(
      new THREE.CircleGeometry(r, 24),
      new THREE.MeshBasicMaterial({ color: 0x000000, transparent: true, opacity: 0.35, depthWrite: false }),
    );
    this.shadow.visible = false;
    this.room.add(this.vehicle, this.shadow);
  }

  /** What is solid, as boxes coloured by height. */
  async addShell() {
    const arena = this.arena;
    try {
      const answer = await fetch(`/api/shell?${arena.boot}`);
      if (!answer.ok) return;
      const bytes = await answer.arrayBuffer();
      if (this.arena !== arena || bytes.byteLength <= 16) return;
      const [x0, y0, z0, cell] = new Float32Array(bytes, 0, 4);
      const places = new Uint16Array(bytes, 16);
      const count = places.length / 3;
      const mesh = new THREE.InstancedMesh(
        new THREE.BoxGeometry(cell, cell, cell),
        new THREE.MeshLambertMaterial(),
        count,
      );
      const at = new THREE.Matrix4(), colour = new THREE.Color();
      const [low, high] = [this.colour("solidLow"), this.colour("solidHigh")];
      const span = Math.max(0.1, this.hi[2] - this.lo[2]);
      for (let k = 0; k < count; k++) {
        const z = z0 + (places[3 * k + 2] + 0.5) * cell;
        at.setPosition(x0 + (places[3 * k] + 0.5) * cell, y0 + (places[3 * k + 1] + 0.5) * cell, z);
        mesh.setMatrixAt(k, at);
        mesh.setColorAt(k, colour.lerpColors(low, high, Math.min(1, Math.max(0, (z - this.lo[2]) / span))));
      }
      this.room.add(mesh);
    } catch {
      // Without it the rest is drawn all the same.
    }
  }

  dispose(group) {
    group.traverse((node) => {
      node.geometry?.dispose();
      node.material?.map?.dispose();
      node.material?.dispose();
    });
    group.clear();
  }

  // ---- what moves ------------------------------------------------------------------------
  makeTrail() {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * (MOST_POINTS + 1)), 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(3 * (MOST_POINTS + 1)), 3));
    geometry.setDrawRange(0, 0);
    this.trailLine = new THREE.Line(geometry, new THREE.LineBasicMaterial({ vertexColors: true }));
    this.trailLine.frustumCulled = false;
    this.scene.add(this.trailLine);
  }

  showTrail(trail) {
    if (trail.length === this.trailLength && trail.at(-1) === this.trailEnd) return;
    [this.trailLength, this.trailEnd] = [trail.length, trail.at(-1)];
    const { position, color } = this.trailLine.geometry.attributes;
    const top = Math.max(1, this.arena.max_speed_mps), colour = new THREE.Color();
    const count = Math.min(trail.length, MOST_POINTS);
    for (let k = 0; k < count; k++) {
      const [x, y, z, speed] = trail[k];
      position.setXYZ(k, x, y, z);
      colour.setStyle(speedColour(speed / top).replaceAll(/(\d) (?=\d)/g, "$1,"));
      color.setXYZ(k, colour.r, colour.g, colour.b);
    }
    position.needsUpdate = color.needsUpdate = true;
    this.trailLine.geometry.setDrawRange(0, count);
  }

  /** Moving objects: each as the box about it in its own frame, where it is and how it is turned. */
  showObjects(objects = []) {
    while (this.moving.children.length > objects.length) this.moving.remove(this.moving.children.at(-1));
    objects.forEach((object, k) => {
      const turn = new THREE.Quaternion(...object.q_xyzw);
      const middle = object.min_m.map((low, axis) => (low + object.max_m[axis]) / 2);
      let box = this.moving.children[k];
      if (!box) {
        const edges = new THREE.EdgesGeometry(new THREE.BoxGeometry(1, 1, 1));
        box = new THREE.LineSegments(edges, new THREE.LineBasicMaterial({ color: this.colour("bad") }));
        this.moving.add(box);
      }
      box.scale.set(...object.max_m.map((high, axis) => Math.max(0.01, high - object.min_m[axis])));
      box.position.copy(vec(middle).applyQuaternion(turn)).add(vec(object.p_world_m));
      box.quaternion.copy(turn);
    });
  }

  draw({ pose, now, crashed, trail, objects }) {
    if (!this.arena || !this.canvas.clientWidth || now - this.drawn_at < EVERY_MS) return;
    this.drawn_at = now;
    this.fence.material.color.copy(this.colour(crashed ? "bad" : "warn"));
    this.showTrail(trail);
    this.showObjects(objects);
    const next = this.arena.stages.findIndex((stage) => !stage.passed);
    this.stages.forEach((paint, k) => paint(this.arena.stages[k].passed ? "good" : k === next ? "accent" : "muted"));
    this.vehicle.visible = this.shadow.visible = pose != null;
    if (pose) {
      const dt = Math.min(0.1, Math.max(0, (now - pose.received) / 1000));
      const p = pose.p_world_m.map((x, k) => x + pose.v_world_mps[k] * dt);
      this.vehicle.position.set(...p);
      if (pose.rotation) this.vehicle.quaternion.set(...pose.rotation);
      else this.vehicle.rotation.set(0, 0, pose.yaw_rad);
      this.shadow.position.set(p[0], p[1], Math.max(0, this.lo[2]) + 0.005);
      if (this.follows) this.target.lerp(this.vehicle.position, 0.15);
    }
    this.placeCamera();
    this.renderer.render(this.scene, this.camera);
  }

  // ---- the eye ---------------------------------------------------------------------------
  home() {
    const span = this.hi.map((h, k) => h - this.lo[k]);
    this.target = vec(this.lo.map((l, k) => (l + this.hi[k]) / 2));
    this.target.z = this.lo[2] + span[2] * 0.35;
    [this.turn, this.tilt] = [-Math.PI / 2 - 0.35, 0.62];
    this.wide = span;
    this.zoom = 1;
    this.follows = false;
  }

  placeCamera() {
    const [x, y, z] = this.wide, half = Math.tan((this.camera.fov * Math.PI) / 360);
    // So far that the room fits, in width or in height.
    const fit = Math.max(Math.hypot(x, y) / 2 / half / this.camera.aspect, (y + z) / 2 / half) * 0.95;
    const far = fit * this.zoom;
    const flat = Math.cos(this.tilt) * far;
    this.camera.position.set(
      this.target.x + Math.cos(this.turn) * flat,
      this.target.y + Math.sin(this.turn) * flat,
      this.target.z + Math.sin(this.tilt) * far,
    );
    this.camera.lookAt(this.target);
    this.camera.far = fit * 10 + 50;
    this.camera.updateProjectionMatrix();
  }

  rotate(dx, dy) {
    this.turn -= dx;
    this.tilt = Math.min(1.55, Math.max(-0.2, this.tilt + dy));
  }

  shift(dx, dy) {
    const far = this.camera.position.distanceTo(this.target);
    const right = new THREE.Vector3().setFromMatrixColumn(this.camera.matrix, 0);
    const up = new THREE.Vector3().setFromMatrixColumn(this.camera.matrix, 1);
    this.target.addScaledVector(right, -dx * far).addScaledVector(up, dy * far);
    this.follows = false;
  }

  scaleBy(factor) {
    this.zoom = Math.min(3, Math.max(0.05, this.zoom * factor));
  }

  listen() {
    const { canvas } = this, fingers = new Map();
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, event);
    });
    const up = (event) => fingers.delete(event.pointerId);
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("pointermove", (event) => {
      const former = fingers.get(event.pointerId);
      if (!former) return;
      const [dx, dy] = [event.clientX - former.clientX, event.clientY - former.clientY];
      const size = Math.max(1, canvas.clientHeight);
      if (fingers.size === 2) {
        const [other] = [...fingers.values()].filter((finger) => finger.pointerId !== event.pointerId);
        const span = (finger) => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
        this.scaleBy(span(former) / Math.max(1, span(event)));
        this.shift(dx / 2 / size, dy / 2 / size);
      } else if (event.buttons & 2 || event.shiftKey) this.shift(dx / size, dy / size);
      else this.rotate((dx * 3) / size, (dy * 3) / size);
      fingers.set(event.pointerId, event);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.scaleBy(Math.exp(Math.max(-0.3, Math.min(0.3, event.deltaY * 0.0012))));
    }, { passive: false });
    canvas.addEventListener("dblclick", () => this.home());
    canvas.addEventListener("keydown", (event) => {
      const act = {
        ArrowLeft: () => this.rotate(-0.1, 0), ArrowRight: () => this.rotate(0.1, 0),
        ArrowUp: () => this.rotate(0, 0.1), ArrowDown: () => this.rotate(0, -0.1),
        "+": () => this.scaleBy(0.87), "=": () => this.scaleBy(0.87), "-": () => this.scaleBy(1.15),
        0: () => this.home(), f: () => (this.follows = !this.follows),
      }[event.key];
      if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      act();
    });
  }

  resize() {
    const { clientWidth: w, clientHeight: h } = this.canvas.parentElement;
    if (!w || !h) return;
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio || 1));
    this.renderer.setSize(w, h, false);
    this.camera.aspect = w / h;
    this.drawn_at = -1e9;
  }
}
