// The 3D view: a room with its twin, and moving objects, track and vehicle. Drag rotates, right drag or two fingers
// pan, the wheel zooms. Keyboard: arrows rotate, + and - zoom, 0 resets, F follows the vehicle. The camera can also fly
// behind the vehicle ("chase") or in it ("onboard"). World x east, y north, z up; [m, world] throughout.

import * as THREE from "/three/three.module.min.js";
import { DrawRate } from "./draw_rate.js";
import { movedOn } from "./fleet.js";
import { known } from "./session.js";
import { FlatRenderer } from "./space_flat.js";
import { Others } from "./space_others.js";
import { joined, Room, vec } from "./space_room.js";
import { ServedTwin } from "./space_served.js";
import { speedColours, TrackLine } from "./space_track.js";
import { Twin } from "./space_twin.js";

/** @typedef {import("./messages").Arena} Arena */
/** @typedef {import("./messages").State["objects"]} MovingObjects */

/** Without a graphics card at most thirty frames per second, fewer if drawing is slow: the flight needs the processor. [ms] */
const EVERY_MS = 1000 / 31;
/** Without a graphics card, ratio of pause to drawing time. */
const REST = 3;
/** Position of the chase camera behind and above the vehicle. [m] */
const CHASE_BACK_M = 1.8, CHASE_UP_M = 0.7;
/** Vertical field of view: free camera, and as wide as a vehicle's camera. [deg] */
const FREE_FOV_DEG = 50, ONBOARD_FOV_DEG = 74;

/** @typedef {"free" | "chase" | "onboard"} Mode */
/** Renderer of the twin: the browser on a graphics card or in software, or the server. @typedef {"card" | "software" | "server"} Drawer */

/** Returns the renderer that this browser supports; without WebGL 2, the server. @returns {Drawer} */
export function ableDrawer() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return "server";
  const renderer = gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER;
  const name = String(gl.getParameter(renderer));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  // Rendering in software takes processor time from the flight.
  return /swiftshader|llvmpipe|software/i.test(name) ? "software" : "card";
}

export class SpaceView {
  /**
   * @param {HTMLCanvasElement} canvas in the element that determines its size
   * @param {Arena} arena
   * @param {string | undefined} theme
   * @param {Drawer} drawer
   * @param {(text: string) => void} report receives the reason for which the server's image is missing; empty if it is
   * not
   */
  constructor(canvas, arena, theme, drawer, report) {
    this.canvas = canvas;
    this.drawer = drawer;
    this.report = report;
    this.parent = /** @type {HTMLElement} */ (canvas.parentElement);
    this.renderer = drawer === "server" ? new FlatRenderer(canvas) : new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(FREE_FOV_DEG, 1, 0.02, 500);
    this.camera.up.set(0, 0, 1);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x445566, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(-0.4, -0.7, 1);
    this.scene.add(sun);
    this.room = new Room(arena, theme);
    this.moving = new THREE.Group();
    this.scene.add(this.room.group, this.moving);
    this.track = new TrackLine();
    this.ghostTrack = new TrackLine();
    this.others = new Others();
    this.scene.add(this.track.line, this.ghostTrack.line, this.others.group);
    this.disposed = false;
    this.drawn_ms = -Infinity;
    this.rest_ms = drawer === "card" ? 0 : EVERY_MS;
    this.rate = new DrawRate();
    /** Whether the browser draws too slowly. */
    this.isSlow = false;
    /** @type {Mode} */
    this.mode = "free";
    /** @type {Twin | ServedTwin | null} */
    this.twin = null;
    /** Camera of the shown frame. */
    this.eye = this.camera;
    /** Point that the camera looks at. */
    this.target = new THREE.Vector3();
    /** Direction of the camera: angles about z and above the floor [rad], and a share of the distance at which the room fits. */
    this.turn = this.tilt = 0;
    this.zoom = 1;
    this.follows = false;
    this.home();
    this.listen();
    this.addTwin();
    this.resized = new ResizeObserver(() => this.resize());
    this.resized.observe(this.parent);
  }

  /**
   * @param {Arena} arena
   * @param {string | undefined} theme
   */
  setArena(arena, theme) {
    const isOther = arena.boot !== this.room.arena.boot;
    this.others.clear();
    this.room.dispose();
    this.room = new Room(arena, theme);
    this.scene.add(this.room.group);
    if (isOther) this.addTwin();
    else this.showStand();
    this.moving.clear();
    for (const track of [this.track, this.ghostTrack]) track.forget();
    this.home();
    this.resize();
  }

  /** Fetches the twin, and shows solid cells as boxes until it is loaded. The server sends both only to the instructor. */
  async addTwin() {
    await known;
    this.removeTwin();
    this.showStand();
    const { room } = this;
    if (this.disposed || document.body.dataset.role !== "instructor" || !room.arena.twin_parts) return;
    if (this.drawer === "server") {
      this.twin = new ServedTwin(this.report);
      return;
    }
    room.addSolid();
    const parts = this.drawer === "card" ? room.arena.twin_parts : 1;
    const twin = new Twin(room.arena, parts, () => this.showStand());
    this.scene.add(twin.mesh);
    this.twin = twin;
  }

  removeTwin() {
    if (this.twin instanceof Twin) this.twin.mesh.removeFromParent();
    this.twin?.dispose();
    this.twin = null;
  }

  /** Shows floor and boxes until the twin is loaded; not if the server draws. */
  showStand() {
    this.room.stand.visible = this.drawer !== "server" && !(this.twin instanceof Twin && this.twin.isShown);
  }

  // ---- moving objects --------------------------------------------------------------------
  /** Shows moving objects: each as its box in its own frame, at its pose. @param {MovingObjects} objects */
  showObjects(objects) {
    for (const surplus of this.moving.children.slice(objects.length)) this.moving.remove(surplus);
    objects.forEach((object, k) => {
      const turn = new THREE.Quaternion(...object.q_xyzw);
      const middle = vec(joined(object.min_m, object.max_m, (low, high) => (low + high) / 2));
      const box = this.moving.children[k] ?? this.addBox();
      box.scale.set(...joined(object.max_m, object.min_m, (high, low) => Math.max(0.01, high - low)));
      box.position.copy(middle.applyQuaternion(turn)).add(vec(object.p_world_m));
      box.quaternion.copy(turn);
    });
  }

  /** Adds a box with sides of 1 m to the moving objects. */
  addBox() {
    const edges = new THREE.EdgesGeometry(new THREE.BoxGeometry(1, 1, 1));
    const box = new THREE.LineSegments(edges, new THREE.LineBasicMaterial({ color: this.room.colour("--bad") }));
    this.moving.add(box);
    return box;
  }

  /**
   * @param {import("./fleet.js").ShownPose} pose
   * @param {number} now_ms
   */
  showVehicle(pose, now_ms) {
    const { vehicle, shadow } = this.room;
    const p = movedOn(pose, now_ms);
    vehicle.position.set(...p);
    vehicle.quaternion.set(...pose.rotation);
    shadow.position.set(p[0], p[1], this.room.floorHeight() + 0.005);
    if (this.follows) this.target.lerp(vehicle.position, 0.15);
  }

  /** Shows another flight as a ghost. @param {ReturnType<import("./replay_bar.js").ReplayBar["ghostNow"]>} ghost */
  showGhost(ghost) {
    this.room.ghost.visible = this.ghostTrack.line.visible = ghost != null;
    if (!ghost) return;
    this.room.ghost.position.set(...ghost.pose.p_world_m);
    this.room.ghost.quaternion.set(...ghost.pose.rotation);
    const grey = this.room.colour("--muted");
    this.ghostTrack.show(ghost.track, () => grey);
  }

  /** @param {Parameters<import("./top_view.js").TopView["draw"]>[0] & { ghost: Parameters<SpaceView["showGhost"]>[0] }} shown */
  draw({ pose, now_ms, crashed, track, objects, passed, ghost, others }) {
    if (!this.canvas.clientWidth || now_ms - this.drawn_ms < this.rest_ms) return;
    this.drawn_ms = now_ms;
    const { room } = this;
    room.fenceColour.copy(room.colour(crashed ? "--bad" : "--warn"));
    this.track.show(track, speedColours(room.arena.max_speed_mps));
    this.showObjects(objects);
    this.showGhost(ghost);
    this.others.show(room, others, now_ms);
    const next = room.stages.findIndex((_, k) => !passed.has(k));
    for (const [k, paint] of room.stages.entries())
      paint(room.colour(passed.has(k) ? "--good" : k === next ? "--accent" : "--muted"));
    room.vehicle.visible = room.shadow.visible = pose != null;
    if (pose) this.showVehicle(pose, now_ms);
    room.vehicle.visible &&= this.mode !== "onboard";
    if (this.mode === "free" || !pose) this.placeCamera();
    else this.placeWithVehicle();
    this.twin?.place(this.camera, this.renderer.getDrawingBufferSize(new THREE.Vector2()), room, this.mode === "free");
    this.render();
    this.isSlow = this.rate.note(now_ms) ?? this.isSlow;
    if (this.drawer !== "card") this.rest(now_ms);
  }

  /** Draws; with the server's image, from the camera of that image, unless the user turns the view, which must be visible at once. */
  render() {
    this.eye = this.camera;
    if (!(this.renderer instanceof FlatRenderer)) {
      this.renderer.render(this.scene, this.camera);
      return;
    }
    const served = this.twin instanceof ServedTwin ? this.twin : null;
    const follows = this.mode !== "free" || this.follows;
    if (served?.picture && follows) this.eye = served.picture.camera;
    this.renderer.render(this.scene, this.eye, served?.picture?.bitmap, follows || served?.isCurrent() === true);
  }

  /** Pauses in proportion to the drawing time. @param {number} began_ms */
  rest(began_ms) {
    if (this.renderer instanceof THREE.WebGLRenderer) {
      const gl = this.renderer.getContext();
      // Reading a pixel waits until drawing is complete.
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    }
    const took_ms = performance.now() - began_ms;
    this.rest_ms = Math.max(EVERY_MS, (1 + REST) * took_ms);
  }

  /** Returns the position of a point of the world on the canvas; null if it is not visible. @param {import("./space_room.js").Point} p @returns {[number, number] | null} [CSS px] */
  at(p) {
    const { x, y, z } = vec(p).project(this.eye);
    if (z > 1 || Math.abs(x) > 1 || Math.abs(y) > 1) return null;
    return [((1 + x) / 2) * this.canvas.clientWidth, ((1 - y) / 2) * this.canvas.clientHeight];
  }

  // ---- the camera ------------------------------------------------------------------------
  home() {
    this.target.copy(this.room.middle);
    this.target.z = this.room.lo[2] + this.room.size[2] * 0.35;
    this.turn = -Math.PI / 2 - 0.35;
    this.tilt = 0.62;
    this.zoom = 1;
    this.follows = false;
  }

  /** Sets the camera: free, behind the vehicle, in the vehicle. @param {Mode} mode */
  setMode(mode) {
    this.mode = mode;
    this.drawn_ms = -Infinity;
    // Nothing was drawn while another view was shown.
    this.rate.restart();
  }

  /** Places the camera behind the vehicle, or in it. */
  placeWithVehicle() {
    const { camera, room: { vehicle } } = this;
    const ahead = new THREE.Vector3(1, 0, 0).applyQuaternion(vehicle.quaternion);
    const isIn = this.mode === "onboard";
    camera.up.set(0, 0, 1);
    if (isIn) {
      camera.up.applyQuaternion(vehicle.quaternion);
      camera.position.copy(vehicle.position);
    } else {
      ahead.setZ(0).normalize();
      const behind = vehicle.position.clone().addScaledVector(ahead, -CHASE_BACK_M);
      behind.z += CHASE_UP_M;
      // The first frame is at the final position; afterwards the camera follows like a spring.
      camera.position.lerp(behind, camera.position.distanceTo(behind) > 3 * CHASE_BACK_M ? 1 : 0.12);
    }
    camera.lookAt(isIn ? camera.position.clone().add(ahead) : vehicle.position.clone().addScaledVector(ahead, 0.8));
    camera.fov = isIn ? ONBOARD_FOV_DEG : FREE_FOV_DEG;
    camera.far = Math.hypot(...this.room.size) * 4 + 50;
    camera.updateProjectionMatrix();
  }

  placeCamera() {
    this.camera.up.set(0, 0, 1);
    this.camera.fov = FREE_FOV_DEG;
    const [x, y, z] = this.room.size, half = Math.tan((this.camera.fov * Math.PI) / 360);
    // Distance at which the room fits, in width and height.
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

  /**
   * @param {number} dx [rad]
   * @param {number} dy [rad]
   */
  rotate(dx, dy) {
    this.turn -= dx;
    this.tilt = Math.min(1.55, Math.max(-0.2, this.tilt + dy));
  }

  /**
   * @param {number} dx as a share of the distance
   * @param {number} dy as a share of the distance
   */
  shift(dx, dy) {
    const far = this.camera.position.distanceTo(this.target);
    const right = new THREE.Vector3().setFromMatrixColumn(this.camera.matrix, 0);
    const up = new THREE.Vector3().setFromMatrixColumn(this.camera.matrix, 1);
    this.target.addScaledVector(right, -dx * far).addScaledVector(up, dy * far);
    this.follows = false;
  }

  /** @param {number} factor */
  scaleBy(factor) {
    this.zoom = Math.min(3, Math.max(0.05, this.zoom * factor));
  }

  listen() {
    const { canvas } = this;
    /** Pressed pointers: a mouse, or fingers. @type {Map<number, PointerEvent>} */
    const pointers = new Map();
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, event);
    });
    const up = (/** @type {PointerEvent} */ event) => pointers.delete(event.pointerId);
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("pointermove", (event) => {
      const former = pointers.get(event.pointerId);
      if (!former) return;
      const [dx, dy] = [event.clientX - former.clientX, event.clientY - former.clientY];
      const size = Math.max(1, canvas.clientHeight);
      if (pointers.size === 2) {
        const [other] = [...pointers.values()].filter((pointer) => pointer.pointerId !== event.pointerId);
        const span = (/** @type {PointerEvent} */ pointer) => Math.hypot(pointer.clientX - other.clientX, pointer.clientY - other.clientY);
        this.scaleBy(span(former) / Math.max(1, span(event)));
        this.shift(dx / 2 / size, dy / 2 / size);
      } else if (event.buttons & 2 || event.shiftKey) this.shift(dx / size, dy / size);
      else this.rotate((dx * 3) / size, (dy * 3) / size);
      pointers.set(event.pointerId, event);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.scaleBy(Math.exp(Math.max(-0.3, Math.min(0.3, event.deltaY * 0.0012))));
    }, { passive: false });
    canvas.addEventListener("dblclick", () => this.home());
    canvas.addEventListener("keydown", (event) => {
      const act = this.keys[event.key];
      if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      act();
    });
  }

  /** @type {Record<string, () => void>} */
  keys = {
    ArrowLeft: () => this.rotate(-0.1, 0), ArrowRight: () => this.rotate(0.1, 0),
    ArrowUp: () => this.rotate(0, 0.1), ArrowDown: () => this.rotate(0, -0.1),
    "+": () => this.scaleBy(0.87), "=": () => this.scaleBy(0.87), "-": () => this.scaleBy(1.15),
    0: () => this.home(),
    f: () => {
      this.follows = !this.follows;
    },
  };

  resize() {
    const { clientWidth: w, clientHeight: h } = this.parent;
    if (!w || !h) return;
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio || 1));
    this.renderer.setSize(w, h, false);
    this.camera.aspect = w / h;
    this.drawn_ms = -Infinity;
  }

  dispose() {
    this.disposed = true;
    this.resized.disconnect();
    this.removeTwin();
    this.others.clear();
    for (const track of [this.track, this.ghostTrack]) track.dispose();
    this.room.dispose();
    this.renderer.dispose();
  }
}
