//! Homography of the board's plane, and the focal length and pose from it.

use glam::{DMat3, DVec2, DVec3};
use vizflyt_protocol::geometry::Intrinsics;

use super::rotation;
use crate::bundle::Rigid;

/// The homography from a plane [m] to the image [px].
#[derive(Clone, Copy, Debug)]
pub(super) struct Plane {
    /// The homography, with arbitrary sign.
    pixel_from_plane: DMat3,
    /// Sign that makes the third component positive, so that it is the depth.
    depth_sign: f64,
    /// Mean of the corners on the plane. [m]
    middle_m: DVec2,
}

impl Plane {
    /// Fits the homography to corners on the plane and in the image, by least squares of the algebraic error in
    /// normalised coordinates (Hartley and Zisserman 2004, algorithm 4.2), with a last element of 1.
    pub(super) fn fit(corners: &[(DVec2, DVec2)]) -> Option<Self> {
        let (on_plane, plane_from) = normalise(corners.iter().map(|c| c.0))?;
        let (in_image, image_from) = normalise(corners.iter().map(|c| c.1))?;
        let mut normal = [[0.0; 9]; 8];
        for (p, q) in on_plane.iter().zip(&in_image) {
            for (row, right) in [
                ([p.x, p.y, 1.0, 0.0, 0.0, 0.0, -q.x * p.x, -q.x * p.y], q.x),
                ([0.0, 0.0, 0.0, p.x, p.y, 1.0, -q.y * p.x, -q.y * p.y], q.y),
            ] {
                for i in 0..8 {
                    for j in 0..8 {
                        normal[i][j] += row[i] * row[j];
                    }
                    normal[i][8] += row[i] * right;
                }
            }
        }
        let h = eliminate(&mut normal)?;
        let inner = DMat3::from_cols(
            DVec3::new(h[0], h[3], h[6]),
            DVec3::new(h[1], h[4], h[7]),
            DVec3::new(h[2], h[5], 1.0),
        );
        let whole = image_from.inverse() * inner * plane_from;
        let middle_m = corners.iter().map(|c| c.0).sum::<DVec2>() / corners.len() as f64;
        let depth_sign = (whole * middle_m.extend(1.0)).z.signum();
        whole.is_finite().then_some(Self { pixel_from_plane: whole, depth_sign, middle_m })
    }

    /// Returns the plane's pose behind a lens, without distortion: only an initial pose.
    pub(super) fn pose(&self, lens: &Intrinsics) -> Option<Rigid> {
        let slope_from_pixel = DMat3::from_cols(
            DVec3::new(1.0 / lens.fx_px, 0.0, 0.0),
            DVec3::new(0.0, 1.0 / lens.fy_px, 0.0),
            DVec3::new(-lens.cx_px / lens.fx_px, -lens.cy_px / lens.fy_px, 1.0),
        );
        let h = slope_from_pixel * self.pixel_from_plane * self.depth_sign;
        let scale = 2.0 / (h.x_axis.length() + h.y_axis.length());
        let q = rotation(h.x_axis, h.y_axis);
        let pose = Rigid { t_m: h.z_axis * scale, q };
        let ahead = pose.apply(self.middle_m.extend(0.0)).z > 0.0;
        (ahead && pose.t_m.is_finite() && q.is_finite()).then_some(pose)
    }
}

/// Returns the focal length that fits all homographies best, for square pixels and this principal point: columns of a
/// rotation are perpendicular and of equal length.
pub(super) fn focal_px(planes: &[Plane], middle: DVec2) -> Option<f64> {
    // Each view gives two equations a x + b = 0 for x = 1 / f^2.
    let (mut ab, mut aa) = (0.0, 0.0);
    for plane in planes {
        let shift = DMat3::from_cols(DVec3::X, DVec3::Y, (-middle).extend(1.0));
        let h = shift * plane.pixel_from_plane;
        let (u, v) = (h.x_axis, h.y_axis);
        let scale = 1.0 / (u.length() * v.length());
        for (a, b) in [
            (u.x * v.x + u.y * v.y, u.z * v.z),
            (u.x * u.x + u.y * u.y - v.x * v.x - v.y * v.y, u.z * u.z - v.z * v.z),
        ] {
            ab += a * b * scale * scale;
            aa += a * a * scale * scale;
        }
    }
    let x = -ab / aa;
    (x > 0.0).then(|| 1.0 / x.sqrt()).filter(|f| f.is_finite())
}

/// Shifts and scales points to mean 0 and mean distance sqrt 2; `None` if all points coincide.
fn normalise(points: impl Iterator<Item = DVec2>) -> Option<(Vec<DVec2>, DMat3)> {
    let points: Vec<DVec2> = points.collect();
    let count = points.len() as f64;
    let mean = points.iter().sum::<DVec2>() / count;
    let distance = points.iter().map(|p| p.distance(mean)).sum::<f64>() / count;
    let scale = std::f64::consts::SQRT_2 / distance;
    if !(scale.is_finite() && scale > 0.0) {
        return None;
    }
    let matrix = DMat3::from_cols(DVec3::X * scale, DVec3::Y * scale, (-mean * scale).extend(1.0));
    Some((points.into_iter().map(|p| (p - mean) * scale).collect(), matrix))
}

/// Solves 8 equations by elimination with partial pivoting.
fn eliminate(m: &mut [[f64; 9]; 8]) -> Option<[f64; 8]> {
    for i in 0..8 {
        let pivot = (i..8).max_by(|&a, &b| m[a][i].abs().total_cmp(&m[b][i].abs()))?;
        m.swap(i, pivot);
        if !(m[i][i].abs() > 1e-12) {
            return None;
        }
        for row in 0..8 {
            if row != i {
                let factor = m[row][i] / m[i][i];
                for column in i..9 {
                    m[row][column] -= factor * m[i][column];
                }
            }
        }
    }
    Some(std::array::from_fn(|i| m[i][8] / m[i][i]))
}
