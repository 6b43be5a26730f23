// Tests of dragging items of a course, without a browser.
//
//   node --test tests/page/course_items.test.cjs

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const test = require("node:test");

const source = fs.readFileSync(path.join(__dirname, "../../render-server/server/src/web/editors/page/course_items.js"));
const module_ = import(`data:text/javascript;base64,${source.toString("base64")}`);

function course() {
  return {
    spawn: { position_m: [1, 1, 0], yaw_deg: 0 }, takeoff_height_m: 1, goal: null,
    geofence: { min_m: [0, 0, -0.5], max_m: [8, 4, 3] }, no_fly: [], stages: [], objects: [],
  };
}
const find = (items, of, key) => items.items(of).find((item) => item.key === key);

test("a gate stays on the floor inside its frame after every change", async () => {
  const items = await module_, of = course();
  const key = items.add(of, "gate", [3.02, 1.98], 0.8, 0);
  const [gate] = of.stages, [frame] = of.objects, item = find(items, of, key);
  assert.deepEqual([gate.center_m, items.yawOfGate(gate)], [[3, 2, 1.2], 45]);
  assert.deepEqual([frame.scene, frame.position_m, frame.yaw_deg], ["models/gate-120x100-orange.ply", [3, 2, 1.2], 45]);
  assert.ok(!items.items(of).some(({ kind }) => kind === "object"), "its frame is not a separate item");
  items.drag(of, item, "move", [4.013, 2, 0.62]);
  assert.deepEqual(gate.center_m, [4, 2, 0.56], "a bar above the floor");
  items.drag(of, item, "move", [4.013, 2, 0.62], { free: true });
  assert.deepEqual(gate.center_m, [4.013, 2, 0.62]);
  items.drag(of, item, "turn", [4.013, 3, 0.62]);
  assert.deepEqual(gate.normal, [0, 1, 0]);
  items.drag(of, item, "width", [4.713, 2, 0.62]);
  items.drag(of, item, "height", [4.013, 2, 1.02]);
  assert.deepEqual([gate.width_m, gate.height_m], [1.4, 0.8]);
  assert.deepEqual([frame.scene, frame.position_m, frame.yaw_deg], ["models/gate-140x80-orange.ply", gate.center_m, 90]);
  items.setFrame(of, gate, "blue");
  items.rename(of, item, "left");
  assert.deepEqual(of.objects.map(({ name, scene }) => [name, scene]), [["left frame", "models/gate-140x80-blue.ply"]]);
  items.remove(of, find(items, of, key));
  assert.deepEqual([of.stages, of.objects], [[], []]);
});

test("faces of boxes snap to fence, floor and surfaces, and never meet", async () => {
  const items = await module_, of = course();
  const item = find(items, of, items.add(of, "box", [4, 2], 0, 0));
  const [box] = of.no_fly;
  items.drag(of, item, "max_m 0", [7.93, 2, 0.5]);
  assert.equal(box.max_m[0], 8);
  items.drag(of, item, "max_m 1", [4, 2.5, 0.5], { surface: [4, 2.57, 0.5] });
  assert.equal(box.max_m[1], 2.57);
  items.drag(of, item, "min_m 2", [4, 2, 0.08]);
  assert.equal(box.min_m[2], 0);
  items.drag(of, item, "min_m 0", [9, 2, 0]);
  assert.equal(box.min_m[0], 7.9);
  items.drag(of, item, "move", items.centre(of, item).map((value, k) => value + [-1, 0.5, 0][k]));
  assert.deepEqual([box.min_m[0], box.max_m[0]].map((value) => Math.round(value * 100)), [690, 700]);
});

test("points of a path are dragged in the world and stored in the object's frame", async () => {
  const items = await module_, of = course();
  const item = find(items, of, items.add(of, "drone", [4, 2], Math.PI / 2, 0));
  const [drone] = of.objects;
  const first = items.handles(of, item).find(({ id }) => id === "point 0");
  assert.deepEqual(first.at.map((value) => Math.round(value * 1000) / 1000), [4.8, 2, 1.2]);
  items.drag(of, item, "point 0", [4, 3, 1.2]);
  assert.deepEqual(drone.motion.points_m[0], [1, 0, 0]);
  assert.deepEqual(items.toWorld(drone, [1, 0, 0]).map((value) => Math.round(value * 1000) / 1000), [4, 3, 1.2]);
});

test("names are unique, and there is at most one goal", async () => {
  const items = await module_, of = course();
  for (const kind of ["gate", "gate", "pillar", "pillar", "box", "goal"]) items.add(of, kind, [2, 2], 0, 0);
  const names = items.items(of).map(({ name }) => name);
  assert.deepEqual(names, ["start", "fence", "goal", "gate 1", "gate 2", "keep out 1", "pillar 1", "pillar 2"]);
  items.remove(of, find(items, of, "goal"));
  assert.equal(of.goal, null);
});

test("the pointer's ray hits the surface in the image", async () => {
  const items = await module_;
  const request = { p_m: [1, 2, 1.5], yaw_rad: 0.3, pitch_rad: -0.4, fov_deg: 75, width_px: 1440, height_px: 900 };
  const middle = items.ray(request, [0, 0]);
  const floor = items.onLevel(middle, [4, 2, 0]);
  const ahead = 1.5 / Math.tan(0.4);
  assert.ok(Math.hypot(floor[0] - 1 - ahead * Math.cos(0.3), floor[1] - 2 - ahead * Math.sin(0.3)) < 1e-9);
  assert.equal(items.onLevel(items.ray({ ...request, pitch_rad: 0.4 }, [0, 0]), [4, 2, 0]), null, "no floor above the horizon");
  // At the right edge of the image the ray is half the field of view to the right.
  const { way } = items.ray({ ...request, pitch_rad: 0 }, [0.5, 0]);
  assert.ok(Math.abs(Math.atan2(way[1], way[0]) - (0.3 - (37.5 * Math.PI) / 180)) < 1e-9);
  // A gate at the height of the camera is moved sideways.
  const level = items.onLevel(items.ray({ ...request, yaw_rad: 0, pitch_rad: 0 }, [0.25, 0.1]), [5, 2, 1.5]);
  assert.ok(Math.abs(level[0] - 5) < 1e-9 && level[1] < 1 && level[2] === 1.5, String(level));
  const post = items.onLine(middle, [floor[0], floor[1], 3], [0, 0, 1]);
  assert.ok(Math.abs(post[2]) < 1e-9, "up the post from its foot");
  assert.equal(items.onLine({ from: [0, 0, 0], way: [0, 0, 1] }, [1, 0, 0], [0, 0, 1]), null);
});
