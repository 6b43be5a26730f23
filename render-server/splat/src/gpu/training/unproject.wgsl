// Pass 5 of training: adds the sums of a splat in the order of its tiles, and propagates them to the parameters of
// its row. Same as `Flat::backward` of `project.rs` in `vizflyt-twin`, line by line.

// Slots, from near to far.
@group(0) @binding(2) var<storage, read> order: array<u32>;
// Number of pairs per splat in that order; then the first pair of each workgroup.
@group(0) @binding(3) var<storage, read> counts: array<u32>;
@group(0) @binding(4) var<storage, read> places: array<u32>;
@group(0) @binding(5) var<storage, read> pair_sums: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> sizes: array<u32>;
// Per visible splat: by mean, logarithms of the scales, rotation, logit; error; by colour; index of its row.
@group(0) @binding(7) var<storage, read_write> gradients: array<vec4<f32>>;

const NOWHERE = 0xffffffffu;

/// Returns the derivative by a quaternion of any length, from that by the columns of its rotation.
fn by_quaternion(turn: vec4<f32>, m: mat3x3<f32>) -> vec4<f32> {
    let size = sqrt(dot(turn, turn));
    let q = turn / size;
    let across = vec4(
        q.y * (m[1].x + m[0].y) + q.z * (m[2].x + m[0].z) - 2.0 * q.x * (m[1].y + m[2].z) + q.w * (m[1].z - m[2].y),
        q.x * (m[1].x + m[0].y) + q.z * (m[2].y + m[1].z) - 2.0 * q.y * (m[0].x + m[2].z) + q.w * (m[2].x - m[0].z),
        q.x * (m[2].x + m[0].z) + q.y * (m[2].y + m[1].z) - 2.0 * q.z * (m[0].x + m[1].y) + q.w * (m[0].y - m[1].x),
        q.x * (m[1].z - m[2].y) + q.y * (m[2].x - m[0].z) + q.z * (m[0].y - m[1].x),
    ) * 2.0;
    // Only the component perpendicular to q, because its length does not change the rotation.
    return (across - dot(across, q) * q) / size;
}

/// Returns the derivative of the colour, weighted by `by_rgb`, by the direction.
fn by_direction(row: u32, direction: vec3<f32>, by_rgb: vec3<f32>) -> vec3<f32> {
    let degree = photo.rows.z;
    let x = direction.x;
    let y = direction.y;
    let z = direction.z;
    var sum = 0.48860251 * vec3(
        -dot(harmonic(row, 3u), by_rgb),
        -dot(harmonic(row, 1u), by_rgb),
        dot(harmonic(row, 2u), by_rgb),
    );
    if degree >= 2u {
        sum += 1.0925485 * dot(harmonic(row, 4u), by_rgb) * vec3(y, x, 0.0);
        sum += -1.0925485 * dot(harmonic(row, 5u), by_rgb) * vec3(0.0, z, y);
        sum += 0.31539157 * dot(harmonic(row, 6u), by_rgb) * vec3(-2.0 * x, -2.0 * y, 4.0 * z);
        sum += -1.0925485 * dot(harmonic(row, 7u), by_rgb) * vec3(z, 0.0, x);
        sum += 0.54627422 * dot(harmonic(row, 8u), by_rgb) * vec3(2.0 * x, -2.0 * y, 0.0);
    }
    if degree >= 3u {
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        sum += -0.59004359 * dot(harmonic(row, 9u), by_rgb) * vec3(6.0 * x * y, 3.0 * (xx - yy), 0.0);
        sum += 2.8906114 * dot(harmonic(row, 10u), by_rgb) * vec3(y * z, x * z, x * y);
        sum += -0.45704579 * dot(harmonic(row, 11u), by_rgb)
            * vec3(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z);
        sum += 0.37317633 * dot(harmonic(row, 12u), by_rgb)
            * vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * (xx + yy));
        sum += -0.45704579 * dot(harmonic(row, 13u), by_rgb)
            * vec3(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z);
        sum += 1.4453057 * dot(harmonic(row, 14u), by_rgb) * vec3(2.0 * x * z, -2.0 * y * z, xx - yy);
        sum += -0.59004359 * dot(harmonic(row, 15u), by_rgb) * vec3(3.0 * (xx - yy), -6.0 * x * y, 0.0);
    }
    return sum;
}

@compute @workgroup_size(256)
fn unproject(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let visible = sizes[VISIBLE];
    let i = group.x * 256u + thread;
    var count = 0u;
    if i < visible {
        count = counts[i];
    }
    let before = scan(thread, count);
    if i >= visible {
        return;
    }
    let first = counts[visible + group.x] + before;
    // G, G u, G dy, G u^2; G u dy, G dy^2, red, green; blue, z, error.
    var s0 = vec4(0.0);
    var s1 = vec4(0.0);
    var s2 = vec4(0.0);
    for (var pair = first; pair < first + count; pair++) {
        let place = places[pair];
        if place != NOWHERE {
            s0 += pair_sums[3u * place];
            s1 += pair_sums[3u * place + 1u];
            s2 += pair_sums[3u * place + 2u];
        }
    }

    let row = order[i];
    let p = projection(row);
    let a = p.uu + BLUR;
    let c = p.vv + BLUR;
    let det = p.determinant;

    // Projected splat: mean, shear, falloffs, level.
    let shear = p.b / c;
    let fall = HALF_LOG2_E * vec2(c / det, 1.0 / c);
    let by_x = 2.0 * fall.x * s0.y * LN_2;
    let by_mean = vec2(by_x, 2.0 * fall.y * s0.z * LN_2 - shear * by_x);
    let by_shear = 2.0 * fall.x * s1.x * LN_2;
    let by_fall = vec2(-s0.w, -s1.y) * LN_2;
    let by_level = s0.x * LN_2;
    let by_colour = vec3(s1.z, s1.w, s2.x);

    // Opacity: level = log2 sigmoid(logit).
    let opacity = 1.0 / (1.0 + exp(min(-number(row, LOGIT), 80.0)));
    let by_logit = by_level * LOG2_E * (1.0 - opacity);

    // The ellipse: shear = b / c, falloff = h (c / det, 1 / c), det = a c - b^2.
    let across = HALF_LOG2_E / det * by_fall.x;
    let c_det = c / det;
    let b_det = p.b / det;
    var by_a = -across * c * c_det;
    var by_b = by_shear / c + 2.0 * across * c * b_det;
    var by_c = -across * p.b * b_det - (p.b / c * by_shear + HALF_LOG2_E / c * by_fall.y) / c;
    if photo.rows.w != 0u && p.bare > MIN_COMPENSATION2 * det {
        // level += log2(bare / det) / 2.
        let half = by_level * HALF_LOG2_E;
        by_a += half * (p.vv / p.bare - c_det);
        by_b += half * -2.0 * (p.b / p.bare - b_det);
        by_c += half * (p.uu / p.bare - a / det);
    }
    let by_u = p.u * (2.0 * by_a) + p.v * by_b;
    let by_v = p.v * (2.0 * by_c) + p.u * by_b;

    // u = S R^T g: scales, axes, rows of J W.
    let by_log_scale = select(vec3(0.0), p.u * by_u + p.v * by_v, p.scales < vec3(MAX_SCALE));
    let su = p.scales * by_u;
    let sv = p.scales * by_v;
    let by_gx = p.rotation * su;
    let by_gy = p.rotation * sv;
    let axes = mat3x3(p.gx * su.x + p.gy * sv.x, p.gx * su.y + p.gy * sv.y, p.gx * su.z + p.gy * sv.z);
    let by_turn = by_quaternion(quaternion(row), axes);

    // g = focal / z (row - at forward); mean = focal slope + centre.
    var by_z = s2.y - (dot(p.gx, by_gx) + dot(p.gy, by_gy)) / p.z;
    var by_slope = photo.focal.xy * by_mean;
    let forward = vec2(dot(photo.row_z.xyz, by_gx), dot(photo.row_z.xyz, by_gy));
    by_slope -= select(vec2(0.0), photo.focal.xy / p.z * forward, p.at == p.slope);
    by_z -= dot(by_slope, p.slope) / p.z;
    var by_d = (photo.row_x.xyz * by_slope.x + photo.row_y.xyz * by_slope.y) / p.z + photo.row_z.xyz * by_z;

    // Colour, where it is not clamped to 0, and its viewing direction.
    let distance = sqrt(dot(p.d, p.d));
    let direction = p.d / distance;
    let by_rgb = select(vec3(0.0), by_colour, colour(row, direction) > vec3(0.0));
    if photo.rows.z > 0u {
        let turned = by_direction(row, direction, by_rgb);
        by_d += (turned - direction * dot(direction, turned)) / distance;
    }
    gradients[4u * i] = vec4(by_d, by_log_scale.x);
    gradients[4u * i + 1u] = vec4(by_log_scale.yz, by_turn.xy);
    gradients[4u * i + 2u] = vec4(by_turn.zw, by_logit, s2.z);
    gradients[4u * i + 3u] = vec4(by_rgb, f32(row));
}
