// Tests of flights as files, without a browser: written files can be read, invalid files are rejected with a reason.
//
//   node --test tests/page/flight_file.test.cjs

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const test = require("node:test");

const url = (text) => `data:text/javascript;base64,${Buffer.from(text).toString("base64")}`;
const source = (name) => fs.readFileSync(path.join(__dirname, "../../render-server/server/src/web/page", name), "utf8");
const recordingUrl = url(source("flight_recording.js"));
const file = import(url(source("flight_file.js").replace('"./flight_recording.js"', `"${recordingUrl}"`)));
const recordings = import(recordingUrl);

const ABOUT = { arena: "race", vehicle: "vizflyt", outcome: "Finished", at: "2026-01-02T03:04:05.000Z" };

async function flight() {
  const recording = new (await recordings).FlightRecording();
  for (let k = 0; k < 5; k++) {
    const pose = { p_world_m: [k, 2, 1], v_world_mps: [1, 0, 0], rotation: [0, 0, 0, 1], yaw_rad: 0.1 * k, age_s: 0 };
    const hand = { name: "hand", id: 1, p_world_m: [4, 0, 1], q_xyzw: [0, 0, 0, 1], min_m: [0, 0, 0], max_m: [1, 1, 1] };
    recording.add({ flight_s: 0.05 + k / 20, pose, objects: [hand] }, new Set(k > 2 ? [0] : []));
  }
  return recording;
}

test("reads written flights", async () => {
  const { writeFlight, readFlight } = await file, recording = await flight();
  const { recording: read, about } = readFlight(writeFlight(recording, ABOUT));
  assert.deepEqual(about, ABOUT);
  assert.equal(read.moments.length, 5);
  assert.deepEqual(read.at(0.13), recording.at(0.13));
  assert.deepEqual([...read.at(1).passed], [0]);
  assert.deepEqual(read.track()[2], [2, 2, 1, 1]);
});

test("rejects invalid files with a reason", async () => {
  const { writeFlight, readFlight } = await file;
  const good = JSON.parse(writeFlight(await flight(), ABOUT));
  const refused = (change, words) => {
    const bad = structuredClone(good);
    change(bad);
    assert.throws(() => readFlight(JSON.stringify(bad)), words);
  };
  assert.throws(() => readFlight("{"), /no JSON/);
  assert.throws(() => readFlight("[1]"), /no flight of VizFlyt/);
  assert.throws(() => readFlight("null"), /no flight of VizFlyt/);
  refused((bad) => (bad.vizflyt_flight = 2), /version 2; this page reads 1/);
  refused((bad) => (bad.moments = {}), /moments is wrong: no list/);
  refused((bad) => (bad.moments[3] = null), /moment 3 is wrong: no list/);
  refused((bad) => (bad.moments[1][1] = [1, 2]), /moment 1 is wrong: 3 numbers/);
  refused((bad) => (bad.moments[1][3] = [0, 0, 0, 2]), /moment 1 is wrong: a rotation/);
  refused((bad) => (bad.moments[2][0] = 0.01), /moment 2 is wrong: its time/);
  refused((bad) => (bad.moments[0][0] = null), /moment 0 is wrong: a number/);
  refused((bad) => (bad.moments[0][6][0].q_xyzw = "turned"), /moment 0 is wrong: no list/);
});

test("any changed file is read as a flight or rejected", async () => {
  const { writeFlight, readFlight } = await file;
  const text = writeFlight(await flight(), ABOUT);
  let seed = 1;
  const random = (below) => {
    seed = (seed * 48271) % 2147483647;
    return seed % below;
  };
  const pieces = ["", "null", "[]", "{}", "1e999", '"x"', "-1", ",", "]"];
  for (let k = 0; k < 3000; k++) {
    const at = random(text.length), piece = pieces[random(pieces.length)];
    const changed = text.slice(0, at) + piece + text.slice(at + random(12));
    try {
      const { recording } = readFlight(changed);
      for (const moment of recording.moments) assert.ok([moment.flight_s, ...moment.pose.p_world_m, ...moment.pose.rotation].every(Number.isFinite));
    } catch (error) {
      assert.equal(error.constructor, Error, `${error.stack}`);
    }
  }
});
