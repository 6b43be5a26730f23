// Pass 5: blends the pixels of each tile from near to far. One workgroup per tile, one thread per pixel. Lists are
// processed in batches through workgroup memory, until every pixel of the tile has ended. The thread that fetches a
// splat also finds which of the tile's eight patches of 8x4 pixels it reaches: the threads of a patch, which are
// neighbours, process only the splats of their patch.

@group(0) @binding(0) var<uniform> tick: Tick;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> projected: array<Projected>;
// Depth as bits, slot.
@group(0) @binding(3) var<storage, read> pairs: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read> firsts: array<u32>;
@group(0) @binding(5) var<storage, read> ends: array<u32>;
// Red and green as halves; blue as half, alpha in 65535ths; expected depth; median depth.
@group(1) @binding(0) var<storage, read_write> pixels: array<vec4<u32>>;
@group(1) @binding(1) var<storage, read_write> ids: array<u32>;

const ALPHA_MAX = 0.99;
const TRANSMITTANCE_MIN = 1e-4;
/// The maximum of f16 is 65504.
const COLOUR_MAX = 65000.0;
/// Maximum number of workgroups along x.
const GRID = 32768u;

const NO_PAIR = 0xffffffffu;
const THREADS = 256u;
const BATCH = 256u;
/// Threads per patch; columns and rows of a patch; patches across a tile; patches per tile.
const PATCH = 32u;
const PATCH_SIZE = vec2(8u, 4u);
const ACROSS = 2u;
const PATCHES = 8u;
/// Maximum rounding error of an ellipse's edge. [px]
const SLACK = 0.01;

var<workgroup> batch: array<Projected, BATCH>;
/// Bit b of word w of patch p is set if splat 32 w + b of the batch reaches it. Stored patch by patch.
var<workgroup> reached: array<atomic<u32>, 64>;
/// Number of threads whose pixel has ended.
var<workgroup> ended: atomic<u32>;
var<workgroup> ended_before: u32;
var<workgroup> own_list: vec2<u32>;

/// Stores which patches of a tile a splat of the batch reaches.
fn note_patches(i: u32, splat: Projected, origin: vec2<f32>) {
    let extent = splat.extent;
    let reach = extent.y - MIN_LEVEL;
    let e = Ellipse(splat.shape.xy, splat.shape.z, vec2(splat.shape.w, extent.x), reach, extent.w);
    let extent_y = sqrt(reach / e.falloff.y) + SLACK;
    for (var row = 0u; row < PATCHES / ACROSS; row++) {
        let top = origin.y + f32(row * PATCH_SIZE.y) + 0.5;
        let bottom = top + f32(PATCH_SIZE.y - 1u);
        if e.mean.y + extent_y < top || e.mean.y - extent_y > bottom {
            continue;
        }
        let edges = band(e, top, bottom) + vec2(-SLACK, SLACK);
        for (var column = 0u; column < ACROSS; column++) {
            let left = origin.x + f32(column * PATCH_SIZE.x) + 0.5;
            let right = left + f32(PATCH_SIZE.x - 1u);
            if edges.x <= right && edges.y >= left {
                let patch_of = row * ACROSS + column;
                atomicOr(&reached[patch_of * (BATCH / 32u) + i / 32u], 1u << (i % 32u));
            }
        }
    }
}

@compute @workgroup_size(256)
fn blend(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group.y * GRID + group.x;
    if tile >= tick.tiles {
        return;
    }
    var camera = 0u;
    while camera + 1u < tick.cameras && views[(camera + 1u) * tick.parts].size.w <= tile {
        camera++;
    }
    let size = views[camera * tick.parts].size;
    let origin = vec2((tile - size.w) % size.z, (tile - size.w) / size.z) * TILE;
    let own_patch = thread / PATCH;
    let pixel = origin + vec2(own_patch % ACROSS, own_patch / ACROSS) * PATCH_SIZE
        + vec2(thread % PATCH_SIZE.x, thread % PATCH / PATCH_SIZE.x);
    let at = vec2<f32>(pixel) + 0.5;
    // Pixels beyond the image's edge start as ended.
    let exists = all(pixel < size.xy);
    var goes_on = exists;
    if thread == 0u {
        atomicStore(&ended, 0u);
        own_list = vec2(firsts[tile], ends[tile]);
    }
    let list = workgroupUniformLoad(&own_list);
    if !exists {
        atomicAdd(&ended, 1u);
    }

    var seen = vec4(0.0);
    // Pair at which transmittance fell to one half; NO_PAIR if it did not.
    var median = NO_PAIR;
    var transmittance = 1.0;
    // The next splat is fetched while the current batch is processed.
    var fetched: Projected;
    if list.x + thread < list.y {
        fetched = projected[pairs[list.x + thread].y];
    }
    for (var first = list.x; first < list.y; first += BATCH) {
        // After this barrier, the last batch is no longer read.
        workgroupBarrier();
        if thread == 0u {
            ended_before = atomicLoad(&ended);
        }
        if thread < 64u {
            atomicStore(&reached[thread], 0u);
        }
        if workgroupUniformLoad(&ended_before) == THREADS {
            break;
        }
        if first + thread < list.y {
            batch[thread] = fetched;
            note_patches(thread, fetched, vec2<f32>(origin));
        }
        if first + BATCH + thread < list.y {
            fetched = projected[pairs[first + BATCH + thread].y];
        }
        workgroupBarrier();
        for (var word = 0u; word < BATCH / 32u && goes_on; word++) {
            var left = atomicLoad(&reached[own_patch * (BATCH / 32u) + word]);
            if left == 0u {
                continue;
            }
            var i = word * 32u + firstTrailingBit(left);
            var shape = batch[i].shape;
            var extent = batch[i].extent;
            loop {
                // The values of the next splat are loaded while this one is blended.
                left &= left - 1u;
                let next = select(i, word * 32u + firstTrailingBit(left), left != 0u);
                let next_shape = batch[next].shape;
                let next_extent = batch[next].extent;
                let dy = at.y - shape.y;
                let dx = at.x - (shape.x + shape.z * dy);
                let level = (extent.y - extent.x * dy * dy) - shape.w * dx * dx;
                if level > MIN_LEVEL {
                    let alpha = min(exp2(level), ALPHA_MAX);
                    let after = transmittance - alpha * transmittance;
                    // A pixel ends before the splat that would reduce its transmittance to this value.
                    if after <= TRANSMITTANCE_MIN {
                        goes_on = false;
                        atomicAdd(&ended, 1u);
                        break;
                    }
                    seen += alpha * transmittance * batch[i].colour;
                    if transmittance > 0.5 && after <= 0.5 {
                        median = first + i;
                    }
                    transmittance = after;
                }
                if left == 0u {
                    break;
                }
                i = next;
                shape = next_shape;
                extent = next_extent;
            }
        }
    }

    if exists {
        let alpha = 1.0 - transmittance;
        let rgb = seen.xyz + transmittance * views[camera * tick.parts].background.xyz;
        let shown = clamp(rgb, vec3(-COLOUR_MAX), vec3(COLOUR_MAX));
        var expected = 0.0;
        if alpha > 0.0 {
            expected = seen.w / alpha;
        }
        var median_z = 0.0;
        var id = 0u;
        if median != NO_PAIR {
            let slot = pairs[median].y;
            median_z = projected[slot].colour.w;
            id = bitcast<u32>(projected[slot].extent.z);
        }
        let red_green = pack2x16float(shown.xy);
        let blue_half = pack2x16float(vec2(shown.z, 0.0)) & 0xffffu;
        let opacity = u32(alpha * 65535.0 + 0.5) << 16u;
        let place = views[camera * tick.parts].flags.z + pixel.y * size.x + pixel.x;
        let depths = vec2(bitcast<u32>(expected), bitcast<u32>(median_z));
        pixels[place] = vec4(red_green, blue_half | opacity, depths);
        if tick.has_ids != 0u {
            ids[place] = id;
        }
    }
}
