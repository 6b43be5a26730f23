//! The two possible poses of one square, in closed form.
//!
//! Collins and Bartoli 2014, "Infinitesimal plane-based pose estimation": the homography from the square to the image,
//! to first order at the square's middle, leaves two rotations. The translation of each follows by linear least
//! squares.

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose};

use crate::layout::{CORNERS, Square};

/// Returns the possible poses, `cam_from_tag`, of a square with this edge [m] and these corners: two, or none if the
/// corners are not those of a square.
pub(super) fn poses(
    camera: &Intrinsics,
    size_m: f64,
    corners_px: &[DVec2; 4],
) -> Vec<Pose<Cam, Square>> {
    let mut slopes = [DVec2::ZERO; 4];
    for (slope, &corner) in slopes.iter_mut().zip(corners_px) {
        match camera.slope(corner) {
            Some(found) => *slope = found,
            None => return Vec::new(),
        }
    }
    let Some(h) = homography(&slopes, size_m) else { return Vec::new() };
    let Some(rotations) = rotations(&h) else { return Vec::new() };
    rotations
        .into_iter()
        .filter_map(|rotation| {
            let t = translation(&slopes, size_m, &rotation)?;
            let pose = Pose::new(t, DQuat::from_mat3(&rotation).normalize());
            (pose.is_valid() && t.z > 0.0).then_some(pose)
        })
        .collect()
}

/// Returns the homography from points of the square [m] to slopes, normalized to a last element of 1.
fn homography(slopes: &[DVec2; 4], size_m: f64) -> Option<DMat3> {
    // From the unit square (0,0), (1,0), (1,1), (0,1) to a quad: Heckbert 1989, "Fundamentals of texture
    // mapping and image warping", section 2.2.3.
    let [p0, p1, p2, p3] = *slopes;
    let sum = p0 - p1 + p2 - p3;
    let (d1, d2) = (p1 - p2, p3 - p2);
    let area = d1.perp_dot(d2);
    let g = sum.perp_dot(d2) / area;
    let h = d1.perp_dot(sum) / area;
    let (a, b) = (p1 - p0 + p1 * g, p3 - p0 + p3 * h);
    let from_unit = DMat3::from_cols(a.extend(g), b.extend(h), p0.extend(1.0));
    // The origin of the square's coordinates is its middle.
    let unit_from_square = DMat3::from_cols(
        DVec3::new(1.0 / size_m, 0.0, 0.0),
        DVec3::new(0.0, 1.0 / size_m, 0.0),
        DVec3::new(0.5, 0.5, 1.0),
    );
    let whole = from_unit * unit_from_square;
    let scale = whole.z_axis.z;
    let scaled = whole * (1.0 / scale);
    (scaled.is_finite() && scale.abs() > 1e-9).then_some(scaled)
}

fn rotations(h: &DMat3) -> Option<[DMat3; 2]> {
    // Slope of the middle, and the derivative of slopes by the square's coordinates there.
    let middle = h.z_axis.truncate();
    let jacobian = DMat2::from_cols(
        h.x_axis.truncate() - middle * h.x_axis.z,
        h.y_axis.truncate() - middle * h.y_axis.z,
    );
    let ray = middle.extend(1.0).normalize();
    let turn = DMat3::from_quat(DQuat::from_rotation_arc(DVec3::Z, ray));
    let b = DMat2::from_cols(
        turn.x_axis.truncate() - middle * turn.x_axis.z,
        turn.y_axis.truncate() - middle * turn.y_axis.z,
    );
    if !(b.determinant().abs() > 1e-12) {
        return None;
    }
    let a = b.inverse() * jacobian;
    // The largest singular value is the inverse of the depth.
    let aa = a * a.transpose();
    let (p, q, r) = (aa.x_axis.x, aa.y_axis.y, aa.y_axis.x);
    let gain = (0.5 * (p + q + ((p - q).powi(2) + 4.0 * r * r).sqrt())).sqrt();
    if !(gain > 1e-9) {
        return None;
    }
    let flat = a * (1.0 / gain);
    // The third elements of the first two columns complete them to unit length, up to one common sign.
    let lack = DMat2::IDENTITY - flat.transpose() * flat;
    let b0 = lack.x_axis.x.max(0.0).sqrt();
    let b1 = lack.y_axis.y.max(0.0).sqrt();
    let b1 = if lack.y_axis.x < 0.0 { -b1 } else { b1 };
    Some([1.0, -1.0].map(|sign| {
        let x = flat.x_axis.extend(sign * b0);
        let y = flat.y_axis.extend(sign * b1);
        turn * DMat3::from_cols(x, y, x.cross(y))
    }))
}

/// Returns the position of the square's middle by least squares over its corners. `t.xy - slope t.z` must equal `slope
/// r.z - r.xy` for a corner at offset `r` from the middle.
fn translation(slopes: &[DVec2; 4], size_m: f64, rotation: &DMat3) -> Option<DVec3> {
    let mut normal = DMat3::ZERO;
    let mut right = DVec3::ZERO;
    for (slope, corner) in slopes.iter().zip(CORNERS) {
        let r = *rotation * (corner * size_m).extend(0.0);
        for (row, target) in [
            (DVec3::new(1.0, 0.0, -slope.x), slope.x * r.z - r.x),
            (DVec3::new(0.0, 1.0, -slope.y), slope.y * r.z - r.y),
        ] {
            normal += DMat3::from_cols(row * row.x, row * row.y, row * row.z);
            right += row * target;
        }
    }
    let t = normal.inverse() * right;
    t.is_finite().then_some(t)
}
