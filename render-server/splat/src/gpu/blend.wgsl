// Pass 5: the pixels of each tile, from near to far. One workgroup per tile; each thread has four
// pixels of a row, so that what it fetches of a splat serves four times. Lists are taken in batches
// through workgroup memory, until every pixel of the tile has ended.

@group(0) @binding(0) var<uniform> tick: Tick;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> shapes: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> extents: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> colours: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> slots: array<u32>;
@group(0) @binding(6) var<storage, read> lists: array<vec2<u32>>;
// Red and green as halves; blue as half, alpha in 65535ths; expected depth; median depth.
@group(0) @binding(7) var<storage, read_write> pixels: array<vec4<u32>>;
@group(0) @binding(8) var<storage, read_write> ids: array<u32>;

const ALPHA_MAX = 0.99;
const TRANSMITTANCE_MIN = 1e-4;
/// f16 ends at 65504.
const COLOUR_MAX = 65000.0;
/// Workgroups along x at most.
const GRID = 32768u;

const NO_PAIR = 0xffffffffu;
const THREADS = 64u;
const BATCH = 128u;

var<workgroup> batch_shapes: array<vec4<f32>, BATCH>;
var<workgroup> batch_extents: array<vec4<f32>, BATCH>;
var<workgroup> batch_colours: array<vec4<f32>, BATCH>;
/// Threads all of whose pixels have ended.
var<workgroup> ended: atomic<u32>;
var<workgroup> ended_before: u32;

@compute @workgroup_size(64)
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
    // The first of four.
    let pixel = origin + vec2(thread % 4u * 4u, thread / 4u);
    let at_x = vec4<f32>(vec4(pixel.x) + vec4(0u, 1u, 2u, 3u)) + 0.5;
    let at_y = f32(pixel.y) + 0.5;
    // Pixels beyond the image's edge have ended before they start.
    let exists = vec4(pixel.x) + vec4(0u, 1u, 2u, 3u) < vec4(select(0u, size.x, pixel.y < size.y));
    var goes_on = exists;
    if thread == 0u {
        atomicStore(&ended, 0u);
    }
    workgroupBarrier();
    if !any(exists) {
        atomicAdd(&ended, 1u);
    }

    var red = vec4(0.0);
    var green = vec4(0.0);
    var blue = vec4(0.0);
    var weighted_z = vec4(0.0);
    // The pair at which transmittance fell to one half; NO_PAIR where it did not.
    var median = vec4(NO_PAIR);
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
        for (var i = thread; i < min(BATCH, list.y - first); i += THREADS) {
            let slot = slots[first + i];
            batch_shapes[i] = shapes[slot];
            batch_extents[i] = extents[slot];
            batch_colours[i] = colours[slot];
        }
        workgroupBarrier();
        if any(goes_on) {
            let count = min(BATCH, list.y - first);
            for (var i = 0u; i < count; i++) {
                let shape = batch_shapes[i];
                let extent = batch_extents[i];
                let dy = at_y - shape.y;
                let dx = at_x - (shape.x + shape.z * dy);
                let level = (extent.y - extent.x * dy * dy) - shape.w * dx * dx;
                let hit = goes_on & (level > vec4(MIN_LEVEL));
                if !any(hit) {
                    continue;
                }
                let colour = batch_colours[i];
                let alpha = select(vec4(0.0), min(exp2(level), vec4(ALPHA_MAX)), hit);
                let after = transmittance - alpha * transmittance;
                // A pixel ends before the splat that would bring it here.
                goes_on = goes_on & (after > vec4(TRANSMITTANCE_MIN));
                let weight = select(vec4(0.0), alpha * transmittance, goes_on);
                red += weight * colour.x;
                green += weight * colour.y;
                blue += weight * colour.z;
                weighted_z += weight * colour.w;
                let halves = goes_on & (transmittance > vec4(0.5)) & (after <= vec4(0.5));
                median = select(median, vec4(first + i), halves);
                transmittance = select(transmittance, after, goes_on);
                if !any(goes_on) {
                    atomicAdd(&ended, 1u);
                    break;
                }
            }
        }
    }

    let background = views[camera * tick.parts].background;
    let place = views[camera * tick.parts].flags.z + pixel.y * size.x + pixel.x;
    for (var i = 0u; i < 4u; i++) {
        if exists[i] {
            let alpha = 1.0 - transmittance[i];
            let rgb = vec3(red[i], green[i], blue[i]) + transmittance[i] * background.xyz;
            let shown = clamp(rgb, vec3(-COLOUR_MAX), vec3(COLOUR_MAX));
            var expected = 0.0;
            if alpha > 0.0 {
                expected = weighted_z[i] / alpha;
            }
            var median_z = 0.0;
            var id = 0u;
            if median[i] != NO_PAIR {
                let slot = slots[median[i]];
                median_z = colours[slot].w;
                id = bitcast<u32>(extents[slot].z) & 0xffffu;
            }
            let red_green = pack2x16float(shown.xy);
            let blue_half = pack2x16float(vec2(shown.z, 0.0)) & 0xffffu;
            let opacity = u32(alpha * 65535.0 + 0.5) << 16u;
            let depths = vec2(bitcast<u32>(expected), bitcast<u32>(median_z));
            pixels[place + i] = vec4(red_green, blue_half | opacity, depths);
            if tick.has_ids != 0u {
                ids[place + i] = id;
            }
        }
    }
}
