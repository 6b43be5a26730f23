//! Real spherical harmonics up to degree 3: colour by viewing direction, in f64.
//!
//! Constants and signs are those of the 3DGS trainers (from Sloan, "Efficient Spherical Harmonic Evaluation", JCGT
//! 2013, with the Condon-Shortley phase).

use glam::{DQuat, DVec3};

/// `1 / (2 sqrt(pi))`.
pub const C0: f64 = 0.28209479177387814;
/// `sqrt(3 / (4 pi))`.
pub const C1: f64 = 0.4886025119029199;
/// Constants of degree 2.
pub const C2: [f64; 5] = [
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
];
/// Constants of degree 3.
pub const C3: [f64; 7] = [
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
];

/// Returns the linear RGB of harmonics (coefficient by coefficient, in each RGB), seen along a unit direction from
/// the camera to the splat; clamped to at least 0.
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

/// Rotation of harmonics. Coefficients mix only within their degree, by one matrix per degree.
#[derive(Clone, Debug)]
pub struct Turn {
    /// Matrices from degree 1 on; empty if the rotation is the identity.
    mixes: Vec<[[f32; 7]; 7]>,
}

impl Turn {
    /// Returns the rotation of harmonics up to a degree.
    pub fn new(rotation: DQuat, degree: u8) -> Self {
        if rotation.w.abs() > 1.0 - 1e-15 {
            return Self { mixes: Vec::new() };
        }
        Self { mixes: (1..=usize::from(degree)).map(|band| mixing(band, rotation)).collect() }
    }

    /// Rotates the harmonics of one splat; coefficient by coefficient, in each RGB.
    pub fn apply(&self, sh: &mut [f32]) {
        for (mix, band) in self.mixes.iter().zip(1..) {
            let width = 2 * band + 1;
            let coefficients = &mut sh[band * band * 3..][..width * 3];
            let mut before = [0.0; 21];
            before[..width * 3].copy_from_slice(coefficients);
            for (row, rgb) in mix.iter().zip(coefficients.chunks_exact_mut(3)) {
                for (channel, value) in rgb.iter_mut().enumerate() {
                    *value = (0..width).map(|k| row[k] * before[k * 3 + channel]).sum();
                }
            }
        }
    }
}

/// Returns M with `after = M before` for degree `band`. `M_ij` is the integral of `Y_i(R d) Y_j(d)` over all
/// directions, because the basis is orthonormal. Computed by a quadrature that is exact for polynomials of degree 7:
/// Gauss-Legendre along z, equal steps around z.
fn mixing(band: usize, rotation: DQuat) -> [[f32; 7]; 7] {
    const NODES: [(f64, f64); 2] = [
        (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
        (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    ];
    const STEPS: u32 = 8;
    let (first, width) = (band * band, 2 * band + 1);
    let mut sums = [[0f64; 7]; 7];
    for (z, weight) in NODES.into_iter().flat_map(|(z, weight)| [(z, weight), (-z, weight)]) {
        for step in 0..STEPS {
            let angle = std::f64::consts::TAU * f64::from(step) / f64::from(STEPS);
            let r = (1.0 - z * z).sqrt();
            let d = DVec3::new(r * angle.cos(), r * angle.sin(), z);
            let (before, after) = (basis(d.to_array()), basis((rotation * d).to_array()));
            let area = weight * std::f64::consts::TAU / f64::from(STEPS);
            for (i, row) in sums.iter_mut().enumerate().take(width) {
                for (j, sum) in row.iter_mut().enumerate().take(width) {
                    *sum += area * after[first + i] * before[first + j];
                }
            }
        }
    }
    sums.map(|row| row.map(|v| v as f32))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotation_keeps_colours_in_rotated_directions() {
        let rotation = DQuat::from_xyzw(0.3, -0.5, 0.2, 0.7).normalize();
        let sh: Vec<f32> = (0..48).map(|k| (k as f32 * 1.7).sin() * 0.3).collect();
        let mut turned = sh.clone();
        Turn::new(rotation, 3).apply(&mut turned);
        for d in [DVec3::X, DVec3::Y, DVec3::NEG_Z, DVec3::new(0.6, -0.48, 0.64)] {
            let before = colour(&sh, d.to_array());
            let after = colour(&turned, (rotation * d).to_array());
            for channel in 0..3 {
                assert!(
                    (before[channel] - after[channel]).abs() < 1e-5,
                    "{d}: {before:?} {after:?}"
                );
            }
        }
    }
}
