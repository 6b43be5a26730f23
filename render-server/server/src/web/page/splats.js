// Splats of the twin for the 3D view: parsed from SPZ, and sorted. Drawing is in `space_twin.js`.

/** Splats in a row of the texture. */
export const ROW = 1024;
/** Texels of a splat: centre and opacity; covariance xx xy xz yy; covariance yz zz, colour. */
export const TEXELS = 3;

const MAGIC = 0x5053474e;
const HEADER = 16;
/** Constant of the zeroth harmonic, and SPZ's scale of it. */
const SH_C0 = 0.28209479177387814, COLOUR_SCALE = 0.15;

/**
 * Returns the texels of a twin's part, [m, world]: four numbers each, `TEXELS` a splat. The colour is one number, red *
 * 65536 + green * 256 + blue, each 0 to 255. Throws if the bytes are not SPZ 2 without harmonics.
 * @param {ArrayBuffer} inflated the file's bytes after gunzip
 */
export function readSpz(inflated) {
  const bytes = new Uint8Array(inflated), view = new DataView(inflated);
  const head = bytes.length >= HEADER && view.getUint32(0, true) === MAGIC && view.getUint32(4, true) === 2 && bytes[12] === 0;
  const count = head ? view.getUint32(8, true) : 0;
  // Positions 9 bytes, opacity 1, colour 3, scales 3, rotation 3.
  if (!head || bytes.length < HEADER + 19 * count) throw new Error("not a part of a twin");
  const unit = 1 / (1 << bytes[13]);
  const opacities = HEADER + 9 * count, colours = opacities + count, scales = colours + 3 * count, turns = scales + 3 * count;
  const texels = new Float32Array(4 * TEXELS * count);
  const fixed = (/** @type {number} */ at) => ((bytes[at] << 8) | (bytes[at + 1] << 16) | (bytes[at + 2] << 24)) >> 8;
  const level = (/** @type {number} */ at) => {
    const value = ((bytes[at] / 255 - 0.5) / COLOUR_SCALE) * SH_C0 + 0.5;
    return Math.round(255 * Math.min(1, Math.max(0, value)));
  };
  for (let k = 0; k < count; k++) {
    const at = HEADER + 9 * k, to = 4 * TEXELS * k;
    // The file's axes are right, up, back; the world's numbers are those of the scene's file: y and z change sign.
    texels[to] = fixed(at) * unit;
    texels[to + 1] = -fixed(at + 3) * unit;
    texels[to + 2] = -fixed(at + 6) * unit;
    texels[to + 3] = bytes[opacities + k] / 255;
    const [x, y, z] = [0, 1, 2].map((axis) => bytes[turns + 3 * k + axis] / 127.5 - 1);
    const w = Math.sqrt(Math.max(0, 1 - x * x - y * y - z * z));
    const [a, b, c] = [0, 1, 2].map((axis) => Math.exp(2 * (bytes[scales + 3 * k + axis] / 16 - 10)));
    // The axes as columns, each times its variance, times themselves.
    const [xx, xy, xz] = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)];
    const [yx, yy, yz] = [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)];
    const [zx, zy, zz] = [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)];
    texels[to + 4] = a * xx * xx + b * xy * xy + c * xz * xz;
    texels[to + 5] = -(a * xx * yx + b * xy * yy + c * xz * yz);
    texels[to + 6] = -(a * xx * zx + b * xy * zy + c * xz * zz);
    texels[to + 7] = a * yx * yx + b * yy * yy + c * yz * yz;
    texels[to + 8] = a * yx * zx + b * yy * zy + c * yz * zz;
    texels[to + 9] = a * zx * zx + b * zy * zy + c * zz * zz;
    texels[to + 10] = level(colours + 3 * k) * 65536 + level(colours + 3 * k + 1) * 256 + level(colours + 3 * k + 2);
  }
  return texels;
}

/**
 * Returns the splats' indices, farthest along a direction first; by a counting sort of 65,536 depths.
 * @param {Float32Array} texels as of `readSpz`
 * @param {readonly number[]} ahead direction of the camera [world]
 */
export function backToFront(texels, ahead) {
  const count = texels.length / 4 / TEXELS, LEVELS = 65536;
  const depths = new Float32Array(count);
  let nearest = Infinity, furthest = -Infinity;
  for (let k = 0; k < count; k++) {
    const at = 4 * TEXELS * k;
    const depth = texels[at] * ahead[0] + texels[at + 1] * ahead[1] + texels[at + 2] * ahead[2];
    depths[k] = depth;
    nearest = Math.min(nearest, depth);
    furthest = Math.max(furthest, depth);
  }
  const scale = (LEVELS - 1) / Math.max(1e-9, furthest - nearest);
  const level = (/** @type {number} */ k) => Math.floor((furthest - depths[k]) * scale);
  const starts = new Uint32Array(LEVELS + 1);
  for (let k = 0; k < count; k++) starts[level(k) + 1]++;
  for (let k = 0; k < LEVELS; k++) starts[k + 1] += starts[k];
  const order = new Float32Array(count);
  for (let k = 0; k < count; k++) order[starts[level(k)]++] = k;
  return order;
}
