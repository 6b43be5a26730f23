// Pass 2: projects the splats of visible blocks onto the image plane. See `cpu/project.rs` for the form of a
// projected Gaussian, and why it is stable.

struct Chunk {
    /// First block of the chunk.
    first_block: u32,
    /// Number of words from block to block of `geometry`.
    stride: u32,
    padding: vec2<u32>,
}

@group(0) @binding(0) var<uniform> tick: Tick;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> regions: array<u32>;
@group(0) @binding(3) var<uniform> chunk: Chunk;
// Per block: part, first word of its harmonics, coefficients per channel, splats; then 13 columns of BLOCK values:
// centre, axes times scales, log2 of the opacity.
@group(0) @binding(4) var<storage, read> geometry: array<u32>;
// Halves, two per word: per block, coefficient by coefficient, in each RGB, BLOCK of each.
@group(0) @binding(5) var<storage, read> harmonics: array<u32>;
@group(0) @binding(6) var<storage, read_write> projected: array<Projected>;
@group(0) @binding(7) var<storage, read_write> covers: array<Cover>;
// Splats per tile; then those of all images.
@group(0) @binding(8) var<storage, read_write> counts: array<atomic<u32>>;

const HEADER = 4u;
const BLUR = 0.3;
/// Half of log2(e): the factor 1/2 of sigma, for powers of two.
const HALF_LOG2_E = 0.72134752;
/// Extent^2 of the ellipse per level and variance: 2 ln 2.
const EXTENT2 = 1.3862944;
/// Maximum extent of a splat; prevents overflow of f32. [px]
const MAX_EXTENT = 1e18;
/// Maximum distance from the camera; beyond it, squares exceed f32. [m]
const MAX_DISTANCE = 1e18;

const NO_LENS = 0u;
const BROWN_CONRADY = 1u;

fn number(first: u32, column: u32, lane: u32) -> f32 {
    return bitcast<f32>(geometry[first + HEADER + column * BLOCK + lane]);
}

fn vector(first: u32, column: u32, lane: u32) -> vec3<f32> {
    return vec3(
        number(first, column, lane),
        number(first, column + 1u, lane),
        number(first, column + 2u, lane),
    );
}

/// Returns the arc tangent of a non-negative number, to the rounding of f32. That of drivers may be off by 1e-3.
fn arc_tangent(r: f32) -> f32 {
    // atan r = pi/2 - atan 1/r, and atan x = 2 atan(x / (1 + sqrt(1 + x^2))): reduces to |x| < 0.42.
    let x = select(r, 1.0 / r, r > 1.0);
    let y = x / (1.0 + sqrt(1.0 + x * x));
    let yy = y * y;
    // Series of atan; its next term is below 3e-8.
    var sum = 1.0 / 17.0;
    sum = 1.0 / 15.0 - yy * sum;
    sum = 1.0 / 13.0 - yy * sum;
    sum = 1.0 / 11.0 - yy * sum;
    sum = 1.0 / 9.0 - yy * sum;
    sum = 1.0 / 7.0 - yy * sum;
    sum = 1.0 / 5.0 - yy * sum;
    sum = 1.0 / 3.0 - yy * sum;
    let angle = 2.0 * (y - y * yy * sum);
    return select(angle, 1.5707964 - angle, r > 1.0);
}

struct Distorted {
    slope: vec2<f32>,
    /// Derivative by the slope, column by column.
    along_x: vec2<f32>,
    along_y: vec2<f32>,
}

/// Same as `vizflyt_protocol::geometry::Distortion::distort`.
fn distort(view: u32, slope: vec2<f32>) -> Distorted {
    let model = views[view].flags.x;
    let k = views[view].lens;
    let rr = dot(slope, slope);
    let x = slope.x;
    let y = slope.y;
    if model == NO_LENS {
        return Distorted(slope, vec2(1.0, 0.0), vec2(0.0, 1.0));
    }
    if model == BROWN_CONRADY {
        let k3 = views[view].more.x;
        let p1 = k.z;
        let p2 = k.w;
        let radial = 1.0 + rr * (k.x + rr * (k.y + rr * k3));
        let growth = k.x + rr * (2.0 * k.y + rr * 3.0 * k3);
        let shift = vec2(
            2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x),
            p1 * (rr + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let across = 2.0 * (x * y * growth + p1 * x + p2 * y);
        return Distorted(
            slope * radial + shift,
            vec2(radial + 2.0 * (x * x * growth + p1 * y + 3.0 * p2 * x), across),
            vec2(across, radial + 2.0 * (y * y * growth + 3.0 * p1 * y + p2 * x)),
        );
    }
    let r = sqrt(rr);
    if r < 1e-4 {
        // The omitted terms are below 1e-8 of the slope.
        return Distorted(slope, vec2(1.0, 0.0), vec2(0.0, 1.0));
    }
    let t = arc_tangent(r);
    let tt = t * t;
    let distorted = t * (1.0 + tt * (k.x + tt * (k.y + tt * (k.z + tt * k.w))));
    let bend = 1.0 + tt * (3.0 * k.x + tt * (5.0 * k.y + tt * (7.0 * k.z + tt * 9.0 * k.w)));
    let scale = distorted / r;
    let along = bend / (1.0 + rr);
    let u = slope / r;
    let d = along - scale;
    return Distorted(
        slope * scale,
        vec2(scale + d * u.x * u.x, d * u.x * u.y),
        vec2(d * u.x * u.y, scale + d * u.y * u.y),
    );
}

fn coefficient(first: u32, k: u32, lane: u32) -> vec3<f32> {
    let word = first + k * 3u * (BLOCK / 2u) + lane / 2u;
    let red = unpack2x16float(harmonics[word]);
    let green = unpack2x16float(harmonics[word + BLOCK / 2u]);
    let blue = unpack2x16float(harmonics[word + BLOCK]);
    let odd = (lane & 1u) == 1u;
    return vec3(
        select(red.x, red.y, odd),
        select(green.x, green.y, odd),
        select(blue.x, blue.y, odd),
    );
}

/// Same as `harmonics::colour`.
fn colour(first: u32, coefficients: u32, lane: u32, direction: vec3<f32>) -> vec3<f32> {
    let x = direction.x;
    let y = direction.y;
    let z = direction.z;
    var rgb = vec3(0.5) + 0.28209479 * coefficient(first, 0u, lane);
    if coefficients >= 4u {
        rgb += -0.48860251 * y * coefficient(first, 1u, lane);
        rgb += 0.48860251 * z * coefficient(first, 2u, lane);
        rgb += -0.48860251 * x * coefficient(first, 3u, lane);
    }
    if coefficients >= 9u {
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        rgb += 1.0925485 * (x * y) * coefficient(first, 4u, lane);
        rgb += -1.0925485 * (y * z) * coefficient(first, 5u, lane);
        rgb += 0.31539157 * (2.0 * zz - xx - yy) * coefficient(first, 6u, lane);
        rgb += -1.0925485 * (x * z) * coefficient(first, 7u, lane);
        rgb += 0.54627422 * (xx - yy) * coefficient(first, 8u, lane);
        if coefficients >= 16u {
            rgb += -0.59004359 * y * (3.0 * xx - yy) * coefficient(first, 9u, lane);
            rgb += 2.8906114 * x * y * z * coefficient(first, 10u, lane);
            rgb += -0.45704579 * y * (4.0 * zz - xx - yy) * coefficient(first, 11u, lane);
            rgb += 0.37317633 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(first, 12u, lane);
            rgb += -0.45704579 * x * (4.0 * zz - xx - yy) * coefficient(first, 13u, lane);
            rgb += 1.4453057 * z * (xx - yy) * coefficient(first, 14u, lane);
            rgb += -0.59004359 * x * (xx - 3.0 * yy) * coefficient(first, 15u, lane);
        }
    }
    return max(rgb, vec3(0.0));
}

/// Returns the tiles of an image that an ellipse touches.
fn cover_of(e: Ellipse, view: u32, key: u32, camera: u32) -> Cover {
    let size = views[view].size;
    let extent_y = sqrt(e.reach / e.falloff.y);
    let height = centres(e.mean.y - extent_y, e.mean.y + extent_y, f32(size.y));
    let edges = band(e, e.mean.y - extent_y, e.mean.y + extent_y);
    let width = centres(edges.x, edges.y, f32(size.x));
    if width.x >= width.y || height.x >= height.y {
        return nothing();
    }
    let first = vec2(width.x, height.x) / TILE;
    let tiles = (vec2(width.y, height.y) - 1u) / TILE + 1u - first;
    var cover = Cover(
        size.w + first.y * size.z + first.x,
        tiles.x | tiles.y << 10u | camera << 20u,
        0u,
        key,
    );
    let cell = cell_size(cover);
    for (var row = 0u; row * cell.y < tiles.y; row++) {
        let top = (first.y + row * cell.y) * TILE;
        let bottom = min((first.y + min((row + 1u) * cell.y, tiles.y)) * TILE, size.y);
        let reached = band(e, f32(top) + 0.5, f32(bottom) - 0.5);
        let pixels = centres(reached.x, reached.y, f32(size.x));
        if pixels.x < pixels.y {
            // Rounding may give a row that is wider than the whole ellipse.
            let from_column = (max(pixels.x / TILE, first.x) - first.x) / cell.x;
            let to_column = (min((pixels.y - 1u) / TILE, first.x + tiles.x - 1u) - first.x) / cell.x;
            let bits = (2u << to_column) - (1u << from_column);
            cover.cells |= bits << (row * CELL_COLUMNS);
        }
    }
    return cover;
}

/// Projects one splat into a slot; returns the tiles that it touches.
fn project_splat(view: u32, camera: u32, first: u32, lane: u32, slot: u32) -> Cover {
    if lane >= geometry[first + 3u] {
        return nothing();
    }
    // Subtracts the camera's position first: large coordinates cancel while they are exact.
    let d = vector(first, 0u, lane) - vec3(views[view].row_x.w, views[view].row_y.w, views[view].row_z.w);
    let z = dot(views[view].row_z.xyz, d);
    let farthest = max(max(abs(d.x), abs(d.y)), abs(d.z));
    if !(z > views[view].more.z && farthest < MAX_DISTANCE) {
        return nothing();
    }
    let inverse_z = 1.0 / z;
    let slope = vec2(dot(views[view].row_x.xyz, d), dot(views[view].row_y.xyz, d)) * inverse_z;
    let has_lens = views[view].flags.x != NO_LENS;
    if has_lens && !(length(slope) <= views[view].more.y) {
        return nothing();
    }
    let mean = views[view].focal.xy * distort(view, slope).slope + views[view].focal.zw;

    // Rows of J W M, M the square root of the covariance.
    var at = clamp(slope, views[view].slopes.xy, views[view].slopes.zw);
    if has_lens {
        at *= min(1.0, views[view].more.y / max(length(at), 1e-30));
    }
    let distorted = distort(view, at);
    let pinhole_x = (views[view].row_x.xyz - at.x * views[view].row_z.xyz) * inverse_z;
    let pinhole_y = (views[view].row_y.xyz - at.y * views[view].row_z.xyz) * inverse_z;
    let gx = views[view].focal.x * (distorted.along_x.x * pinhole_x + distorted.along_y.x * pinhole_y);
    let gy = views[view].focal.y * (distorted.along_x.y * pinhole_x + distorted.along_y.y * pinhole_y);
    let axis_0 = vector(first, 3u, lane);
    let axis_1 = vector(first, 6u, lane);
    let axis_2 = vector(first, 9u, lane);
    let u = vec3(dot(gx, axis_0), dot(gx, axis_1), dot(gx, axis_2));
    let v = vec3(dot(gy, axis_0), dot(gy, axis_1), dot(gy, axis_2));
    let uu = dot(u, u);
    let vv = dot(v, v);
    let a = uu + BLUR;
    let b = dot(u, v);
    let c = vv + BLUR;
    let minors = cross(u, v);
    let sharp = dot(minors, minors);
    let determinant = sharp + (BLUR * (uu + vv) + BLUR * BLUR);

    var level = number(first, 12u, lane);
    if views[view].more.w != 0.0 {
        // Dimmed by the area that the blur adds; not if the determinant exceeds f32.
        let ratio = select(1.0, sharp / determinant, determinant < 1e36);
        level += 0.5 * log2(max(ratio, 1e-30));
    }
    let reach2 = (level - MIN_LEVEL) * EXTENT2;
    let extent = sqrt(reach2 * vec2(a, c));
    // Tests whether the ellipse's box contains a pixel centre.
    let size = vec2<f32>(views[view].size.xy);
    let is_seen = reach2 >= 0.0
        && all(mean + extent > vec2(0.5))
        && all(mean - extent < size - 0.5)
        && all(extent < vec2(MAX_EXTENT));
    if !is_seen {
        return nothing();
    }
    // Above 0, so that division by it is safe if a splat covers everything evenly.
    let falloff = max(HALF_LOG2_E * vec2(c / determinant, 1.0 / c), vec2(1e-36));
    let distance = sqrt(dot(d, d));
    let rgb = colour(geometry[first + 1u], geometry[first + 2u], lane, d / distance);
    // Same as `Atmosphere::attenuate`.
    let light = views[view].light;
    let fog = views[view].fog.xyz;
    let seen = mix(fog, rgb * light.xyz, exp2(-light.w * distance));
    let tag = views[view].flags.w;
    let tip_y = b * extent.x / a;
    projected[slot] = Projected(
        vec4(mean, b / c, falloff.x),
        vec4(falloff.y, level, bitcast<f32>(tag), tip_y),
        vec4(seen, z),
    );
    let ellipse = Ellipse(mean, b / c, falloff, level - MIN_LEVEL, tip_y);
    return cover_of(ellipse, view, bitcast<u32>(z), camera);
}

/// Region of a block that its camera sees; otherwise NO_REGION.
var<workgroup> own_region: u32;

const NO_REGION = 0xffffffffu;

@compute @workgroup_size(256)
fn project(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let camera = group.y;
    if lane == 0u {
        let index = camera * tick.blocks + chunk.first_block + group.x;
        let rank = regions[index];
        let region = regions[tick.cameras * tick.blocks + index / 256u] + rank - 1u;
        own_region = select(NO_REGION, region, rank != 0u && region < tick.regions);
    }
    let region = workgroupUniformLoad(&own_region);
    if region == NO_REGION {
        return;
    }
    let first = group.x * chunk.stride;
    let slot = region * BLOCK + lane;
    let view = camera * tick.parts + geometry[first];
    let cover = project_splat(view, camera, first, lane, slot);
    covers[slot] = cover;

    let tiles_x = views[camera * tick.parts].size.z;
    for (var i = 0u; i < tiles_alone(cover); i++) {
        let tile = tile_of(cover, i, tiles_x);
        if tile != NO_TILE {
            atomicAdd(&counts[tile], 1u);
        }
    }
    let large_tiles = share(lane, cover);
    for (var i = lane; i < large_tiles; i += 256u) {
        let whose = owner(i);
        let tile = tile_of(large[whose], i - starts[whose], tiles_x);
        if tile != NO_TILE {
            atomicAdd(&counts[tile], 1u);
        }
    }
    let visible = scan(lane, select(0u, 1u, cover.size != 0u));
    if lane == 255u {
        atomicAdd(&counts[tick.tiles], visible + select(0u, 1u, cover.size != 0u));
    }
}
