// Items of a course on the page of `vizflyt arena edit`, their handles, and the effect of dragging them. Pure: changes
// only the course that is passed in. World: x, y level, z up, metres.

/** Width of a frame's bar around a stage's opening, as on the server. */
export const BAR_M = 0.06;
const STEP_M = 0.05, STEP_DEG = 15;
/** Maximum distance at which an item snaps to the floor, a wall or the fence. */
const REACH_M = 0.12;

const round = (value, step) => Math.round(Math.round(value / step) * step * 1000) / 1000 + 0;
const cm = (value) => Math.round(value * 100);
const yawOf = ([x, y]) => Math.atan2(y, x);
const degrees = (rad) => (rad * 180) / Math.PI;
const along = (yaw, length) => [length * Math.cos(yaw), length * Math.sin(yaw)];

/** Returns the items of a course; `key` is the path in the file. */
export function items(course) {
  const list = [{ kind: "start", key: "spawn", name: "start" }, { kind: "fence", key: "geofence", name: "fence" }];
  if (course.goal) list.push({ kind: "goal", key: "goal", name: "goal" });
  const numbered = (kind, key, list) => list.map(({ name }, index) => ({ kind, key: `${key}[${index}]`, index, name }));
  list.push(...numbered("gate", "stages", course.stages), ...numbered("box", "no_fly", course.no_fly));
  list.push(...numbered("object", "objects", course.objects).filter((item) => !gateOf(course, part(course, item))));
  return list;
}

/** Returns the stage whose frame an object is. */
const gateOf = (course, object) => course.stages.find((stage) => frameName(stage) === object.name);
const frameName = (stage) => `${stage.name} frame`;
export const frameOf = (course, stage) => course.objects.find((object) => object.name === frameName(stage));

/** Returns the part of the course that belongs to an item. */
export function part(course, item) {
  const parts = { start: course.spawn, goal: course.goal, fence: course.geofence };
  const lists = { gate: course.stages, box: course.no_fly, object: course.objects };
  return parts[item.kind] ?? lists[item.kind][item.index];
}

export function centre(course, item) {
  const it = part(course, item);
  if (item.kind === "fence") return [it.min_m[0], it.min_m[1], it.max_m[2]];
  if (item.kind === "box") return it.min_m.map((value, k) => (value + it.max_m[k]) / 2);
  return it.center_m ?? it.position_m;
}

/**
 * Returns the handles of an item: {id, at, axis}. A handle with an axis moves along it, others move horizontally, or
 * along z.
 */
export function handles(course, item) {
  const it = part(course, item), c = centre(course, item);
  const list = [];
  if (item.kind === "fence" || item.kind === "box") {
    const middle = it.min_m.map((value, k) => (value + it.max_m[k]) / 2);
    for (const axis of [0, 1, 2])
      for (const end of ["min_m", "max_m"]) {
        const at = [...middle];
        at[axis] = it[end][axis];
        list.push({ id: `${end} ${axis}`, at, axis: [0, 1, 2].map((k) => +(k === axis)) });
      }
    if (item.kind === "box") list.push({ id: "move", at: c });
    return list;
  }
  list.push({ id: "move", at: c });
  if (item.kind === "goal") list.push({ id: "radius", at: [c[0] + it.radius_m, c[1], c[2]], axis: [1, 0, 0] });
  if (item.kind === "gate") {
    const yaw = yawOf(it.normal), [lx, ly] = along(yaw + Math.PI / 2, 1);
    const [ax, ay] = along(yaw, 0.7);
    list.push({ id: "turn", at: [c[0] + ax, c[1] + ay, c[2]] });
    list.push({ id: "width", at: [c[0] - (lx * it.width_m) / 2, c[1] - (ly * it.width_m) / 2, c[2]], axis: [-lx, -ly, 0] });
    list.push({ id: "height", at: [c[0], c[1], c[2] + it.height_m / 2], axis: [0, 0, 1] });
  }
  if (item.kind === "start" || item.kind === "object") {
    const [ax, ay] = along((it.yaw_deg * Math.PI) / 180, 0.6);
    list.push({ id: "turn", at: [c[0] + ax, c[1] + ay, c[2]] });
  }
  if (it.motion?.kind === "path")
    list.push(...it.motion.points_m.map((p, k) => ({ id: `point ${k}`, at: toWorld(it, p) })));
  return list;
}

const turned = ([x, y], yaw) => [x * Math.cos(yaw) - y * Math.sin(yaw), x * Math.sin(yaw) + y * Math.cos(yaw)];
/** Converts from the frame of an object at rest. */
export function toWorld({ position_m: at, yaw_deg }, [x, y, z]) {
  const [a, b] = turned([x, y], (yaw_deg * Math.PI) / 180);
  return [at[0] + a, at[1] + b, at[2] + z];
}
function toObject({ position_m: at, yaw_deg }, p) {
  const [x, y] = turned([p[0] - at[0], p[1] - at[1]], (-yaw_deg * Math.PI) / 180);
  return [x, y, p[2] - at[2]];
}

/**
 * Moves a handle to a position, and changes the course. `free` disables steps; `surface` is the surface under the
 * pointer, to which faces of boxes and of the fence snap.
 */
export function drag(course, item, id, to, { free = false, surface = null, floor_z_m = 0 } = {}) {
  const it = part(course, item);
  const step = (value, size = STEP_M) => round(value, free ? 0.001 : size);
  const p = to.map((value) => step(value));
  const stick = (value, towards) => (!free && towards != null && Math.abs(value - towards) < REACH_M ? round(towards, 0.001) : value);
  if (id === "turn") {
    const c = centre(course, item);
    const yaw = step(degrees(Math.atan2(to[1] - c[1], to[0] - c[0])), STEP_DEG);
    if (item.kind === "gate") setYaw(it, yaw);
    else it.yaw_deg = yaw;
  } else if (id === "radius") it.radius_m = Math.max(0.1, step(to[0] - it.position_m[0]));
  else if (id === "width" || id === "height") {
    const c = it.center_m;
    const half = id === "height" ? to[2] - c[2] : Math.hypot(to[0] - c[0], to[1] - c[1]);
    it[`${id}_m`] = Math.min(10, Math.max(0.1, round(2 * half, free ? 0.01 : STEP_M)));
  } else if (id.startsWith("point ")) it.motion.points_m[+id.slice(6)] = toObject(it, p).map((value) => round(value, 0.001));
  else if (id === "move" && item.kind === "box") {
    const c = centre(course, item);
    const bottom = stick(it.min_m[2] + p[2] - c[2], floor_z_m) - it.min_m[2];
    const by = [p[0] - c[0], p[1] - c[1], bottom];
    for (const end of ["min_m", "max_m"]) it[end] = it[end].map((value, k) => round(value + by[k], 0.001));
  } else if (id === "move") {
    const below = item.kind === "gate" ? it.height_m / 2 + (frameOf(course, it) ? BAR_M : 0) : 0;
    p[2] = round(stick(p[2], item.kind === "goal" ? null : floor_z_m + below), 0.001);
    if (item.kind === "gate") it.center_m = p;
    else it.position_m = p;
  } else {
    const [end, axis] = id.split(" ");
    const other = it[end === "min_m" ? "max_m" : "min_m"][axis];
    let value = stick(p[axis], surface?.[axis]);
    if (item.kind === "box") value = stick(value, course.geofence[end][axis]);
    if (+axis === 2 && end === "min_m") value = stick(value, floor_z_m);
    it[end][axis] = end === "min_m" ? Math.min(value, round(other - 0.1, 0.001)) : Math.max(value, round(other + 0.1, 0.001));
  }
  if (item.kind === "gate") settle(course, it);
}

/** Turns a stage; its direction becomes level. */
export function setYaw(stage, yaw_deg) {
  stage.normal = along((yaw_deg * Math.PI) / 180, 1).map((value) => round(value, 0.001)).concat(0);
}
export const yawOfGate = (stage) => Math.round(degrees(yawOf(stage.normal)) * 10) / 10;

/** Fits a stage's frame to its size. */
export function settle(course, stage) {
  const frame = frameOf(course, stage);
  if (!frame) return;
  const colour = frame.scene.match(/-([a-z]+)\.ply$/)?.[1] ?? "orange";
  Object.assign(frame, {
    position_m: [...stage.center_m], yaw_deg: yawOfGate(stage),
    scene: `models/gate-${cm(stage.width_m)}x${cm(stage.height_m)}-${colour}.ply`,
  });
}

/** Adds a frame in a colour to a stage, or removes it. */
export function setFrame(course, stage, colour) {
  course.objects = course.objects.filter((object) => object.name !== frameName(stage));
  if (!colour) return;
  course.objects.push({ name: frameName(stage), scene: `models/gate-10x10-${colour}.ply`, position_m: [0, 0, 0], yaw_deg: 0 });
  settle(course, stage);
}

/** Renames an item, and the frame of a stage. */
export function rename(course, item, name) {
  const it = part(course, item);
  const frame = item.kind === "gate" && frameOf(course, it);
  it.name = name;
  if (frame) frame.name = frameName(it);
}

export function remove(course, item) {
  if (item.kind === "goal") course.goal = null;
  if (item.kind === "gate") setFrame(course, part(course, item), null);
  const lists = { gate: course.stages, box: course.no_fly, object: course.objects };
  lists[item.kind]?.splice(item.index, 1);
}

/** Adds an item at a position, in the direction of the camera; returns its key. */
export function add(course, kind, [x, y], yaw, floor_z_m) {
  const [px, py] = [round(x, STEP_M), round(y, STEP_M)];
  const yaw_deg = round(degrees(yaw), STEP_DEG);
  const unused = (word) => {
    const taken = new Set([...course.stages, ...course.no_fly, ...course.objects].map((it) => it.name));
    let n = 1;
    while (taken.has(`${word} ${n}`)) n++;
    return `${word} ${n}`;
  };
  if (kind === "gate") {
    const stage = { name: unused("gate"), center_m: [px, py, round(floor_z_m + 1.2, 0.001)], normal: [1, 0, 0], width_m: 1.2, height_m: 1 };
    setYaw(stage, yaw_deg);
    course.stages.push(stage);
    setFrame(course, stage, "orange");
    return `stages[${course.stages.length - 1}]`;
  }
  if (kind === "box") {
    const z = floor_z_m;
    course.no_fly.push({ name: unused("keep out"), min_m: [px - 0.4, py - 0.4, z].map((v) => round(v, 0.001)), max_m: [px + 0.4, py + 0.4, z + 1].map((v) => round(v, 0.001)) });
    return `no_fly[${course.no_fly.length - 1}]`;
  }
  if (kind === "goal") {
    course.goal = { position_m: [px, py, round(floor_z_m + 1.2, 0.001)], radius_m: 0.5 };
    return "goal";
  }
  const object = kind === "drone"
    ? { name: unused("drone"), scene: "models/quadrotor.ply", position_m: [px, py, round(floor_z_m + 1.2, 0.001)], yaw_deg,
        motion: { kind: "path", points_m: [[0, -0.8, 0], [0, 0.8, 0]], speed_mps: 0.6, closed: false } }
    : { name: unused("pillar"), scene: "models/box-40x40x180-blue.ply", position_m: [px, py, floor_z_m], yaw_deg };
  course.objects.push(object);
  return `objects[${course.objects.length - 1}]`;
}

// ---- from the pointer to the world -------------------------------------------------------------
const dot = (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0);

/** Returns the ray through a point of the image (in fractions of its size from the centre, -0.5 to 0.5) that a request shows. */
export function ray(request, [u, v]) {
  const [cy, sy] = [Math.cos(request.yaw_rad), Math.sin(request.yaw_rad)];
  const [cp, sp] = [Math.cos(request.pitch_rad), Math.sin(request.pitch_rad)];
  const wide = 2 * Math.tan((request.fov_deg * Math.PI) / 360);
  const [x, y] = [u * wide, (v * wide * request.height_px) / request.width_px];
  const [right, down, ahead] = [[sy, -cy, 0], [cy * sp, sy * sp, -cp], [cy * cp, sy * cp, sp]];
  return { from: request.p_m, way: ahead.map((value, k) => value + right[k] * x + down[k] * y) };
}

/**
 * Returns the intersection of a ray with the horizontal plane of a point, up to a maximum distance; null without one. A
 * plane at the height of the camera is a line: then the point moves only sideways.
 */
export function onLevel({ from, way }, at, farthest_m = 200) {
  const flat = [way[0], way[1], 0];
  const isEdgeOn = Math.abs(at[2] - from[2]) < 0.12 * Math.hypot(at[0] - from[0], at[1] - from[1]);
  const gap = at.map((value, k) => value - from[k]);
  const t = isEdgeOn ? dot([gap[0], gap[1], 0], gap) / dot([gap[0], gap[1], 0], flat) : gap[2] / way[2];
  const reached = from.map((value, k) => value + way[k] * t);
  return t > 0 && Math.hypot(...reached.map((value, k) => value - from[k])) < farthest_m ? [reached[0], reached[1], at[2]] : null;
}

/** Returns the point of a line (through a point along an axis) that is nearest to a ray; null if they are parallel. */
export function onLine({ from, way }, at, axis) {
  const gap = at.map((value, k) => value - from[k]);
  const [aa, aw, ww] = [dot(axis, axis), dot(axis, way), dot(way, way)];
  const slope = aa * ww - aw * aw;
  if (slope < 1e-6 * aa * ww) return null;
  const s = (aw * dot(way, gap) - ww * dot(axis, gap)) / slope;
  return at.map((value, k) => value + axis[k] * s);
}
