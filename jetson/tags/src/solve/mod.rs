//! Estimates the vehicle's pose from all tags in all cameras together.
//!
//! Input: corners in pixels, each with its point in the layout and its camera. Output: `world_from_body` with
//! covariance, and the second solution if the corners are ambiguous. Called once per set of images; about 50 us for two
//! cameras with three tags each.
//!
//! - [`plane`]: the two possible poses of one square, in closed form, as initial poses
//! - [`adjust`]: Levenberg-Marquardt over the reprojection error of all corners with a robust loss, and the covariance
//!   from its Jacobian
//! - `opencv`: with feature `opencv`, the same initial poses by OpenCV's IPPE, and one from all tags of an image by
//!   SQPnP
//!
//! A distant square looks nearly the same when tilted towards the camera or away from it, so the reprojection error has
//! two minima. A second face of the cube, a second tag of the mat or a second camera resolves this ambiguity. Without
//! one, [`Solved::other`] contains the second minimum.

mod adjust;
#[cfg(feature = "opencv")]
mod opencv;
mod plane;

pub use adjust::PoseFit;
pub(crate) use adjust::{CornerRow, corner_rows, invert6};

use glam::{DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Body, Cam, Intrinsics, Pose, World};

use crate::layout::Square;

/// Known poses of camera and tag.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Geometry {
    /// A camera fixed in the room, and a tag on the vehicle.
    OutsideIn { world_from_cam: Pose<World, Cam>, body_from_tag: Pose<Body, Square> },
    /// A camera on the vehicle, and a tag in the room.
    InsideOut { body_from_cam: Pose<Body, Cam>, world_from_tag: Pose<World, Square> },
}

/// Detection of one tag by one camera.
#[derive(Clone, Copy, Debug)]
pub struct Sighting<'a> {
    /// Lens of the camera.
    pub camera: &'a Intrinsics,
    pub sight: Geometry,
    /// Edge of the tag's square. [m]
    pub size_m: f64,
    /// Corners in the layout's order. [px]
    pub corners_px: [DVec2; 4],
    /// Standard deviation of a corner along x or y. [px]
    pub sigma_px: f64,
    /// Time from the exposure of the image's middle row to the estimated pose. [s]
    pub lag_s: f64,
    /// Time from the exposure of the image's first row to that of its last row. [s]
    pub readout_s: f64,
}

impl Sighting<'_> {
    /// Returns the time from the exposure of a row to the estimated pose. [s]
    pub(crate) fn lag_at_s(&self, row_px: f64) -> f64 {
        self.lag_s - self.readout_s * self.row_share(row_px)
    }

    /// Returns the relative position of a row in the image: -0.5 is the first, 0.5 the last.
    pub(crate) fn row_share(&self, row_px: f64) -> f64 {
        row_px / f64::from(self.camera.height_px) - 0.5
    }

    fn middle_lag_s(&self) -> f64 {
        self.lag_at_s(0.5 * (self.corners_px[0].y + self.corners_px[2].y))
    }
}

/// Motion of the vehicle, to combine images of different exposure times.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct VehicleTwist {
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// Angular velocity. [rad/s, body]
    pub omega_body_radps: DVec3,
    /// Acceleration. [m/s^2, world]
    pub a_world_mps2: DVec3,
}

impl VehicleTwist {
    /// Returns the pose after `dt_s`, which can be negative.
    pub fn carry(&self, world_from_body: &Pose<World, Body>, dt_s: f64) -> Pose<World, Body> {
        Pose::new(
            world_from_body.translation_m
                + self.v_world_mps * dt_s
                + self.a_world_mps2 * (0.5 * dt_s * dt_s),
            (world_from_body.rotation * DQuat::from_scaled_axis(self.omega_body_radps * dt_s))
                .normalize(),
        )
    }
}

/// The solution, and the second one if the corners are ambiguous.
#[derive(Clone, Copy, Debug)]
pub struct Solved {
    /// The pose that explains the corners best.
    pub best: PoseFit,
    /// Another minimum, rotated by more than a few degrees, that fits nearly as well: the corners do not decide.
    pub other: Option<PoseFit>,
}

/// Returns the pose from all sightings; `None` if no initial pose converges.
///
/// `expected` is the predicted pose, used as one more initial pose.
pub fn solve(
    sightings: &[Sighting],
    motion: &VehicleTwist,
    expected: Option<&Pose<World, Body>>,
) -> Option<Solved> {
    let mut starts: Vec<(f64, Pose<World, Body>)> = Vec::with_capacity(3 * sightings.len() + 1);
    let mut add = |pose: Pose<World, Body>| {
        let cost = adjust::cost(sightings, motion, &pose);
        if cost.is_finite() {
            starts.push((cost, pose));
        }
    };
    for sighting in sightings {
        for cam_from_tag in square(sighting) {
            add(motion
                .carry(&world_from_body(&sighting.sight, &cam_from_tag), sighting.middle_lag_s()));
        }
    }
    #[cfg(feature = "opencv")]
    for (pose, lag_s) in opencv::joint(sightings) {
        add(motion.carry(&pose, lag_s));
    }
    if let Some(&expected) = expected {
        add(expected);
    }
    starts.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut fits: Vec<PoseFit> = Vec::with_capacity(2);
    let mut tried: Vec<DQuat> = Vec::with_capacity(MAX_STARTS);
    for (_, start) in starts {
        // Initial poses in the same valley converge to the same minimum.
        if tried.iter().any(|seen| seen.angle_between(start.rotation) < SAME_START_RAD) {
            continue;
        }
        tried.push(start.rotation);
        if let Some(fit) = adjust::adjust(sightings, motion, start) {
            let turned = |known: &PoseFit| {
                known.world_from_body.rotation.angle_between(fit.world_from_body.rotation)
            };
            match fits.iter_mut().find(|known| turned(known) < SAME_ANSWER_RAD) {
                Some(known) if fit.cost < known.cost => *known = fit,
                Some(_) => {}
                None => fits.push(fit),
            }
        }
        if tried.len() == MAX_STARTS {
            break;
        }
    }
    fits.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let best = *fits.first()?;
    let other = fits.get(1).copied().filter(|fit| fit.cost - best.cost < AMBIGUOUS_COST);
    Some(Solved { best, other })
}

/// Returns the root mean square reprojection error of a tag's corners; infinite behind the camera. [px]
pub fn residual_px(
    sighting: &Sighting,
    motion: &VehicleTwist,
    world_from_body: &Pose<World, Body>,
) -> f64 {
    adjust::residual_px(sighting, motion, world_from_body)
}

/// Returns the possible poses from a single tag.
fn square(Sighting { camera, size_m, corners_px, .. }: &Sighting) -> Vec<Pose<Cam, Square>> {
    #[cfg(feature = "opencv")]
    {
        let found = opencv::square(camera, *size_m, corners_px);
        if !found.is_empty() {
            return found;
        }
    }
    plane::poses(camera, *size_m, corners_px)
}

fn world_from_body(sight: &Geometry, cam_from_tag: &Pose<Cam, Square>) -> Pose<World, Body> {
    match sight {
        Geometry::OutsideIn { world_from_cam, body_from_tag } => {
            *world_from_cam * *cam_from_tag * body_from_tag.inverse()
        }
        Geometry::InsideOut { body_from_cam, world_from_tag } => {
            *world_from_tag * cam_from_tag.inverse() * body_from_cam.inverse()
        }
    }
}

/// Minimum rotation between two minima of one square; closer ones are indistinguishable. [rad]
const SAME_ANSWER_RAD: f64 = 0.06;
/// Initial poses closer than this are treated as equal. [rad]
const SAME_START_RAD: f64 = 0.1;
/// Maximum number of initial poses; further ones come from misread or barely visible tags.
const MAX_STARTS: usize = 5;
/// Maximum cost difference (half the sum of squares in units of sigma) of an ambiguous second solution. By corner
/// noise, a larger one is at least e^12 times less likely; the margin covers errors of light, blur and print.
const AMBIGUOUS_COST: f64 = 12.0;

#[cfg(test)]
mod tests;
