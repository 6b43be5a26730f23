// Overlay of the image: axes, floor, fence, net, stages, vehicle and points at their positions in the room; dimmed
// where the scene hides them. World: x, y level, z up, metres.

/** Returns a function from the world to [x, y] on the page and the depth, for a request's camera. */
export function projector(request, width, height) {
  const [cy, sy] = [Math.cos(request.yaw_rad), Math.sin(request.yaw_rad)];
  const [cp, sp] = [Math.cos(request.pitch_rad), Math.sin(request.pitch_rad)];
  const focal = width / 2 / Math.tan((request.fov_deg * Math.PI) / 360);
  const axes = [[sy, -cy, 0], [cy * sp, sy * sp, -cp], [cy * cp, sy * cp, sp]];
  const inCamera = (p) => axes.map((axis) => axis.reduce((sum, part, k) => sum + part * (p[k] - request.p_m[k]), 0));
  return { inCamera, onPage: ([x, y, z]) => [width / 2 + (focal * x) / z, height / 2 + (focal * y) / z] };
}

/** Drawing over one image: lines and labels in world coordinates, on a canvas of the page's size. */
export class Drawing {
  constructor(context, width, height, request, grid) {
    Object.assign(this, { context, width, height, grid });
    this.camera = projector(request, width, height);
    this.scale = request.width_px / width;
  }

  /** Whether the scene hides a point of the page at a depth. */
  hides([x, y], depth) {
    const { grid } = this;
    if (!grid) return false;
    const cell = (at) => Math.floor((at * this.scale) / grid.cell_px);
    const rows = grid.depth_mm.length / grid.columns;
    const [column, row] = [cell(x), cell(y)];
    if (column < 0 || row < 0 || column >= grid.columns || row >= rows) return false;
    const seen = grid.depth_mm[row * grid.columns + column] / 1000;
    // Tolerance for lines on a surface: captured surfaces are rough.
    return seen > 0 && depth > seen * 1.02 + 0.06;
  }

  /** Draws a polyline of world points. */
  line(points, { color, width = 1.5, alpha = 1, hidden = 0.25 }) {
    const paths = [new Path2D(), new Path2D()];
    for (let k = 1; k < points.length; k++) this.#piece(paths, points[k - 1], points[k]);
    const { context } = this;
    Object.assign(context, { strokeStyle: color, lineWidth: width, lineCap: "round" });
    for (const [k, path] of paths.entries()) {
      context.globalAlpha = alpha * (k ? hidden : 1);
      context.setLineDash(k ? [3, 6] : []);
      context.stroke(path);
    }
    context.globalAlpha = 1;
    context.setLineDash([]);
  }

  #piece([inSight, behind], from, to) {
    let [a, b] = [from, to].map((p) => this.camera.inCamera(p));
    if (a[2] < NEAR_M && b[2] < NEAR_M) return;
    const cut = (p, q) => p.map((value, k) => value + ((q[k] - value) * (NEAR_M - p[2])) / (q[2] - p[2]));
    if (a[2] < NEAR_M) a = cut(a, b);
    else if (b[2] < NEAR_M) b = cut(b, a);
    const [p, q] = [a, b].map((end) => this.camera.onPage(end));
    const inside = this.#inside(p, q);
    if (!inside) return;
    const [first, last] = inside;
    const length = Math.hypot(q[0] - p[0], q[1] - p[1]) * (last - first);
    const pieces = Math.max(1, Math.ceil(length / PIECE_PX));
    const at = (t) => [p[0] + (q[0] - p[0]) * t, p[1] + (q[1] - p[1]) * t];
    let open = null;
    for (let k = 0; k < pieces; k++) {
      const [t, next] = [k, k + 1].map((end) => first + ((last - first) * end) / pieces);
      const middle = (t + next) / 2;
      // 1 / depth is linear along a line on the page.
      const depth = 1 / (1 / a[2] + (1 / b[2] - 1 / a[2]) * middle);
      const path = this.hides(at(middle), depth) ? behind : inSight;
      if (path !== open) path.moveTo(...at(t));
      path.lineTo(...at(next));
      open = path;
    }
  }

  /** Returns the part of a line that is on the page (Liang and Barsky); null if none is. */
  #inside(p, q) {
    let [first, last] = [0, 1];
    for (const [k, size] of [[0, this.width], [1, this.height]]) {
      const step = q[k] - p[k];
      for (const [towards, room] of [[-step, p[k] + 50], [step, size + 50 - p[k]]]) {
        if (towards === 0 && room < 0) return null;
        if (towards < 0) first = Math.max(first, room / towards);
        if (towards > 0) last = Math.min(last, room / towards);
      }
    }
    return first < last ? [first, last] : null;
  }

  /** Returns the position of a world point on the page, and whether the scene hides it; null behind the camera. */
  place(point) {
    const p = this.camera.inCamera(point);
    if (p[2] < NEAR_M) return null;
    const at = this.camera.onPage(p);
    return { at, hidden: this.hides(at, p[2]) };
  }

  label(point, text, color, [dx, dy] = [6, -6]) {
    const place = this.place(point);
    if (!place) return;
    const { context } = this;
    context.font = "600 12px system-ui, sans-serif";
    Object.assign(context, { lineWidth: 3, strokeStyle: "rgb(0 0 0 / .75)", fillStyle: color, lineJoin: "round" });
    context.globalAlpha = place.hidden ? 0.45 : 1;
    context.strokeText(text, place.at[0] + dx, place.at[1] + dy);
    context.fillText(text, place.at[0] + dx, place.at[1] + dy);
    context.globalAlpha = 1;
  }

  /** Draws the edges of a box along the world's axes. */
  box(min, max, style, name) {
    for (const edge of edges(min, max)) this.line(edge, style);
    this.label([min[0], min[1], max[2]], name, style.color);
  }

  /** Draws a ball as three rings. */
  ball(centre, radius, color, name) {
    for (const flat of [0, 1, 2]) {
      const ring = Array.from({ length: 33 }, (_, k) => {
        const around = [Math.cos((k * Math.PI) / 16), Math.sin((k * Math.PI) / 16)].map((share) => share * radius);
        return centre.map((value, axis) => (axis === flat ? value : value + around[(axis - flat + 3) % 3 === 1 ? 0 : 1]));
      });
      this.line(ring, { color, width: 1.5 });
    }
    this.label(centre, name, color, [8, 14]);
  }

  /** Draws a clicked point with its name. */
  marker(point, text, color) {
    const place = this.place(point);
    if (!place) return;
    const { context } = this;
    const [x, y] = place.at;
    context.globalAlpha = place.hidden ? 0.45 : 1;
    for (const [style, width] of [["rgb(0 0 0 / .8)", 4], [color, 2]]) {
      Object.assign(context, { strokeStyle: style, lineWidth: width });
      context.beginPath();
      context.arc(x, y, 7, 0, 7);
      context.moveTo(x - 2, y);
      context.lineTo(x + 2, y);
      context.moveTo(x, y - 2);
      context.lineTo(x, y + 2);
      context.stroke();
    }
    context.globalAlpha = 1;
    this.label(point, text, color, [10, -9]);
  }
}

/** Draws the room: axes of the motion capture, floor, fence and net, stages, and the vehicle at its true size. */
export function drawRoom(drawing, room) {
  const { min_m: min, max_m: max } = room.geofence;
  if (min.every((value, k) => value < max[k])) drawFence(drawing, min, max);
  if (room.crop) {
    drawing.box(room.crop.min_m, room.crop.max_m, { color: "#9aa4b2", alpha: 0.6 }, "crop");
  }
  for (const stage of room.stages) drawGate(drawing, stage);
  drawVehicle(drawing, room);
  for (const [k, [name, color]] of [["x", "#ff5d5d"], ["y", "#5fd35f"], ["z", "#6aa8ff"]].entries()) {
    const tip = [0, 0, 0];
    tip[k] = 1;
    drawing.line([[0, 0, 0], tip], { color, width: 3.5, hidden: 0.45 });
    drawing.label(tip, `${name} 1 m`, color);
  }
}

function edges(min, max) {
  const corner = (k) => [0, 1, 2].map((axis) => ((k >> axis) & 1 ? max : min)[axis]);
  const all = [];
  for (let k = 0; k < 8; k++)
    for (const axis of [0, 1, 2]) if (!((k >> axis) & 1)) all.push([corner(k), corner(k | (1 << axis))]);
  return all;
}

function* steps(from, to, step) {
  for (let k = Math.ceil(from / step); k * step <= to; k++) yield k * step;
}

function drawFence(drawing, min, max) {
  const wide = Math.max(max[0] - min[0], max[1] - min[1]);
  // At most about forty lines per side, in any room size.
  const step = [0.5, 1, 2, 5, 10, 50, 250, 1000].find((length) => wide / length <= 40) ?? wide;
  const floor = { color: "#ffffff", width: 1, alpha: 0.4, hidden: 0.2 };
  for (const x of steps(min[0], max[0], step)) drawing.line([[x, min[1], 0], [x, max[1], 0]], floor);
  for (const y of steps(min[1], max[1], step)) drawing.line([[min[0], y, 0], [max[0], y, 0]], floor);
  const net = { color: "#ffc44d", width: 1, alpha: 0.28, hidden: 0.3 };
  const low = Math.max(0, min[2]);
  for (const z of steps(low, max[2], step))
    drawing.line([[min[0], min[1], z], [max[0], min[1], z], [max[0], max[1], z], [min[0], max[1], z], [min[0], min[1], z]], net);
  for (const x of steps(min[0], max[0], step))
    for (const y of [min[1], max[1]]) drawing.line([[x, y, low], [x, y, max[2]]], net);
  for (const y of steps(min[1], max[1], step))
    for (const x of [min[0], max[0]]) drawing.line([[x, y, low], [x, y, max[2]]], net);
  for (const edge of edges(min, max)) drawing.line(edge, { color: "#ffc44d", width: 2, hidden: 0.35 });
  drawing.label([min[0], min[1], max[2]], "fence", "#ffc44d");
}

function drawGate(drawing, { name, center_m: c, normal: n, width_m, height_m }) {
  const color = "#ff7ae0";
  const long = Math.hypot(...n) || 1;
  const ahead = n.map((value) => value / long);
  const level = Math.hypot(ahead[0], ahead[1]);
  const left = level > 1e-6 ? [-ahead[1] / level, ahead[0] / level, 0] : [0, 1, 0];
  const up = [1, 2, 0].map((k, axis) => {
    const j = [2, 0, 1][axis];
    return ahead[k] * left[j] - ahead[j] * left[k];
  });
  const at = (l, u, a = 0) => c.map((value, k) => value + left[k] * l + up[k] * u + ahead[k] * a);
  const [w, h] = [width_m / 2, height_m / 2];
  drawing.line([at(-w, -h), at(w, -h), at(w, h), at(-w, h), at(-w, -h)], { color, width: 3 });
  drawing.line([at(0, 0, -0.3), at(0, 0, 0.3), at(0.1, 0, 0.2)], { color, width: 2 });
  drawing.label(at(0, h), name, color);
}

function drawVehicle(drawing, { spawn, takeoff_height_m: climb, body_radius_m: radius }) {
  const color = "#58e0e6";
  const [x, y, z] = spawn.position_m;
  const yaw = (spawn.yaw_deg * Math.PI) / 180;
  const arm = radius * 0.62;
  for (const height of [z + radius * 0.5, z + climb]) {
    const at = (angle, reach, from = [0, 0]) =>
      [x + from[0] + reach * Math.cos(yaw + angle), y + from[1] + reach * Math.sin(yaw + angle), height];
    const style = { color, width: 2, alpha: height > z + radius ? 1 : 0.6 };
    for (const angle of [Math.PI / 4, -Math.PI / 4]) drawing.line([at(angle, arm), at(angle + Math.PI, arm)], style);
    for (let k = 0; k < 4; k++) {
      const angle = Math.PI / 4 + (k * Math.PI) / 2;
      const hub = [arm * Math.cos(yaw + angle), arm * Math.sin(yaw + angle)];
      const circle = Array.from({ length: 17 }, (_, step) => at((step * Math.PI) / 8, radius - arm, hub));
      drawing.line(circle, style);
    }
    drawing.line([at(0, 0), at(0, radius * 1.5)], { ...style, width: 3 });
  }
  drawing.line([[x, y, z], [x, y, z + climb]], { color, width: 1, alpha: 0.7 });
  drawing.label([x, y, z], "start", color, [8, 14]);
}

/** Near plane. */
const NEAR_M = 0.05;
/** Length of a piece of constant brightness. */
const PIECE_PX = 6;
