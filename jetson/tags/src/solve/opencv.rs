//! Initial poses by OpenCV: IPPE for one square, SQPnP for all tags of one camera (Terzakis and Lourakis 2020, "A
//! consistently fast and globally optimal solution to the perspective-n-point problem"). Feature `opencv`.
//!
//! OpenCV receives undistorted slopes instead of pixels, so its own lens models are not used.

use glam::{DMat3, DQuat, DVec2, DVec3};
use opencv::calib3d::{SolvePnPMethod, solve_pnp_generic};
use opencv::core::{CV_64F, Mat, Point2d, Point3d, Vector, no_array};
use opencv::prelude::{MatExprTraitConst, MatTraitConst};
use vizflyt_protocol::geometry::{Body, Cam, Frame, Intrinsics, Pose, World};

use super::{Geometry, Sighting};
use crate::layout::{CORNERS, Square};

/// [`super::plane::poses`] by IPPE.
pub(super) fn square(
    camera: &Intrinsics,
    size_m: f64,
    corners_px: &[DVec2; 4],
) -> Vec<Pose<Cam, Square>> {
    // IPPE_SQUARE requires the upper left corner first, then clockwise order.
    let points = [3, 2, 1, 0].map(|i: usize| ((CORNERS[i] * size_m).extend(0.0), corners_px[i]));
    poses(camera, &points, SolvePnPMethod::SOLVEPNP_IPPE_SQUARE)
}

/// Returns the vehicle's pose at the exposure, from all tags of each camera that sees several, and the lag. [s]
pub(super) fn joint(sightings: &[Sighting]) -> Vec<(Pose<World, Body>, f64)> {
    let mut found = Vec::new();
    for (index, first) in sightings.iter().enumerate() {
        if sightings[..index].iter().any(|earlier| is_one_image(earlier, first)) {
            continue;
        }
        let image: Vec<&Sighting> =
            sightings.iter().filter(|other| is_one_image(first, other)).collect();
        if image.len() < 2 {
            continue;
        }
        let points: Vec<(DVec3, DVec2)> = image
            .iter()
            .flat_map(|sighting| {
                CORNERS.iter().zip(sighting.corners_px).map(|(corner, pixel)| {
                    let p_tag = (*corner * sighting.size_m).extend(0.0);
                    let p = match &sighting.sight {
                        Geometry::OutsideIn { body_from_tag, .. } => {
                            body_from_tag.transform_point(p_tag)
                        }
                        Geometry::InsideOut { world_from_tag, .. } => {
                            world_from_tag.transform_point(p_tag)
                        }
                    };
                    (p, pixel)
                })
            })
            .collect();
        let method = SolvePnPMethod::SOLVEPNP_SQPNP;
        match first.sight {
            Geometry::OutsideIn { world_from_cam, .. } => {
                let poses = poses::<Body>(first.camera, &points, method);
                found.extend(poses.into_iter().map(|p| (world_from_cam * p, first.lag_s)));
            }
            Geometry::InsideOut { body_from_cam, .. } => {
                let poses = poses::<World>(first.camera, &points, method);
                let body = |p: Pose<Cam, World>| (body_from_cam * p).inverse();
                found.extend(poses.into_iter().map(|p| (body(p), first.lag_s)));
            }
        }
    }
    found
}

/// Returns whether two tags were detected in the same image.
fn is_one_image(a: &Sighting, b: &Sighting) -> bool {
    let same_place = match (&a.sight, &b.sight) {
        (
            Geometry::OutsideIn { world_from_cam: a, .. },
            Geometry::OutsideIn { world_from_cam: b, .. },
        ) => a == b,
        (
            Geometry::InsideOut { body_from_cam: a, .. },
            Geometry::InsideOut { body_from_cam: b, .. },
        ) => a == b,
        _ => false,
    };
    same_place && a.camera == b.camera && a.lag_s == b.lag_s
}

/// Returns the camera's pose candidates; empty if OpenCV finds no pose or fails.
fn poses<F: Frame>(
    camera: &Intrinsics,
    points: &[(DVec3, DVec2)],
    method: SolvePnPMethod,
) -> Vec<Pose<Cam, F>> {
    let slopes: Option<Vec<DVec2>> = points.iter().map(|&(_, pixel)| camera.slope(pixel)).collect();
    let Some(slopes) = slopes.filter(|slopes| slopes.iter().all(|slope| slope.is_finite())) else {
        return Vec::new();
    };
    let objects: Vector<Point3d> =
        points.iter().map(|(p, _)| Point3d::new(p.x, p.y, p.z)).collect();
    let images: Vector<Point2d> = slopes.iter().map(|s| Point2d::new(s.x, s.y)).collect();
    let found = pnp(&objects, &images, method).unwrap_or_default();
    found
        .into_iter()
        .map(|(rotation, t)| Pose::new(t, DQuat::from_scaled_axis(rotation).normalize()))
        .filter(|pose: &Pose<Cam, F>| {
            // All points are in front of the camera: a plane also has a mirrored solution behind it.
            pose.is_valid() && points.iter().all(|(p, _)| pose.transform_point(*p).z > 0.0)
        })
        .collect()
}

fn pnp(
    objects: &Vector<Point3d>,
    images: &Vector<Point2d>,
    method: SolvePnPMethod,
) -> opencv::Result<Vec<(DVec3, DVec3)>> {
    let identity = Mat::eye(3, 3, CV_64F)?.to_mat()?;
    let (mut turns, mut places) = (Vector::<Mat>::new(), Vector::<Mat>::new());
    solve_pnp_generic(
        objects,
        images,
        &identity,
        &no_array(),
        &mut turns,
        &mut places,
        false,
        method,
        &no_array(),
        &no_array(),
        &mut no_array(),
    )?;
    let three =
        |m: Mat| -> opencv::Result<DVec3> { Ok(DVec3::new(*m.at(0)?, *m.at(1)?, *m.at(2)?)) };
    turns.into_iter().zip(places).map(|(turn, place)| Ok((three(turn)?, three(place)?))).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::{VehicleTwist, adjust, plane, solve};
    use super::*;
    use crate::synth::webcam;

    const SIZE_M: f64 = 0.16;

    /// Corners of a tag seen from the front, with `noise_px` added.
    fn corners(cam_from_tag: &Pose<Cam, Square>, noise_px: &[f64; 8]) -> Option<[DVec2; 4]> {
        let camera = webcam();
        let mut found = [DVec2::ZERO; 4];
        for (i, corner) in CORNERS.iter().enumerate() {
            let p = cam_from_tag.transform_point((*corner * SIZE_M).extend(0.0));
            found[i] = camera.project(p)? + DVec2::new(noise_px[2 * i], noise_px[2 * i + 1]);
        }
        Some(found)
    }

    /// A tag that faces the camera, rotated by `turn`.
    fn facing(turn: [f64; 3], t_m: [f64; 3]) -> Pose<Cam, Square> {
        let half = DQuat::from_rotation_x(std::f64::consts::PI);
        Pose::new(DVec3::from(t_m), DQuat::from_scaled_axis(DVec3::from(turn)) * half)
    }

    proptest! {
        /// Both solutions of one square: OpenCV's implementation against `plane`.
        #[test]
        fn ippe_and_plane_return_the_same_two_poses(
            turn in prop::array::uniform3(-0.7..0.7f64),
            x in -0.6..0.6f64, y in -0.3..0.3f64, z in 0.8..4.0f64,
            noise in prop::array::uniform8(-0.2..0.2f64),
        ) {
            let truth = facing(turn, [x * z, y * z, z]);
            let Some(corners_px) = corners(&truth, &noise) else { return Ok(()) };
            let ours = plane::poses(&webcam(), SIZE_M, &corners_px);
            let theirs = square(&webcam(), SIZE_M, &corners_px);
            prop_assert_eq!((ours.len(), theirs.len()), (2, 2));
            for own in &ours {
                let off = theirs.iter().map(|other| {
                    let turned = own.rotation.angle_between(other.rotation);
                    turned + own.translation_m.distance(other.translation_m)
                });
                let off = off.fold(f64::INFINITY, f64::min);
                prop_assert!(off < 1e-4, "{own:?} is not among {theirs:?}");
            }
        }

        /// Several faces of a cube in one image: SQPnP finds the true pose, and the solver converges to the same pose
        /// as from the initial poses of `plane`.
        #[test]
        fn sqpnp_of_several_tags_leads_to_the_same_pose(
            yaw in -3.0..3.0f64, lean in -0.3..0.3f64,
            x in 1.5..4.0f64, y in -0.5..0.5f64,
        ) {
            let camera = webcam();
            // The camera looks along x from 1.5 m height, level.
            let axes = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
            let world_from_cam = Pose::new(DVec3::Z * 1.5, DQuat::from_mat3(&axes));
            let turn = DQuat::from_rotation_z(yaw) * DQuat::from_rotation_y(lean);
            let truth: Pose<World, Body> = Pose::new(DVec3::new(x, y, 0.9), turn);
            let mut sightings = Vec::new();
            for normal in [DVec3::X, DVec3::Y, DVec3::NEG_X, DVec3::NEG_Y, DVec3::Z] {
                let rotation = DQuat::from_rotation_arc(DVec3::Z, normal);
                let body_from_tag: Pose<Body, Square> = Pose::new(normal * 0.1, rotation);
                let cam_from_tag = world_from_cam.inverse() * truth * body_from_tag;
                let away = (cam_from_tag.rotation * DVec3::Z).dot(cam_from_tag.translation_m);
                if away > -0.2 * cam_from_tag.translation_m.length() {
                    continue;
                }
                let Some(corners_px) = corners(&cam_from_tag, &[0.0; 8]) else { continue };
                let sight = Geometry::OutsideIn { world_from_cam, body_from_tag };
                sightings.push(Sighting { camera: &camera, sight, size_m: SIZE_M, corners_px, sigma_px: 0.2, lag_s: 0.01, readout_s: 0.0 });
            }
            prop_assume!(sightings.len() >= 2);
            let found = joint(&sightings);
            let off = |pose: &Pose<World, Body>| {
                pose.translation_m.distance(truth.translation_m) + pose.rotation.angle_between(truth.rotation)
            };
            prop_assert!(found.iter().any(|(pose, lag_s)| off(pose) < 1e-4 && *lag_s == 0.01), "{found:?}");
            let still = VehicleTwist::default();
            let whole = solve(&sightings, &still, None).unwrap().best;
            let own = plane::poses(&camera, SIZE_M, &sightings[0].corners_px);
            let start = super::super::world_from_body(&sightings[0].sight, &own[0]);
            let other = super::super::world_from_body(&sightings[0].sight, &own[1]);
            let own = [start, other].into_iter().filter_map(|start| adjust::adjust(&sightings, &still, start));
            let own = own.min_by(|a, b| a.cost.total_cmp(&b.cost)).unwrap();
            prop_assert!(off(&whole.world_from_body) < 1e-6, "{whole:?}");
            prop_assert!(off(&own.world_from_body) < 1e-6, "{own:?}");
        }
    }

    #[test]
    fn opencv_failures_return_valid_or_no_initial_poses() {
        let nowhere = [DVec2::new(640.0, 360.0); 4];
        assert!(square(&webcam(), SIZE_M, &nowhere).iter().all(Pose::is_valid));
        let nan = [DVec2::NAN; 4];
        assert!(square(&webcam(), SIZE_M, &nan).is_empty());
        assert!(joint(&[]).is_empty());
    }
}
