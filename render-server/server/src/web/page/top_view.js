// The top view: fence, obstacles at flight height, goal, stages, track, vehicle. World x is right, y is up; [m, world]
// throughout.

import { context2d, make } from "./dom.js";
import { movedOn } from "./fleet.js";
import { cssColours } from "./theme.js";

/** @typedef {import("./messages").Arena} Arena */
/** @typedef {import("./messages").State["objects"][number]} MovingObject */
/** A point of the track: position and speed. [m, world; m/s] @typedef {import("./messages").Track["points"][number]} TrackPoint */
/** Another flight as a ghost. @typedef {{ pose: Pick<import("./flight_recording.js").FlownPose, "p_world_m">, track: TrackPoint[] }} Ghost */
/** @typedef {[x: number, y: number]} Point2 */
/** At least x and y. @typedef {readonly [number, number, ...number[]]} Point */

/** The colours of the style sheet. @typedef {ReturnType<typeof readStyle>} Style */
function readStyle() {
  const read = cssColours();
  return {
    text: read("--text"), muted: read("--muted"), accent: read("--accent"), good: read("--good"),
    warn: read("--warn"), bad: read("--bad"), background: read("--map-bg"), shade: read("--shade"),
    obstacle: read("--obstacle"), edge: read("--obstacle-edge"),
  };
}

const SPEED_STOPS = [[75, 123, 255], [47, 214, 200], [216, 226, 74], [255, 154, 60], [255, 77, 94]];

/** Returns the colour of a speed, given as a share of the highest. @param {number} share */
export function speedColour(share) {
  const at = Math.max(0, Math.min(0.9999, share || 0)) * (SPEED_STOPS.length - 1);
  const k = Math.floor(at), t = at - k, [a, b] = [SPEED_STOPS[k], SPEED_STOPS[k + 1]];
  return `rgb(${a.map((v, c) => Math.round(v + (b[c] - v) * t)).join(" ")})`;
}

/**
 * Returns the corners of the fence's bounding box; without a box, those of the map's image.
 * @param {Arena} arena
 * @returns {[Point2, Point2]}
 */
function bounds(arena) {
  const box = "cuboid" in arena.fence ? arena.fence.cuboid : null;
  if (!box) return [arena.map_min_m, arena.map_max_m];
  const [c, h] = [box.center_m, box.half_m];
  return [[c[0] - h[0], c[1] - h[1]], [c[0] + h[0], c[1] + h[1]]];
}

/**
 * Returns a canvas with one pixel per cell of the obstacles: filled, with brighter edges.
 * @param {Arena["obstacles"]} obstacles
 * @param {Style} style
 */
function obstacleCanvas({ width, height, bits }, style) {
  const bytes = Uint8Array.from(atob(bits), (c) => c.charCodeAt(0));
  const solid = (/** @type {number} */ x, /** @type {number} */ y) =>
    x >= 0 && y >= 0 && x < width && y < height && ((bytes[(y * width + x) >> 3] >> ((y * width + x) & 7)) & 1) === 1;
  const canvas = make("canvas", { width: Math.max(1, width), height: Math.max(1, height) });
  const g = context2d(canvas);
  for (let y = 0; y < height; y++)
    for (let x = 0; x < width; x++) {
      if (!solid(x, y)) continue;
      const inner = solid(x - 1, y) && solid(x + 1, y) && solid(x, y - 1) && solid(x, y + 1);
      g.fillStyle = inner ? style.obstacle : style.edge;
      g.fillRect(x, height - 1 - y, 1, 1);
    }
  return canvas;
}

/** Returns the convex hull of points in the plane (Andrew's monotone chain). @param {Point2[]} points */
function hull(points) {
  const sorted = points.toSorted((a, b) => a[0] - b[0] || a[1] - b[1]);
  const cross = (/** @type {Point2} */ o, /** @type {Point2} */ a, /** @type {Point2} */ b) => (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0]);
  const chain = (/** @type {Point2[]} */ list) => {
    /** @type {Point2[]} */
    const out = [];
    for (const p of list) {
      while (out.length >= 2 && cross(out[out.length - 2], out[out.length - 1], p) <= 0) out.pop();
      out.push(p);
    }
    return out.slice(0, -1);
  };
  return [...chain(sorted), ...chain(sorted.toReversed())];
}

export class TopView {
  /** @param {HTMLCanvasElement} canvas in the element whose size it takes */
  constructor(canvas) {
    this.canvas = canvas;
    this.room = /** @type {HTMLElement} */ (canvas.parentElement);
    this.g = context2d(canvas);
    /** @type {TrackPoint[]} */
    this.track = [];
    /** @type {Arena | null} */
    this.arena = null;
    /** @type {HTMLImageElement | null} */
    this.picture = null;
    /** @type {HTMLCanvasElement | null} */
    this.obstacles = null;
    this.style = readStyle();
    /** Device pixels per CSS pixel. */
    this.ratio = 1;
    /** Scale [CSS px/m]; 0 without an arena. */
    this.scale = 0;
    /** Position of the world's origin. [CSS px] @type {Point2} */
    this.origin = [0, 0];
    /** Replay bar at the bottom of the drawing, after the first flight. */
    this.replay = /** @type {HTMLElement | null} */ (this.room.querySelector(".replay"));
    const resized = new ResizeObserver(() => this.resize());
    for (const one of [this.room, this.replay]) if (one) resized.observe(one);
  }

  /** @param {Arena} arena */
  setArena(arena) {
    this.arena = arena;
    this.track = [];
    this.picture = null;
    const image = new Image();
    image.onload = () => (this.picture = image);
    image.src = `/api/map?${arena.boot}`;
    this.restyle();
    this.resize();
  }

  restyle() {
    this.style = readStyle();
    if (this.arena) this.obstacles = obstacleCanvas(this.arena.obstacles, this.style);
  }

  resize() {
    const { clientWidth: w, clientHeight: h } = this.room;
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    this.canvas.width = Math.round(w * ratio);
    this.canvas.height = Math.round(h * ratio);
    this.ratio = ratio;
    if (!this.arena) return;
    const [lo, hi] = bounds(this.arena);
    const pad = Math.min(34, w * 0.05);
    const [dx, dy] = [Math.max(0.1, hi[0] - lo[0]), Math.max(0.1, hi[1] - lo[1])];
    // Below the stage lights and above the texts at the bottom, if there is room.
    const lights = /** @type {HTMLElement | null} */ (this.room.querySelector("#stages"));
    const top = Math.min(lights && !lights.hidden ? lights.offsetTop + lights.offsetHeight + 8 : pad, h * 0.35);
    const bar = this.replay && !this.replay.hidden ? h - this.replay.offsetTop + 8 : 0;
    const bottom = Math.max(Math.min(pad + 14, h * 0.25), Math.min(bar, h * 0.45));
    this.scale = Math.min((w - 2 * pad) / dx, (h - top - bottom) / dy);
    const middle = (top + h - bottom) / 2;
    this.origin = [w / 2 - ((lo[0] + hi[0]) / 2) * this.scale, middle + ((lo[1] + hi[1]) / 2) * this.scale];
  }

  /** Returns the position of a point of the world on the canvas. [CSS px] @param {Point} p @returns {Point2} */
  at(p) {
    return [this.origin[0] + p[0] * this.scale, this.origin[1] - p[1] * this.scale];
  }

  /** @param {{ pose: import("./fleet.js").ShownPose | null, now_ms: number, crashed: boolean, objects: MovingObject[], passed: Set<number>, track: TrackPoint[], ghost: Ghost | null, others: import("./fleet.js").Other[] }} shown */
  draw({ pose, now_ms, crashed, objects, passed, track, ghost, others }) {
    const { g, arena, ratio } = this;
    if (!arena || !this.scale) return;
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.drawGround(arena);
    this.drawFence(arena, crashed);
    for (const [k, stage] of arena.stages.entries()) this.drawStage(stage, passed.has(k));
    if (arena.goal_m) this.drawGoal(arena.goal_m, arena.goal_radius_m, now_ms);
    for (const object of objects) this.drawObject(object);
    if (ghost) this.drawGhost(arena, ghost);
    for (const other of others) this.drawTrack(arena, other.track, this.style.muted);
    this.drawTrack(arena, track);
    for (const other of others) this.drawVehicle(arena, other.pose, now_ms, this.style.muted);
    if (pose) this.drawVehicle(arena, pose, now_ms, this.style.accent);
    this.drawScaleBar();
  }

  /** Returns left, top, width, height of a box of the world. [CSS px] @param {Point} lo @param {Point} hi @returns {[number, number, number, number]} */
  rect(lo, hi) {
    const [x0, y1] = this.at(lo), [x1, y0] = this.at(hi);
    return [x0, y0, x1 - x0, y1 - y0];
  }

  /** @param {Arena} arena */
  drawGround(arena) {
    const { g, style } = this;
    const [lo, hi] = bounds(arena);
    g.save();
    g.beginPath();
    g.roundRect(...this.rect(lo, hi), 4);
    g.clip();
    if (this.picture) {
      g.imageSmoothingEnabled = true;
      g.drawImage(this.picture, ...this.rect(arena.map_min_m, arena.map_max_m));
      g.fillStyle = style.shade;
      g.fillRect(...this.rect(lo, hi));
    }
    const o = arena.obstacles;
    if (this.obstacles && o.width) {
      g.imageSmoothingEnabled = false;
      /** @type {Point2} */
      const end = [o.origin_m[0] + o.width * o.cell_m, o.origin_m[1] + o.height * o.cell_m];
      g.drawImage(this.obstacles, ...this.rect(o.origin_m, end));
    }
    g.restore();
  }

  /** @param {Arena} arena @param {boolean} crashed */
  drawFence(arena, crashed) {
    const { g, style } = this;
    const [lo, hi] = bounds(arena);
    g.lineWidth = crashed ? 4 : 1.5;
    g.strokeStyle = crashed ? style.bad : style.warn;
    g.setLineDash(crashed ? [] : [7, 5]);
    g.beginPath();
    g.roundRect(...this.rect(lo, hi), 4);
    g.stroke();
    g.setLineDash([]);
  }

  /** @param {Arena["stages"][number]} stage @param {boolean} passed */
  drawStage(stage, passed) {
    const { g, style } = this;
    const n = Math.hypot(stage.normal[0], stage.normal[1]);
    if (!n) return;
    const across = [(-stage.normal[1] / n) * (stage.width_m / 2), (stage.normal[0] / n) * (stage.width_m / 2)];
    const c = stage.center_m;
    const a = this.at([c[0] + across[0], c[1] + across[1]]), b = this.at([c[0] - across[0], c[1] - across[1]]);
    g.strokeStyle = passed ? style.good : style.accent;
    g.lineWidth = 5;
    g.lineCap = "round";
    g.beginPath();
    g.moveTo(...a);
    g.lineTo(...b);
    g.stroke();
    g.lineCap = "butt";
  }

  /** A moving object, as the box around it. @param {MovingObject} object */
  drawObject({ min_m, max_m, p_world_m, q_xyzw: [x, y, z, w] }) {
    const { g, style } = this;
    // The box's corners, rotated by the quaternion, seen from above: their convex hull.
    /** @type {Point2[]} */
    const corners = [];
    for (const a of [min_m[0], max_m[0]])
      for (const b of [min_m[1], max_m[1]])
        for (const c of [min_m[2], max_m[2]])
          corners.push([
            p_world_m[0] + (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - z * w) * b + 2 * (x * z + y * w) * c,
            p_world_m[1] + 2 * (x * y + z * w) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - x * w) * c,
          ]);
    g.strokeStyle = style.bad;
    g.lineWidth = 2;
    g.beginPath();
    for (const p of hull(corners)) g.lineTo(...this.at(p));
    g.closePath();
    g.stroke();
  }

  /** @param {Point} goal_m @param {number} radius_m @param {number} now_ms */
  drawGoal(goal_m, radius_m, now_ms) {
    const { g, style } = this;
    const [x, y] = this.at(goal_m);
    const r = Math.max(6, radius_m * this.scale);
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const beat = still ? 0.5 : (Math.sin(now_ms / 600) + 1) / 2;
    g.strokeStyle = style.good;
    g.fillStyle = style.good;
    g.globalAlpha = 0.12 + 0.12 * beat;
    g.beginPath();
    g.arc(x, y, r, 0, 7);
    g.fill();
    g.globalAlpha = 1;
    g.lineWidth = 2;
    g.stroke();
    g.beginPath();
    g.arc(x, y, 3, 0, 7);
    g.fill();
  }

  /** Draws another flight: its track and outline. @param {Arena} arena @param {Ghost} ghost */
  drawGhost(arena, { pose, track }) {
    const { g, style } = this;
    g.strokeStyle = style.muted;
    g.lineWidth = 1.5;
    g.beginPath();
    for (const point of track) g.lineTo(...this.at(point));
    g.stroke();
    const r = Math.max(9, arena.body_radius_m * this.scale);
    g.lineWidth = 2;
    g.setLineDash([4, 3]);
    g.beginPath();
    g.arc(...this.at(pose.p_world_m), r, 0, 7);
    g.stroke();
    g.setLineDash([]);
  }

  /** Draws a track, in the colours of its speeds unless one is given. @param {Arena} arena @param {TrackPoint[]} track @param {string} [colour] */
  drawTrack(arena, track, colour) {
    const { g } = this;
    const fastest_mps = Math.max(1, arena.max_speed_mps);
    g.lineWidth = colour ? 1.5 : 3;
    g.lineJoin = g.lineCap = "round";
    for (let k = 1; k < track.length; k++) {
      g.strokeStyle = colour ?? speedColour(track[k][3] / fastest_mps);
      g.beginPath();
      g.moveTo(...this.at(track[k - 1]));
      g.lineTo(...this.at(track[k]));
      g.stroke();
    }
    g.lineCap = "butt";
  }

  /** @param {Arena} arena @param {import("./fleet.js").ShownPose} pose @param {number} now_ms @param {string} colour */
  drawVehicle(arena, pose, now_ms, colour) {
    const { g, style } = this;
    const p = movedOn(pose, now_ms);
    const [x, y] = this.at(p);
    const v = this.at([p[0] + pose.v_world_mps[0] * 0.5, p[1] + pose.v_world_mps[1] * 0.5]);
    g.strokeStyle = style.text;
    g.globalAlpha = 0.55;
    g.lineWidth = 2;
    g.beginPath();
    g.moveTo(x, y);
    g.lineTo(...v);
    g.stroke();
    g.globalAlpha = 1;
    const r = Math.max(9, arena.body_radius_m * this.scale);
    g.save();
    g.translate(x, y);
    g.rotate(-pose.yaw_rad);
    g.fillStyle = colour;
    g.strokeStyle = style.background;
    g.lineWidth = 2;
    g.beginPath();
    g.moveTo(r * 1.35, 0);
    g.lineTo(-r * 0.85, r * 0.85);
    g.lineTo(-r * 0.4, 0);
    g.lineTo(-r * 0.85, -r * 0.85);
    g.closePath();
    g.fill();
    g.stroke();
    g.restore();
  }

  drawScaleBar() {
    const { g, style } = this;
    const metres = [0.5, 1, 2, 5, 10, 20, 50].find((m) => m * this.scale >= 50) ?? 100;
    const [x, y] = [16, this.canvas.height / this.ratio - 16];
    g.strokeStyle = g.fillStyle = style.muted;
    g.lineWidth = 1.5;
    g.beginPath();
    g.moveTo(x, y - 4);
    g.lineTo(x, y);
    g.lineTo(x + metres * this.scale, y);
    g.lineTo(x + metres * this.scale, y - 4);
    g.stroke();
    g.font = "12px system-ui, sans-serif";
    g.fillText(`${metres} m`, x + metres * this.scale + 7, y + 1);
  }
}
