// Pass 1 of training: projects rows onto the image plane, in the form of `bin.wgsl` and `blend.wgsl`. The slot of a
// row is its index.

// Mean x, y [px], shear, falloff along x [1/px^2].
@group(0) @binding(2) var<storage, read_write> shapes: array<vec4<f32>>;
// Falloff along y, level, 0 (the only camera), dy of the ellipse's rightmost point.
@group(0) @binding(3) var<storage, read_write> extents: array<vec4<f32>>;
// Red, green, blue, camera z.
@group(0) @binding(4) var<storage, read_write> colours: array<vec4<f32>>;
// Camera z as bits; EMPTY if the row is not visible in the photo.
@group(0) @binding(5) var<storage, read_write> keys: array<u32>;

/// Extent^2 of the ellipse per level and variance: 2 ln 2.
const EXTENT2 = 1.3862944;
/// Maximum extent of a splat; prevents overflow of f32. [px]
const MAX_EXTENT = 1e18;
/// -log2 of the minimum opacity; keeps `exp` finite.
const MAX_LOGIT = 80.0;

fn project_row(row: u32) -> u32 {
    let p = projection(row);
    if !p.is_ahead {
        return EMPTY;
    }
    let a = p.uu + BLUR;
    let c = p.vv + BLUR;
    var level = -log2(1.0 + exp(min(-number(row, LOGIT), MAX_LOGIT)));
    if photo.rows.w != 0u {
        level += 0.5 * log2(max(p.bare / p.determinant, MIN_COMPENSATION2));
    }
    let reach2 = (level - MIN_LEVEL) * EXTENT2;
    let extent = sqrt(reach2 * vec2(a, c));
    let mean = photo.focal.xy * p.slope + photo.focal.zw;
    // Written so that NaN is not visible: the box contains a pixel's centre.
    let is_seen = reach2 >= 0.0
        && all(mean + extent > vec2(0.5))
        && all(mean - extent < vec2<f32>(photo.size.xy) - 0.5)
        && all(extent < vec2(MAX_EXTENT));
    if !is_seen {
        return EMPTY;
    }
    let falloff = HALF_LOG2_E * vec2(c / p.determinant, 1.0 / c);
    let rgb = max(colour(row, p.d / sqrt(dot(p.d, p.d))), vec3(0.0));
    shapes[row] = vec4(mean, p.b / c, falloff.x);
    extents[row] = vec4(falloff.y, level, 0.0, p.b * extent.x / a);
    colours[row] = vec4(rgb, p.z);
    return bitcast<u32>(p.z);
}

@compute @workgroup_size(256)
fn project(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = id.x;
    if row < photo.rows.x {
        keys[row] = project_row(row);
    }
}
