// Tests of the detection that the browser draws the 3D view too slowly.
//
//   node --test tests/page/draw_rate.test.cjs

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const test = require("node:test");

const source = fs.readFileSync(path.join(__dirname, "../../render-server/server/src/web/page/draw_rate.js"));
const module_ = import(`data:text/javascript;base64,${source.toString("base64")}`);

/** Returns the results for images at these times, without unknown ones. */
const said = (rate, times_ms) => times_ms.map((at_ms) => rate.note(at_ms)).filter((isSlow) => isSlow !== null);
const every = (period_ms, from_ms, to_ms) =>
  Array.from({ length: Math.floor((to_ms - from_ms) / period_ms) + 1 }, (_, k) => from_ms + k * period_ms);

test("ten images per second are enough, nine are not", async () => {
  const { DrawRate } = await module_;
  assert.deepEqual(said(new DrawRate(), every(1000 / 9, 0, 16_000)), [true, true, true]);
  assert.deepEqual(said(new DrawRate(), every(100, 0, 15_000)), [false, false, false]);
  assert.deepEqual(said(new DrawRate(), every(1000 / 60, 0, 5100)), [false]);
});

test("the first seconds and hidden time are not rated", async () => {
  const { DrawRate } = await module_;
  const rate = new DrawRate();
  assert.deepEqual(said(rate, every(1000, 0, 4000)), []);
  // Hidden for an hour.
  rate.restart();
  assert.deepEqual(said(rate, every(20, 3_600_000, 3_605_000)), [false]);
  // One image that takes half a minute is too slow.
  assert.deepEqual(said(rate, [3_635_000]), [true]);
});
