// Pass 3 of training: renders the channels of each tile's pixels from near to far. Pass 4: propagates the derivative
// of a loss by the pixels back to the pairs of the tile's list. One workgroup per tile; each thread processes four
// pixels of a row. The layout of planes is that of `Planes` of `vizflyt-twin`: by band of tiles, then channel, then
// row.

@group(0) @binding(1) var<storage, read> shapes: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> extents: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> colours: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> slots: array<u32>;
@group(0) @binding(5) var<storage, read> lists: array<vec2<u32>>;
// Red, green, blue, sum w z, sum w z^2, transmittance.
@group(0) @binding(6) var<storage, read_write> image: array<f32>;
// Derivative of the loss by each of these, and the error of a pixel.
@group(0) @binding(7) var<storage, read> by: array<f32>;
// Twelve values per pair, the last one unused.
@group(0) @binding(8) var<storage, read_write> pair_sums: array<f32>;

const ALPHA_MAX = 0.99;
const TRANSMITTANCE_MIN = 1e-4;
const CHANNELS = 6u;
const BY_CHANNELS = 7u;
/// Maximum number of workgroups along x.
const GRID = 32768u;
const THREADS = 64u;
const BATCH = 64u;

var<workgroup> batch_shapes: array<vec4<f32>, BATCH>;
var<workgroup> batch_extents: array<vec4<f32>, BATCH>;
var<workgroup> batch_colours: array<vec4<f32>, BATCH>;
/// Number of threads with all pixels ended.
var<workgroup> ended: atomic<u32>;
var<workgroup> ended_before: u32;

/// Four pixels of a thread.
struct Quad {
    /// Index of the first value in the first channel of a plane.
    place: u32,
    /// Pixel centres. [px]
    x: vec4<f32>,
    y: f32,
    /// Pixels that are within the image.
    exists: vec4<bool>,
}

fn quad(tile: u32, thread: u32, channels: u32) -> Quad {
    let column = tile % photo.size.z;
    let band = tile / photo.size.z;
    let in_tile = vec2(thread % 4u * 4u, thread / 4u);
    let pixel = vec2(column, band) * TILE + in_tile;
    let width = photo.size.z * TILE;
    let place = (band * channels * TILE + in_tile.y) * width + pixel.x;
    let across = vec4(pixel.x) + vec4(0u, 1u, 2u, 3u);
    let exists = across < vec4(select(0u, photo.size.x, pixel.y < photo.size.y));
    return Quad(place, vec4<f32>(across) + 0.5, f32(pixel.y) + 0.5, exists);
}

/// Returns the number of values from one channel of a band to the next.
fn plane() -> u32 {
    return TILE * photo.size.z * TILE;
}

fn load(i: u32, first: u32) {
    let slot = slots[first + i];
    batch_shapes[i] = shapes[slot];
    batch_extents[i] = extents[slot];
    batch_colours[i] = colours[slot];
}

@compute @workgroup_size(64)
fn blend(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group.y * GRID + group.x;
    if tile >= photo.size.w {
        return;
    }
    let q = quad(tile, thread, CHANNELS);
    var goes_on = q.exists;
    if thread == 0u {
        atomicStore(&ended, 0u);
    }
    workgroupBarrier();
    if !any(goes_on) {
        atomicAdd(&ended, 1u);
    }
    var red = vec4(0.0);
    var green = vec4(0.0);
    var blue = vec4(0.0);
    var first_z = vec4(0.0);
    var second_z = vec4(0.0);
    var transmittance = vec4(1.0);
    let list = lists[tile];
    for (var first = list.x; first < list.y; first += BATCH) {
        workgroupBarrier();
        if thread == 0u {
            ended_before = atomicLoad(&ended);
        }
        if workgroupUniformLoad(&ended_before) == THREADS {
            break;
        }
        let count = min(BATCH, list.y - first);
        for (var i = thread; i < count; i += THREADS) {
            load(i, first);
        }
        workgroupBarrier();
        if any(goes_on) {
            for (var i = 0u; i < count; i++) {
                let shape = batch_shapes[i];
                let extent = batch_extents[i];
                let dy = q.y - shape.y;
                let u = q.x - (shape.x + shape.z * dy);
                let level = (extent.y - extent.x * dy * dy) - shape.w * u * u;
                let hit = goes_on & (level > vec4(MIN_LEVEL));
                if !any(hit) {
                    continue;
                }
                let alpha = select(vec4(0.0), min(exp2(level), vec4(ALPHA_MAX)), hit);
                let after = transmittance - alpha * transmittance;
                goes_on = goes_on & (after > vec4(TRANSMITTANCE_MIN));
                let weight = select(vec4(0.0), alpha * transmittance, goes_on);
                let colour = batch_colours[i];
                red += weight * colour.x;
                green += weight * colour.y;
                blue += weight * colour.z;
                let deep = weight * colour.w;
                first_z += deep;
                second_z += deep * colour.w;
                transmittance = select(transmittance, after, goes_on);
                if !any(goes_on) {
                    atomicAdd(&ended, 1u);
                    break;
                }
            }
        }
    }
    for (var i = 0u; i < 4u; i++) {
        let place = q.place + i;
        image[place] = red[i];
        image[place + plane()] = green[i];
        image[place + 2u * plane()] = blue[i];
        image[place + 3u * plane()] = first_z[i];
        image[place + 4u * plane()] = second_z[i];
        image[place + 5u * plane()] = transmittance[i];
    }
}

const SUMS = 11u;
const PAIR_STRIDE = 12u;
/// Number of splats whose sums a workgroup adds at once: the maximum for 16 KiB.
const TOGETHER = 4u;
/// One more than the number of threads, so that sums are in different banks.
const PARTIAL_STRIDE = 65u;
/// Contributions of each thread to each sum.
var<workgroup> partial: array<f32, 2860>;

fn by_channel(q: Quad, channel: u32) -> vec4<f32> {
    let place = q.place + channel * plane();
    return select(vec4(0.0), vec4(by[place], by[place + 1u], by[place + 2u], by[place + 3u]), q.exists);
}

fn image_channel(place: u32, channel: u32) -> vec4<f32> {
    let at = place + channel * plane();
    return vec4(image[at], image[at + 1u], image[at + 2u], image[at + 3u]);
}

fn total(v: vec4<f32>) -> f32 {
    return (v.x + v.y) + (v.z + v.w);
}

fn keep(splat: u32, sum: u32, thread: u32, v: vec4<f32>) {
    partial[(splat * SUMS + sum) * PARTIAL_STRIDE + thread] = total(v);
}

@compute @workgroup_size(64)
fn blend_back(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group.y * GRID + group.x;
    if tile >= photo.size.w {
        return;
    }
    let q = quad(tile, thread, BY_CHANNELS);
    let of_image = quad(tile, thread, CHANNELS).place;
    let red = by_channel(q, 0u);
    let green = by_channel(q, 1u);
    let blue = by_channel(q, 2u);
    let first_z = by_channel(q, 3u);
    let second_z = by_channel(q, 4u);
    let through = by_channel(q, 5u);
    let error = by_channel(q, 6u);
    // Sum of the contributions behind the current splat: computed by subtraction from the total.
    var rest = image_channel(of_image, 0u) * red + image_channel(of_image, 1u) * green
        + image_channel(of_image, 2u) * blue + image_channel(of_image, 3u) * first_z
        + image_channel(of_image, 4u) * second_z + image_channel(of_image, 5u) * through;
    var transmittance = vec4(1.0);
    var goes_on = q.exists;
    if thread == 0u {
        atomicStore(&ended, 0u);
    }
    workgroupBarrier();
    if !any(goes_on) {
        atomicAdd(&ended, 1u);
    }
    let list = lists[tile];
    for (var first = list.x; first < list.y; first += BATCH) {
        workgroupBarrier();
        if thread == 0u {
            ended_before = atomicLoad(&ended);
        }
        let count = min(BATCH, list.y - first);
        if workgroupUniformLoad(&ended_before) == THREADS {
            // These are hidden: the place must not keep the sums of an earlier step.
            for (var i = thread; i < count * PAIR_STRIDE; i += THREADS) {
                pair_sums[first * PAIR_STRIDE + i] = 0.0;
            }
            continue;
        }
        for (var i = thread; i < count; i += THREADS) {
            load(i, first);
        }
        workgroupBarrier();
        for (var start = 0u; start < count; start += TOGETHER) {
            for (var splat = 0u; splat < min(TOGETHER, count - start); splat++) {
                let shape = batch_shapes[start + splat];
                let extent = batch_extents[start + splat];
                let colour = batch_colours[start + splat];
                let dy = q.y - shape.y;
                let u = q.x - (shape.x + shape.z * dy);
                let level = (extent.y - extent.x * dy * dy) - shape.w * u * u;
                let hit = goes_on & (level > vec4(MIN_LEVEL));
                if !any(hit) {
                    for (var sum = 0u; sum < SUMS; sum++) {
                        partial[(splat * SUMS + sum) * PARTIAL_STRIDE + thread] = 0.0;
                    }
                    continue;
                }
                let full = exp2(level);
                let alpha = select(vec4(0.0), min(full, vec4(ALPHA_MAX)), hit);
                let after = transmittance - alpha * transmittance;
                goes_on = goes_on & (after > vec4(TRANSMITTANCE_MIN));
                let weight = select(vec4(0.0), alpha * transmittance, goes_on);
                // Derivative of the loss by the weight.
                let z = colour.w;
                let worth = red * colour.x + green * colour.y + blue * colour.z
                    + (second_z * z + first_z) * z;
                rest -= weight * worth;
                let by_alpha = transmittance * worth - rest / (vec4(1.0) - alpha);
                // Where alpha is clamped to its maximum, it does not change with the level.
                let free = goes_on & (full < vec4(ALPHA_MAX));
                let g = select(vec4(0.0), by_alpha * alpha, free);
                keep(splat, 0u, thread, g);
                keep(splat, 1u, thread, g * u);
                keep(splat, 2u, thread, g * dy);
                keep(splat, 3u, thread, g * u * u);
                keep(splat, 4u, thread, g * u * dy);
                keep(splat, 5u, thread, g * dy * dy);
                keep(splat, 6u, thread, weight * red);
                keep(splat, 7u, thread, weight * green);
                keep(splat, 8u, thread, weight * blue);
                keep(splat, 9u, thread, weight * (2.0 * second_z * z + first_z));
                keep(splat, 10u, thread, weight * error);
                transmittance = select(transmittance, after, goes_on);
                if !any(goes_on) {
                    // Reached only while some pixel has not ended, so this happens once per thread.
                    atomicAdd(&ended, 1u);
                }
            }
            workgroupBarrier();
            if thread < SUMS * min(TOGETHER, count - start) {
                var sum = 0.0;
                for (var i = 0u; i < THREADS; i++) {
                    sum += partial[thread * PARTIAL_STRIDE + i];
                }
                let pair = first + start + thread / SUMS;
                pair_sums[pair * PAIR_STRIDE + thread % SUMS] = sum;
            }
            workgroupBarrier();
        }
    }
}
