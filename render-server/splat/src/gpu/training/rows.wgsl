// Row of parameters, and the values that the projection of rows and its derivative share. Same as `Projection` of
// `project.rs` in `vizflyt-twin`, where its form is explained.

// Per row: mean, logarithms of the scales, rotation xyzw, logit of the opacity, harmonics.
@group(0) @binding(1) var<storage, read> rows: array<f32>;

const LOG_SCALE = 3u;
const ROTATION = 6u;
const LOGIT = 10u;
const SH = 11u;

const BLUR = 0.3;
/// Half of log2(e): the factor 1/2 of sigma, for powers of two.
const HALF_LOG2_E = 0.72134752;
const LOG2_E = 1.442695;
const LN_2 = 0.6931472;
const MAX_SCALE = 1e6;
/// Greater than the logarithm of MAX_SCALE; `exp` is still finite.
const MAX_LOG_SCALE = 14.0;
/// Minimum squared share of its opacity that a splat much smaller than a pixel keeps (anti-aliased).
const MIN_COMPENSATION2 = 1e-8;

fn number(row: u32, column: u32) -> f32 {
    return rows[row * photo.rows.y + column];
}

fn vector(row: u32, column: u32) -> vec3<f32> {
    return vec3(number(row, column), number(row, column + 1u), number(row, column + 2u));
}

fn quaternion(row: u32) -> vec4<f32> {
    return vec4(vector(row, ROTATION), number(row, ROTATION + 3u));
}

struct Projection {
    /// Whether the row is in front of the camera; otherwise, the other fields are undefined.
    is_ahead: bool,
    /// Position relative to the camera, in the world's axes; z along the camera's axis.
    d: vec3<f32>,
    z: f32,
    /// Slopes, and the slopes at which the projection is linearised.
    slope: vec2<f32>,
    at: vec2<f32>,
    /// Rows of J W.
    gx: vec3<f32>,
    gy: vec3<f32>,
    rotation: mat3x3<f32>,
    scales: vec3<f32>,
    /// Rows of J W R S.
    u: vec3<f32>,
    v: vec3<f32>,
    /// Covariance on the image plane, without the blur.
    uu: f32,
    b: f32,
    vv: f32,
    /// Determinants of the covariance without and with the blur.
    bare: f32,
    determinant: f32,
}

fn projection(row: u32) -> Projection {
    var p: Projection;
    p.d = vector(row, 0u) - vec3(photo.row_x.w, photo.row_y.w, photo.row_z.w);
    p.z = dot(photo.row_z.xyz, p.d);
    p.is_ahead = p.z > photo.near.x;
    p.slope = vec2(dot(photo.row_x.xyz, p.d), dot(photo.row_y.xyz, p.d)) / p.z;
    p.at = min(max(p.slope, photo.slopes.xy), photo.slopes.zw);
    p.gx = (photo.row_x.xyz - photo.row_z.xyz * p.at.x) * (photo.focal.x / p.z);
    p.gy = (photo.row_y.xyz - photo.row_z.xyz * p.at.y) * (photo.focal.y / p.z);
    let turn = quaternion(row);
    let q = turn / sqrt(dot(turn, turn));
    p.rotation = mat3x3(
        1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y + q.w * q.z), 2.0 * (q.x * q.z - q.w * q.y),
        2.0 * (q.x * q.y - q.w * q.z), 1.0 - 2.0 * (q.x * q.x + q.z * q.z), 2.0 * (q.y * q.z + q.w * q.x),
        2.0 * (q.x * q.z + q.w * q.y), 2.0 * (q.y * q.z - q.w * q.x), 1.0 - 2.0 * (q.x * q.x + q.y * q.y),
    );
    let logs = min(vector(row, LOG_SCALE), vec3(MAX_LOG_SCALE));
    p.scales = min(exp(logs), vec3(MAX_SCALE));
    p.u = p.scales * (p.gx * p.rotation);
    p.v = p.scales * (p.gy * p.rotation);
    p.uu = dot(p.u, p.u);
    p.b = dot(p.u, p.v);
    p.vv = dot(p.v, p.v);
    let minors = cross(p.u, p.v);
    p.bare = dot(minors, minors);
    p.determinant = p.bare + (BLUR * (p.uu + p.vv) + BLUR * BLUR);
    return p;
}

fn harmonic(row: u32, k: u32) -> vec3<f32> {
    return vector(row, SH + 3u * k);
}

/// Returns the colour along a unit direction, before clamping to 0.
fn colour(row: u32, direction: vec3<f32>) -> vec3<f32> {
    let degree = photo.rows.z;
    let x = direction.x;
    let y = direction.y;
    let z = direction.z;
    var rgb = vec3(0.5) + 0.2820948 * harmonic(row, 0u);
    if degree >= 1u {
        rgb += -0.48860251 * y * harmonic(row, 1u);
        rgb += 0.48860251 * z * harmonic(row, 2u);
        rgb += -0.48860251 * x * harmonic(row, 3u);
    }
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    if degree >= 2u {
        rgb += 1.0925485 * (x * y) * harmonic(row, 4u);
        rgb += -1.0925485 * (y * z) * harmonic(row, 5u);
        rgb += 0.31539157 * (2.0 * zz - xx - yy) * harmonic(row, 6u);
        rgb += -1.0925485 * (x * z) * harmonic(row, 7u);
        rgb += 0.54627422 * (xx - yy) * harmonic(row, 8u);
    }
    if degree >= 3u {
        rgb += -0.59004359 * y * (3.0 * xx - yy) * harmonic(row, 9u);
        rgb += 2.8906114 * x * y * z * harmonic(row, 10u);
        rgb += -0.45704579 * y * (4.0 * zz - xx - yy) * harmonic(row, 11u);
        rgb += 0.37317633 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * harmonic(row, 12u);
        rgb += -0.45704579 * x * (4.0 * zz - xx - yy) * harmonic(row, 13u);
        rgb += 1.4453057 * z * (xx - yy) * harmonic(row, 14u);
        rgb += -0.59004359 * x * (xx - 3.0 * yy) * harmonic(row, 15u);
    }
    return rgb;
}
