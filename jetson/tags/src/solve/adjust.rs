//! Levenberg-Marquardt over the reprojection error of all corners.
//!
//! Six parameters: the position in world axes, and rotations about body axes, so that the covariance has the axes in
//! which poses are sent and fused. A Cauchy loss reduces the weight of outliers, such as a misread tag or a shadow over
//! an edge.

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Body, Intrinsics, Pose, World};

use super::{Geometry, Sighting, VehicleTwist};
use crate::layout::CORNERS;

/// A pose and its fit to the corners.
#[derive(Clone, Copy, Debug)]
pub struct PoseFit {
    pub world_from_body: Pose<World, Body>,
    /// Covariance of position (three, world axes) and attitude (three, about body axes). [m, rad]
    pub covariance: [[f64; 6]; 6],
    /// Root mean square reprojection error. [px]
    pub rms_px: f64,
    /// Half the robust sum of squares in units of sigma.
    pub cost: f64,
}

impl PoseFit {
    /// Returns the standard deviations of position and attitude. [m, world; rad, body]
    pub fn sigmas(&self) -> (DVec3, DVec3) {
        let sigma = |i: usize| self.covariance[i][i].max(0.0).sqrt();
        (DVec3::new(sigma(0), sigma(1), sigma(2)), DVec3::new(sigma(3), sigma(4), sigma(5)))
    }
}

/// Returns the robust cost of a pose; infinite if a tag would be behind its camera.
pub(super) fn cost(sightings: &[Sighting], motion: &VehicleTwist, pose: &Pose<World, Body>) -> f64 {
    let mut total = 0.0;
    for sighting in sightings {
        for (corner, measured) in CORNERS.iter().zip(sighting.corners_px) {
            let at = motion.carry(pose, -sighting.lag_at_s(measured.y));
            let p_cam = in_cam(sighting, &at, (*corner * sighting.size_m).extend(0.0)).0;
            let Some(seen) = project(sighting.camera, p_cam) else { return f64::INFINITY };
            total += loss((seen.0 - measured).length_squared() / sighting.sigma_px.powi(2)).0;
        }
    }
    total
}

/// See [`super::residual_px`].
pub(super) fn residual_px(
    sighting: &Sighting,
    motion: &VehicleTwist,
    pose: &Pose<World, Body>,
) -> f64 {
    let mut sum = 0.0;
    for (corner, measured) in CORNERS.iter().zip(sighting.corners_px) {
        let at = motion.carry(pose, -sighting.lag_at_s(measured.y));
        let p_cam = in_cam(sighting, &at, (*corner * sighting.size_m).extend(0.0)).0;
        let Some(seen) = project(sighting.camera, p_cam) else { return f64::INFINITY };
        sum += (seen.0 - measured).length_squared();
    }
    (sum / 4.0).sqrt()
}

/// Returns the nearest minimum; `None` if the corners do not determine one.
pub(super) fn adjust(
    sightings: &[Sighting],
    motion: &VehicleTwist,
    start: Pose<World, Body>,
) -> Option<PoseFit> {
    let mut pose = start;
    let mut normal = Normal::at(sightings, motion, &pose)?;
    let mut damping = 1e-4;
    for _ in 0..MAX_ROUNDS {
        let Some(change) = normal.step(damping) else {
            damping *= 10.0;
            if damping > 1e6 {
                return None;
            }
            continue;
        };
        let moved = Pose::new(
            pose.translation_m + DVec3::new(change[0], change[1], change[2]),
            (pose.rotation * DQuat::from_scaled_axis(DVec3::new(change[3], change[4], change[5])))
                .normalize(),
        );
        match Normal::at(sightings, motion, &moved) {
            Some(better) if better.cost <= normal.cost => {
                let gained = normal.cost - better.cost;
                let small = change.iter().all(|x| x.abs() < 1e-7);
                (pose, normal) = (moved, better);
                damping = (damping * 0.2).max(1e-9);
                if small || gained < 1e-6 * (1.0 + normal.cost) {
                    break;
                }
            }
            _ => {
                damping *= 8.0;
                if damping > 1e6 {
                    break;
                }
            }
        }
    }
    let mut covariance = invert6(&normal.matrix)?;
    // A larger scatter of corners than expected means that sigma was too small. A smaller scatter does not mean that it
    // was too large: a few corners can agree by chance.
    let freedom = (2 * normal.corners).saturating_sub(6).max(1);
    let scale = (normal.square_sum / freedom as f64).max(1.0);
    for row in &mut covariance {
        for value in row {
            *value *= scale;
        }
    }
    let corners = normal.corners as f64;
    let fit = PoseFit {
        world_from_body: pose,
        covariance,
        rms_px: (normal.square_sum_px2 / corners).sqrt(),
        cost: normal.cost,
    };
    (pose.is_valid() && fit.cost.is_finite()).then_some(fit)
}

/// Residual of a corner and its derivatives by the pose and by all possible errors.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CornerRow {
    /// Projected position minus detected position. [px]
    pub(crate) off_px: DVec2,
    /// Derivatives by the pose's position (world axes) and rotation (body axes), for x and for y. [px/m, px/rad]
    pub(crate) by_pose: [[f64; 6]; 2],
    /// Derivative by the time between exposure and pose. [px/s]
    pub(crate) by_lag: DVec2,
    /// Derivatives by the camera's position (outer axes) and rotation (its own axes). [px/m, px/rad]
    pub(crate) by_camera: [[f64; 6]; 2],
    /// Derivative by the tags' scale about `middle_m`. [px]
    pub(crate) by_scale: DVec2,
    /// Row in the image: -0.5 is the first, 0.5 the last.
    pub(crate) row_share: f64,
}

/// Returns the four corners of a tag at a pose; `None` if one is behind the camera. The scale of the tags is about
/// `middle_m` in the layout's frame.
pub(crate) fn corner_rows(
    sighting: &Sighting,
    motion: &VehicleTwist,
    pose: &Pose<World, Body>,
    middle_m: DVec3,
) -> Option<[CornerRow; 4]> {
    let zero = DVec2::ZERO;
    let row = CornerRow {
        off_px: zero,
        by_pose: [[0.0; 6]; 2],
        by_lag: zero,
        by_camera: [[0.0; 6]; 2],
        by_scale: zero,
        row_share: 0.0,
    };
    let mut rows = [row; 4];
    for ((row, corner), measured) in rows.iter_mut().zip(CORNERS).zip(sighting.corners_px) {
        let lag_s = sighting.lag_at_s(measured.y);
        let at = motion.carry(pose, -lag_s);
        let p_tag = (corner * sighting.size_m).extend(0.0);
        let (p_cam, by_position, by_turn) = in_cam(sighting, &at, p_tag);
        let (seen, by_point) = project(sighting.camera, p_cam)?;
        row.off_px = seen - measured;
        row.row_share = sighting.row_share(measured.y);
        let v_mps = motion.v_world_mps - motion.a_world_mps2 * lag_s;
        let by_lag = -(by_position * v_mps + by_turn * motion.omega_body_radps);
        // When the camera moves, points move the opposite way in its frame.
        let (outer, grown) = match sighting.sight {
            Geometry::OutsideIn { world_from_cam, body_from_tag } => {
                let p_body = body_from_tag.transform_point(p_tag);
                let by_body = by_position * DMat3::from_quat(at.rotation);
                (world_from_cam.rotation, by_body * (p_body - middle_m))
            }
            Geometry::InsideOut { body_from_cam, world_from_tag } => {
                let p_world = world_from_tag.transform_point(p_tag);
                (body_from_cam.rotation, by_position * (middle_m - p_world))
            }
        };
        let by_place = -DMat3::from_quat(outer).transpose();
        let by_tilt = cross(p_cam);
        for (axis, by_point) in by_point.iter().enumerate() {
            row.by_lag[axis] = by_point.dot(by_lag);
            row.by_scale[axis] = by_point.dot(grown);
            row.by_pose[axis] = six(*by_point, by_position, by_turn);
            row.by_camera[axis] = six(*by_point, by_place, by_tilt);
        }
    }
    Some(rows)
}

fn six(by_point: DVec3, by_position: DMat3, by_turn: DMat3) -> [f64; 6] {
    let position = by_position.transpose() * by_point;
    let turn = by_turn.transpose() * by_point;
    [position.x, position.y, position.z, turn.x, turn.y, turn.z]
}

/// Returns the inverse of a symmetric positive definite matrix. Reads only the lower triangle.
pub(crate) fn invert6(matrix: &[[f64; 6]; 6]) -> Option<[[f64; 6]; 6]> {
    let l = cholesky(matrix)?;
    let mut inverse = [[0.0; 6]; 6];
    for i in 0..6 {
        let mut unit = [0.0; 6];
        unit[i] = 1.0;
        inverse[i] = solve_with(&l, &unit);
    }
    inverse.iter().flatten().all(|value| value.is_finite()).then_some(inverse)
}

/// Normal equations at a pose.
struct Normal {
    /// Lower triangle of `J^T W J`.
    matrix: [[f64; 6]; 6],
    /// `J^T W r`.
    gradient: [f64; 6],
    cost: f64,
    /// Sum in units of sigma; a misread corner counts as [`MISREAD_SIGMAS`].
    square_sum: f64,
    square_sum_px2: f64,
    corners: usize,
}

impl Normal {
    fn at(sightings: &[Sighting], motion: &VehicleTwist, pose: &Pose<World, Body>) -> Option<Self> {
        let mut n = Self {
            matrix: [[0.0; 6]; 6],
            gradient: [0.0; 6],
            cost: 0.0,
            square_sum: 0.0,
            square_sum_px2: 0.0,
            corners: 0,
        };
        for sighting in sightings {
            // A rotation of the pose is treated as a rotation of the earlier pose about the same vehicle axes. This
            // neglects the rotation during the lag, about a degree, which costs an iteration but no accuracy.
            for (corner, measured) in CORNERS.iter().zip(sighting.corners_px) {
                let at = motion.carry(pose, -sighting.lag_at_s(measured.y));
                let p_tag = (*corner * sighting.size_m).extend(0.0);
                let (p_cam, by_position, by_turn) = in_cam(sighting, &at, p_tag);
                let (seen, by_point) = project(sighting.camera, p_cam)?;
                let off_px = seen - measured;
                let scaled = off_px / sighting.sigma_px;
                let (loss, weight) = loss(scaled.length_squared());
                n.cost += loss;
                n.square_sum += scaled.length_squared().min(MISREAD_SIGMAS * MISREAD_SIGMAS);
                n.square_sum_px2 += off_px.length_squared();
                n.corners += 1;
                for (row, residual) in by_point.iter().zip([scaled.x, scaled.y]) {
                    let j = six(*row / sighting.sigma_px, by_position, by_turn);
                    for a in 0..6 {
                        n.gradient[a] += weight * j[a] * residual;
                        for b in 0..=a {
                            n.matrix[a][b] += weight * j[a] * j[b];
                        }
                    }
                }
            }
        }
        (n.corners > 0 && n.cost.is_finite()).then_some(n)
    }

    fn step(&self, damping: f64) -> Option<[f64; 6]> {
        let mut damped = self.matrix;
        for i in 0..6 {
            damped[i][i] += damping * self.matrix[i][i] + 1e-12;
        }
        let l = cholesky(&damped)?;
        Some(solve_with(&l, &self.gradient.map(|g| -g)))
    }
}

/// Returns a point of the tag in the camera's frame, and its derivatives by the vehicle's position and by rotations
/// about the vehicle's axes.
fn in_cam(sighting: &Sighting, pose: &Pose<World, Body>, p_tag: DVec3) -> (DVec3, DMat3, DMat3) {
    let rotation = DMat3::from_quat(pose.rotation);
    match &sighting.sight {
        Geometry::OutsideIn { world_from_cam, body_from_tag } => {
            let p_body = body_from_tag.transform_point(p_tag);
            let cam_from_world = world_from_cam.inverse();
            let p_cam = cam_from_world.transform_point(pose.transform_point(p_body));
            let by_world = DMat3::from_quat(cam_from_world.rotation);
            (p_cam, by_world, by_world * rotation * -cross(p_body))
        }
        Geometry::InsideOut { body_from_cam, world_from_tag } => {
            let p_world = world_from_tag.transform_point(p_tag);
            let p_body = rotation.transpose() * (p_world - pose.translation_m);
            let cam_from_body = body_from_cam.inverse();
            let by_body = DMat3::from_quat(cam_from_body.rotation);
            let p_cam = cam_from_body.transform_point(p_body);
            (p_cam, by_body * -rotation.transpose(), by_body * cross(p_body))
        }
    }
}

/// Returns the pixel of a point and its derivatives by the point: two rows.
fn project(camera: &Intrinsics, p_cam: DVec3) -> Option<(DVec2, [DVec3; 2])> {
    if !(p_cam.z > NEAREST_M) {
        return None;
    }
    let slope = p_cam.truncate() / p_cam.z;
    // Far outside the field of view the distortion polynomial folds back; initial poses there do not converge.
    if !(slope.length_squared() < 100.0) {
        return None;
    }
    let (distorted, bend) = camera.distortion.distort(slope);
    let focal = DVec2::new(camera.fx_px, camera.fy_px);
    let pixel = focal * distorted + DVec2::new(camera.cx_px, camera.cy_px);
    let by_slope = DMat2::from_diagonal(focal) * bend;
    let (x, y) = (by_slope.x_axis, by_slope.y_axis);
    let row = |a: f64, b: f64| DVec3::new(a, b, -(a * slope.x + b * slope.y)) / p_cam.z;
    Some((pixel, [row(x.x, y.x), row(x.y, y.y)]))
}

/// Returns the matrix that maps `b` to `a x b`.
fn cross(a: DVec3) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(0.0, a.z, -a.y),
        DVec3::new(-a.z, 0.0, a.x),
        DVec3::new(a.y, -a.x, 0.0),
    )
}

/// Returns the Cauchy loss of a squared residual in units of sigma, and the resulting weight.
fn loss(square: f64) -> (f64, f64) {
    let c2 = ROBUST_SIGMAS * ROBUST_SIGMAS;
    (0.5 * c2 * (square / c2).ln_1p(), 1.0 / (1.0 + square / c2))
}

/// Returns the lower triangle whose product with its transpose is the matrix. Reads only the lower triangle; `None`
/// unless the matrix is positive definite.
fn cholesky(matrix: &[[f64; 6]; 6]) -> Option<[[f64; 6]; 6]> {
    let mut l = [[0.0; 6]; 6];
    for i in 0..6 {
        for j in 0..=i {
            let known: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
            let rest = matrix[i][j] - known;
            if i == j {
                if !(rest > 0.0) {
                    return None;
                }
                l[i][i] = rest.sqrt();
            } else {
                l[i][j] = rest / l[j][j];
            }
        }
    }
    Some(l)
}

fn solve_with(l: &[[f64; 6]; 6], right: &[f64; 6]) -> [f64; 6] {
    let mut x = *right;
    for i in 0..6 {
        for k in 0..i {
            x[i] -= l[i][k] * x[k];
        }
        x[i] /= l[i][i];
    }
    for i in (0..6).rev() {
        for k in i + 1..6 {
            x[i] -= l[k][i] * x[k];
        }
        x[i] /= l[i][i];
    }
    x
}

/// Scale of the Cauchy loss, in sigma.
const ROBUST_SIGMAS: f64 = 4.0;
/// Limit of residuals in the scatter, in sigma: a misread corner does not show the accuracy of others.
const MISREAD_SIGMAS: f64 = 25.0;
/// Minimum distance of a point in focus. [m]
const NEAREST_M: f64 = 0.02;
/// Maximum number of iterations; typical are five to ten.
const MAX_ROUNDS: usize = 40;
