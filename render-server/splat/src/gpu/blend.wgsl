// Pass 5: the pixels of each tile, from near to far. One workgroup per tile, one thread per pixel;
// lists are taken in batches through workgroup memory, until every pixel of the tile has ended.

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

// 12 of the 16 KiB that every device has.
var<workgroup> batch_shapes: array<vec4<f32>, 256>;
var<workgroup> batch_extents: array<vec4<f32>, 256>;
var<workgroup> batch_colours: array<vec4<f32>, 256>;
var<workgroup> ended: atomic<u32>;
var<workgroup> ended_before: u32;

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
    let pixel = origin + vec2(thread % TILE, thread / TILE);
    let at = vec2<f32>(pixel) + 0.5;
    // Pixels beyond the image's edge have ended before they start.
    let exists = all(pixel < size.xy);
    var goes_on = exists;
    if thread == 0u {
        atomicStore(&ended, 0u);
    }
    workgroupBarrier();
    if !exists {
        atomicAdd(&ended, 1u);
    }

    var rgb = vec3(0.0);
    var weighted_z = 0.0;
    var median = 0.0;
    var id = 0u;
    var transmittance = 1.0;
    let list = lists[tile];
    for (var first = list.x; first < list.y; first += 256u) {
        workgroupBarrier();
        if thread == 0u {
            ended_before = atomicLoad(&ended);
        }
        if workgroupUniformLoad(&ended_before) == 256u {
            break;
        }
        if first + thread < list.y {
            let slot = slots[first + thread];
            batch_shapes[thread] = shapes[slot];
            batch_extents[thread] = extents[slot];
            batch_colours[thread] = colours[slot];
        }
        workgroupBarrier();
        if goes_on {
            let count = min(256u, list.y - first);
            for (var i = 0u; i < count; i++) {
                let shape = batch_shapes[i];
                let extent = batch_extents[i];
                let d = at - shape.xy;
                let dx = d.x - shape.z * d.y;
                let level = extent.y - extent.x * d.y * d.y - shape.w * dx * dx;
                if level > MIN_LEVEL {
                    let alpha = min(exp2(level), ALPHA_MAX);
                    let after = transmittance - alpha * transmittance;
                    if after <= TRANSMITTANCE_MIN {
                        goes_on = false;
                        atomicAdd(&ended, 1u);
                        break;
                    }
                    let colour = batch_colours[i];
                    let weight = alpha * transmittance;
                    rgb += weight * colour.xyz;
                    weighted_z += weight * colour.w;
                    if transmittance > 0.5 && after <= 0.5 {
                        median = colour.w;
                        id = bitcast<u32>(extent.z) & 0xffffu;
                    }
                    transmittance = after;
                }
            }
        }
    }
    if !exists {
        return;
    }
    let alpha = 1.0 - transmittance;
    let background = views[camera * tick.parts].background.xyz;
    let bound = vec3(COLOUR_MAX);
    let shown = clamp(rgb + transmittance * background, -bound, bound);
    var expected = 0.0;
    if alpha > 0.0 {
        expected = weighted_z / alpha;
    }
    let red_green = pack2x16float(shown.xy);
    let blue = pack2x16float(vec2(shown.z, 0.0)) & 0xffffu;
    let opacity = u32(alpha * 65535.0 + 0.5) << 16u;
    let place = views[camera * tick.parts].flags.z + pixel.y * size.x + pixel.x;
    pixels[place] = vec4(red_green, blue | opacity, bitcast<u32>(expected), bitcast<u32>(median));
    if tick.has_ids != 0u {
        ids[place] = id;
    }
}
