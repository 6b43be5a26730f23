//! Real spherical harmonics to degree 3: colour by direction of view, in plain f64.
//!
//! Constants and signs as in the 3DGS trainers (from Sloan, "Efficient Spherical Harmonic
//! Evaluation", JCGT 2013, with the Condon-Shortley phase).

/// `1 / (2 sqrt(pi))`.
pub const C0: f64 = 0.28209479177387814;
/// `sqrt(3 / (4 pi))`.
pub const C1: f64 = 0.4886025119029199;
/// Degree 2.
pub const C2: [f64; 5] = [
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
];
/// Degree 3.
pub const C3: [f64; 7] = [
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
];

/// Returns the linear RGB of harmonics (coefficient by coefficient, RGB within) seen along a unit
/// direction from the camera to the splat; not below 0.
pub fn colour(sh: &[f32], direction: [f64; 3]) -> [f64; 3] {
    let basis = basis(direction);
    let mut rgb = [0.5; 3];
    for (weights, value) in sh.chunks_exact(3).zip(basis) {
        for (sum, &weight) in rgb.iter_mut().zip(weights) {
            *sum += f64::from(weight) * value;
        }
    }
    rgb.map(|v| v.max(0.0))
}

/// Returns the 16 basis functions for a unit direction.
pub fn basis([x, y, z]: [f64; 3]) -> [f64; 16] {
    let (xx, yy, zz, xy, yz, xz) = (x * x, y * y, z * z, x * y, y * z, x * z);
    [
        C0,
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * xy,
        C2[1] * yz,
        C2[2] * (2.0 * zz - xx - yy),
        C2[3] * xz,
        C2[4] * (xx - yy),
        C3[0] * y * (3.0 * xx - yy),
        C3[1] * xy * z,
        C3[2] * y * (4.0 * zz - xx - yy),
        C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        C3[4] * x * (4.0 * zz - xx - yy),
        C3[5] * z * (xx - yy),
        C3[6] * x * (xx - 3.0 * yy),
    ]
}
