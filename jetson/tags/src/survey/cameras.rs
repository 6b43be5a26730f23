//! Survey of fixed cameras, from images of a surveyed mat or of a cube that is carried around.

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::{Body, Cam, Intrinsics, Pose, World};

use super::{LOSS_PX, MAX_OUTLIERS, SurveyError, camera_pose, cube_pose};
use crate::bundle::{Bundle, CornerObservation, Parameter, Rigid, Solution};
use crate::detection::Detection;
use crate::layout::{CORNERS, TagLayout};

/// Detections of a fixed camera. Images with the same index were taken at the same time in all cameras, while the cube
/// was held still.
#[derive(Clone, Debug)]
pub struct CameraImages {
    pub name: String,
    pub intrinsics: Intrinsics,
    /// Tags in each image.
    pub images: Vec<Vec<Detection>>,
}

/// Surveyed pose of a fixed camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlacedCamera {
    pub world_from_cam: Pose<World, Cam>,
    /// Root mean square reprojection error, without misread tags. [px]
    pub rms_px: f64,
    /// Standard deviation of the position, over all axes. [m]
    pub sigma_m: f64,
    /// Number of corners used.
    pub corners: usize,
}

/// Size of the cube, relative to its layout.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CubeScale {
    /// Ratio of the true size to the size in the layout.
    pub scale: f64,
    /// Standard deviation. Large if only one camera sees the mat, because the cube then determines the other cameras'
    /// positions.
    pub sigma: f64,
}

/// Surveyed poses of fixed cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct SurveyedCameras {
    /// Cameras in the order of the images.
    pub cameras: Vec<PlacedCamera>,
    /// Size of the cube, if there is one. Estimated together with the poses, if it is observable.
    pub cube: Option<CubeScale>,
}

/// Returns the poses of cameras and the size of the cube. The mat defines the `world` frame. Cameras that do not see
/// the mat are located by the cube, at moments when an already located camera also sees it.
///
/// # Errors
/// [`SurveyError`] if a camera sees neither mat nor cube, or if the detections are inconsistent.
pub fn cameras(
    cameras: &[CameraImages],
    mat: &TagLayout,
    cube: Option<&TagLayout>,
) -> Result<SurveyedCameras, SurveyError> {
    let mut placed: Vec<Option<Pose<World, Cam>>> =
        cameras.iter().map(|camera| by_mat(camera, mat)).collect();
    let moments = cameras.iter().map(|camera| camera.images.len()).max().unwrap_or(0);
    let mut bodies: Vec<Option<Pose<World, Body>>> = vec![None; moments];
    if let Some(cube) = cube {
        loop {
            for (moment, body) in bodies.iter_mut().enumerate() {
                if body.is_none() {
                    *body = cube_at(cameras, &placed, cube, moment);
                }
            }
            let mut grown = false;
            for (camera, pose) in cameras.iter().zip(&mut placed) {
                if pose.is_none() {
                    *pose = by_cube(camera, cube, &bodies);
                    grown |= pose.is_some();
                }
            }
            if !grown {
                break;
            }
        }
    }
    if let Some((camera, _)) = cameras.iter().zip(&placed).find(|(_, pose)| pose.is_none()) {
        return Err(SurveyError::Unplaced { name: camera.name.clone() });
    }
    let start: Vec<Pose<World, Cam>> = placed.into_iter().flatten().collect();
    adjust(cameras, &start, mat, cube, &bodies)
}

/// Locates a camera by the image that shows most of the mat.
fn by_mat(camera: &CameraImages, mat: &TagLayout) -> Option<Pose<World, Cam>> {
    let known = |image: &Vec<Detection>| -> Vec<_> {
        image
            .iter()
            .filter_map(|d| {
                let tag = mat.find(d.family, d.id)?;
                Some((tag.frame_from_tag::<World>(), tag.size_m, d.corners_px))
            })
            .collect()
    };
    let best = camera.images.iter().map(known).max_by_key(Vec::len)?;
    camera_pose(&camera.intrinsics, &best).map(|(pose, _)| pose)
}

/// Returns the pose of the cube, from all located cameras.
fn cube_at(
    cameras: &[CameraImages],
    placed: &[Option<Pose<World, Cam>>],
    cube: &TagLayout,
    moment: usize,
) -> Option<Pose<World, Body>> {
    let mut seen = Vec::new();
    for (camera, pose) in cameras.iter().zip(placed) {
        let (Some(pose), Some(image)) = (pose, camera.images.get(moment)) else { continue };
        for d in image {
            if let Some(tag) = cube.find(d.family, d.id) {
                let body_from_tag = tag.frame_from_tag::<Body>();
                seen.push((&camera.intrinsics, *pose, body_from_tag, tag.size_m, d.corners_px));
            }
        }
    }
    let solved = cube_pose(&seen)?;
    // A single face can be ambiguous: wait for an image that resolves it.
    solved.other.is_none().then_some(solved.best.world_from_body)
}

/// Locates a camera by the cube at the moment that agrees best with the others.
fn by_cube(
    camera: &CameraImages,
    cube: &TagLayout,
    bodies: &[Option<Pose<World, Body>>],
) -> Option<Pose<World, Cam>> {
    let seen: Vec<(Pose<World, Body>, &Vec<Detection>)> = bodies
        .iter()
        .zip(&camera.images)
        .filter_map(|(body, image)| Some(((*body)?, image)))
        .collect();
    let tags = |(body, image): &(Pose<World, Body>, &Vec<Detection>)| -> Vec<_> {
        image
            .iter()
            .filter_map(|d| {
                let tag = cube.find(d.family, d.id)?;
                Some((*body * tag.frame_from_tag::<Body>(), tag.size_m, d.corners_px))
            })
            .collect()
    };
    let all: Vec<_> = seen.iter().flat_map(tags).collect();
    // All moments together are one large mat.
    let by_all = camera_pose(&camera.intrinsics, &all).map(|(pose, _)| pose);
    let by_each = seen.iter().filter_map(|moment| camera_pose(&camera.intrinsics, &tags(moment)));
    let cost = |pose: &Pose<World, Cam>| -> f64 {
        let cam_from_world = pose.inverse();
        all.iter()
            .flat_map(|(world_from_tag, size_m, corners_px)| {
                CORNERS.iter().zip(corners_px).map(|(corner, pixel)| {
                    let p_world = world_from_tag.transform_point((*corner * *size_m).extend(0.0));
                    let p_cam = cam_from_world.transform_point(p_world);
                    let far = 100.0;
                    camera
                        .intrinsics
                        .project(p_cam)
                        .map_or(far, |p: DVec2| p.distance(*pixel).min(far))
                })
            })
            .sum()
    };
    by_all
        .into_iter()
        .chain(by_each.map(|(pose, _)| pose))
        .min_by(|a, b| cost(a).total_cmp(&cost(b)))
}

fn adjust(
    cameras: &[CameraImages],
    start: &[Pose<World, Cam>],
    mat: &TagLayout,
    cube: Option<&TagLayout>,
    bodies: &[Option<Pose<World, Body>>],
) -> Result<SurveyedCameras, SurveyError> {
    let mut bundle = Bundle { loss_px: LOSS_PX, ..Bundle::default() };
    // Indices of corners on the cube.
    let mut cube_corners = Vec::new();
    let world = bundle.pose(Rigid::IDENTITY, Parameter::Fixed);
    let numbers: Vec<usize> =
        start.iter().map(|pose| bundle.pose(pose.inverse(), Parameter::Shared)).collect();
    let moments: Vec<Option<usize>> =
        bodies.iter().map(|body| body.map(|body| bundle.pose(body, Parameter::View))).collect();
    for (lens, (camera, &left)) in cameras.iter().zip(&numbers).enumerate() {
        bundle.lenses.push((camera.intrinsics, false));
        for (moment, image) in camera.images.iter().enumerate() {
            for d in image {
                let on_cube = || {
                    let tag = cube?.find(d.family, d.id)?;
                    Some((tag, (*moments.get(moment)?)?))
                };
                let on_mat = mat.find(d.family, d.id).map(|tag| (tag, world));
                let Some((tag, right)) = on_mat.or_else(on_cube) else { continue };
                if right != world {
                    cube_corners.extend(bundle.seen.len()..bundle.seen.len() + 4);
                }
                for (point_m, pixel) in tag.corners_m().into_iter().zip(d.corners_px) {
                    bundle.seen.push(CornerObservation { lens, left, right, point_m, pixel });
                }
            }
        }
    }
    let advice = "show each camera more tags of the mat, or the cube in more places";
    let mut solution = bundle.solve().ok_or(SurveyError::Undetermined { advice })?;
    let scale = cube
        .filter(|_| !cube_corners.is_empty())
        .and_then(|cube| scale_of(&bundle, &solution, &cube_corners, middle_m(cube)));
    if let (Some(cube), Some(CubeScale { scale, sigma })) = (cube, scale)
        && sigma < KNOWN_SCALE
    {
        resize(&mut bundle, &cube_corners, middle_m(cube), scale);
        solution = bundle.solve().ok_or(SurveyError::Undetermined { advice })?;
    }
    let mut placed = Vec::new();
    for (lens, number) in numbers.into_iter().enumerate() {
        let residuals: Vec<f64> = bundle
            .seen
            .iter()
            .filter(|seen| seen.lens == lens)
            .filter_map(|seen| bundle.residual(seen))
            .map(DVec2::length_squared)
            .collect();
        let corners = residuals.len();
        let rms =
            |squares: &[f64]| (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt();
        let good: Vec<f64> =
            residuals.iter().copied().filter(|square| *square <= LOSS_PX * LOSS_PX).collect();
        let rms_px = rms(&good);
        if (corners - good.len()) as f64 > MAX_OUTLIERS * corners as f64 {
            return Err(SurveyError::Contradiction {
                rms_px: rms(&residuals),
                most_px: LOSS_PX,
                advice: "was the cube held still, are the layouts those that were printed, and is \
                         each camera's file its own?",
            });
        }
        let cam_from_world: Pose<Cam, World> = bundle.poses[number].0.into();
        let sigma_m = solution.position_sigma_m(number).length();
        let world_from_cam = cam_from_world.inverse();
        placed.push(PlacedCamera { world_from_cam, rms_px, sigma_m, corners });
    }
    Ok(SurveyedCameras { cameras: placed, cube: scale })
}

/// Returns the cube size with the least cost. A parabola is fitted to the cost at several sizes, each with all poses
/// solved again; its curvature gives the standard deviation.
fn scale_of(
    bundle: &Bundle,
    solution: &Solution,
    cube_corners: &[usize],
    middle_m: DVec3,
) -> Option<CubeScale> {
    let cost = |scale: f64| {
        let mut bundle = bundle.clone();
        resize(&mut bundle, cube_corners, middle_m, scale);
        bundle.solve()?;
        Some(bundle.cost())
    };
    // The robust cost is a parabola only near its minimum.
    let mut found = CubeScale { scale: 1.0, sigma: f64::INFINITY };
    let mut least = cost(1.0)?;
    for percent in (-MOST_PERCENT..=MOST_PERCENT).filter(|percent| *percent != 0) {
        let scale = 1.0 + f64::from(percent) / 100.0;
        match cost(scale) {
            Some(cost) if cost < least => (found.scale, least) = (scale, cost),
            _ => {}
        }
    }
    for step in [0.005, 0.002] {
        let at = found.scale;
        let [below, here, above] = [cost(at - step)?, cost(at)?, cost(at + step)?];
        let bend = (above + below - 2.0 * here) / (step * step);
        if !(bend > 0.0) {
            return Some(CubeScale { scale: 1.0, sigma: f64::INFINITY });
        }
        let slope = (above - below) / (2.0 * step);
        let scale = at - (slope / bend).clamp(-0.01, 0.01);
        // Half the squares of both axes, in units of the corners' variance along one axis.
        let variance_px2 = 0.5 * solution.rms_px.max(LEAST_RMS_PX).powi(2);
        found = CubeScale { scale, sigma: (2.0 * variance_px2 / bend).sqrt() };
    }
    Some(found)
}

/// Scales the cube about the middle of its tags.
fn resize(bundle: &mut Bundle, cube_corners: &[usize], middle_m: DVec3, scale: f64) {
    for &index in cube_corners {
        let point_m = &mut bundle.seen[index].point_m;
        *point_m = middle_m + scale * (*point_m - middle_m);
    }
}

fn middle_m(cube: &TagLayout) -> DVec3 {
    cube.tags.iter().map(|tag| tag.position_m).sum::<DVec3>() / cube.tags.len() as f64
}

/// Maximum sigma at which the estimated size is used.
const KNOWN_SCALE: f64 = 0.003;
/// Maximum deviation of a print; a larger one means another layout. [%]
const MOST_PERCENT: i32 = 5;
/// Minimum RMS error of corners. [px]
const LEAST_RMS_PX: f64 = 0.05;
