// Tests of recorded flights, without a browser.
//
//   node --test tests/page/flight_recording.test.cjs

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const test = require("node:test");

const source = fs.readFileSync(path.join(__dirname, "../../render-server/server/src/web/page/flight_recording.js"));
const page = import(`data:text/javascript;base64,${source.toString("base64")}`);

/** Returns a state at a time, at this distance to the east, rotated by this angle about the vertical. */
function state(flight_s, east_m, yaw_rad = 0) {
  const rotation = [0, 0, Math.sin(yaw_rad / 2), Math.cos(yaw_rad / 2)];
  return { flight_s, pose: { p_world_m: [east_m, 2, 1], v_world_mps: [1, 0, 0], rotation, yaw_rad, age_s: 0 }, objects: [] };
}

test("ignores states that do not belong to a flight", async () => {
  const recording = new (await page).FlightRecording();
  assert.deepEqual([recording.end_s, recording.at(0)], [0, null]);
  recording.add(state(null, 0), new Set());
  recording.add({ ...state(0.5, 0), pose: null }, new Set());
  recording.add(state(1, 0), new Set());
  recording.add(state(1, 5), new Set());
  recording.add(state(0.9, 5), new Set());
  assert.equal(recording.moments.length, 1);
  assert.deepEqual([recording.start_s, recording.end_s], [1, 1]);
  recording.clear();
  assert.equal(recording.at(1), null);
});

test("poses are interpolated, stages are those of the preceding state", async () => {
  const recording = new (await page).FlightRecording();
  const passed = new Set();
  recording.add(state(1, 0, 3.1), passed);
  recording.add(state(2, 4, -3.1), passed.add(0));
  recording.add(state(4, 4, -3.1), passed);
  const half = recording.at(1.5);
  assert.equal(half.pose.p_world_m[0], 2);
  assert.deepEqual([...half.passed], []);
  // The short direction: from 3.1 to -3.1 rad over pi.
  assert.ok(Math.abs(Math.abs(half.pose.yaw_rad) - Math.PI) < 1e-9);
  assert.ok(Math.abs(Math.abs(half.pose.rotation[2]) - 1) < 1e-9);
  assert.deepEqual([...recording.at(3).passed], [0]);
  // Outside the recording, the first or last state.
  assert.equal(recording.at(-1).pose.p_world_m[0], 0);
  assert.equal(recording.at(99).flight_s, 4);
});
