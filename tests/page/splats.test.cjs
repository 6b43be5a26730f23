// Tests of parsing and sorting a twin's splats, without a browser.
//
//   node --test tests/page/splats.test.cjs

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const test = require("node:test");

const source = fs.readFileSync(path.join(__dirname, "../../render-server/server/src/web/page/splats.js"));
const page = import(`data:text/javascript;base64,${source.toString("base64")}`);

/** Returns an SPZ 2 file, inflated, of splats in the fixed-point numbers and bytes of its specification. */
function spz(splats, fractionalBits = 12) {
  const count = splats.length, bytes = new Uint8Array(16 + 19 * count), view = new DataView(bytes.buffer);
  view.setUint32(0, 0x5053474e, true);
  view.setUint32(4, 2, true);
  view.setUint32(8, count, true);
  bytes[13] = fractionalBits;
  splats.forEach(({ position, alpha, colour, scale, rotation }, k) => {
    position.forEach((value, axis) => {
      const fixed = Math.round(value * 2 ** fractionalBits);
      for (let byte = 0; byte < 3; byte++) bytes[16 + 9 * k + 3 * axis + byte] = (fixed >> (8 * byte)) & 255;
    });
    bytes[16 + 9 * count + k] = alpha;
    bytes.set(colour, 16 + 10 * count + 3 * k);
    bytes.set(scale, 16 + 13 * count + 3 * k);
    bytes.set(rotation, 16 + 16 * count + 3 * k);
  });
  return bytes.buffer;
}

/** Quaternion bytes x, y, z: 255 is half a turn, 127 or 128 is no rotation. */
const PLAIN = { position: [1, -2, 3], alpha: 255, colour: [128, 128, 128], scale: [160, 144, 128], rotation: [128, 128, 128] };
const near = (found, expected, within = 1e-2) => assert.ok(Math.abs(found - expected) <= within * Math.max(1, Math.abs(expected)), `${found}, not ${expected}`);

test("decodes positions, opacity, colour and scales as specified, in the scene's axes", async () => {
  const { readSpz } = await page;
  const texels = readSpz(spz([PLAIN, { ...PLAIN, alpha: 0, colour: [255, 0, 128] }]));
  assert.equal(texels.length, 24);
  assert.deepEqual([...texels.slice(0, 4)], [1, 2, -3, 1]);
  // Variances e^0, e^-2, e^-4.
  for (const [k, value] of [[4, 1], [7, Math.exp(-2)], [9, Math.exp(-4)], [5, 0], [6, 0], [8, 0]]) near(texels[k], value);
  assert.equal(texels[12 + 3], 0);
  // A byte of 255 is 0.5 / 0.15 of the constant harmonic: brighter than white.
  const rgb = texels[12 + 10];
  assert.deepEqual([rgb >> 16, (rgb >> 8) & 255], [255, 0]);
  near(rgb & 255, 128, 0.02);
});

test("a splat that is rotated about z has its longer side in the right direction", async () => {
  const { readSpz } = await page;
  // 30 degrees about the file's z: sin 15 = 0.2588. The file's z is the world's -z: the turn is -30 degrees.
  const turned = { ...PLAIN, scale: [160, 128, 128], rotation: [128, 128, Math.round(127.5 * (1 + Math.sin(Math.PI / 12)))] };
  const texels = readSpz(spz([turned]));
  const [cos, sin] = [Math.cos(Math.PI / 6), Math.sin(Math.PI / 6)], small = Math.exp(-4);
  near(texels[4], cos * cos + small * sin * sin, 0.03);
  near(texels[5], -(1 - small) * cos * sin, 0.03);
  near(texels[7], sin * sin + small * cos * cos, 0.03);
});

test("rejects invalid and truncated parts", async () => {
  const { readSpz } = await page;
  const whole = spz([PLAIN, PLAIN]);
  for (const length of [0, 3, 15, 16, 17, 40, whole.byteLength - 1]) assert.throws(() => readSpz(whole.slice(0, length)), /not a part/);
  const other = new Uint8Array(whole.slice());
  other[4] = 3;
  assert.throws(() => readSpz(other.buffer), /not a part/);
});

test("the farthest splat is drawn first, in every direction", async () => {
  const { readSpz, backToFront } = await page;
  const texels = readSpz(spz([5, 1, 4, 2, 3].map((x) => ({ ...PLAIN, position: [x, x * 0.1, 0] }))));
  assert.deepEqual([...backToFront(texels, [1, 0, 0])], [0, 2, 4, 3, 1]);
  assert.deepEqual([...backToFront(texels, [-1, 0, 0])], [1, 3, 4, 2, 0]);
  assert.deepEqual([...backToFront(texels, [0, 0, 1])].sort(), [0, 1, 2, 3, 4]);
  assert.equal(backToFront(new Float32Array(), [1, 0, 0]).length, 0);
});
