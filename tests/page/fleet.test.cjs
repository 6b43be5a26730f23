// Tests of several vehicles on the page: tracks by flight, and positions between two messages.
//
//   node --test tests/page/fleet.test.cjs

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const test = require("node:test");

const source = fs.readFileSync(path.join(__dirname, "../../render-server/server/src/web/page/fleet.js"));
const fleet = import(`data:text/javascript;base64,${source.toString("base64")}`);
const poseAt = (x, age_s = 0) => ({ p_world_m: [x, 0, 1], v_world_mps: [2, 0, 0], rotation: [0, 0, 0, 1], yaw_rad: 0, age_s });
const line = (name, pose, flight_s) => ({ name, phase: "flying", pose, flight_s });

test("a track continues the server's, and restarts with the next flight", async () => {
  const { Fleet } = await fleet;
  const all = new Fleet();
  all.setTrack("bee", [[0, 0, 1, 0]]);
  for (const x of [1, 1.01, 2]) all.update([line("bee", poseAt(x), x), line("ant", null, null)], 0);
  assert.deepEqual(all.others.map(({ name }) => name), ["bee"], "without a pose there is nothing to draw");
  assert.deepEqual(all.others[0].track.map(([x]) => x), [0, 1, 2]);
  all.update([line("bee", poseAt(3), null)], 0);
  assert.deepEqual(all.others[0].track.map(([x]) => x), [3]);
});

test("a vehicle's position is extrapolated for 0.1 s, and not from an old pose", async () => {
  const { movedOn, received } = await fleet;
  assert.deepEqual(movedOn(received(poseAt(1), 1000), 1050), [1.1, 0, 1]);
  assert.deepEqual(movedOn(received(poseAt(1), 1000), 9000), [1.2, 0, 1]);
  const { received_ms } = received(poseAt(1, 0.6), 1000);
  assert.equal(received_ms, -Infinity);
});

test("a long track is thinned and keeps its end", async () => {
  const { extended } = await fleet;
  let track = [];
  for (let x = 0; x < 9000; x += 1) track = extended(track, poseAt(x));
  assert.ok(track.length <= 3000 && track.at(-1)[0] > 8990, `${track.length}, ${track.at(-1)}`);
  assert.equal(extended(track, poseAt(99_999, 1)), track, "an old pose adds nothing");
});
