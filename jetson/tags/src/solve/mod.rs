//! The vehicle's pose from all tags in all cameras at once.
//!
//! What enters: corners in pixels, each with the point of the layout it belongs to and the camera that
//! saw it. What leaves: `world_from_body`, its covariance, and, where the corners leave two answers open,
//! both. Called once per set of images; some 50 us for two cameras with three tags each.
//!
//! - [`plane`]: the two poses that one square can have, in closed form: where to begin;
//! - [`adjust`]: Levenberg-Marquardt over the reprojection error of all corners with a robust loss, and
//!   the covariance from its Jacobian;
//! - `opencv`: the same starts by OpenCV's IPPE, and one more of all tags in an image by its SQPnP, where the feature of
//!   that name is on.
//!
//! A square far away looks nearly the same when it is tilted towards the camera and away from it: the
//! reprojection error then has two minima. A second face of the cube, a second tag of the mat or a
//! second camera decides; where there is none, [`Solved::other`] keeps the second one.

mod adjust;
#[cfg(feature = "opencv")]
mod opencv;
mod plane;

pub use adjust::PoseFit;
pub(crate) use adjust::{CornerRow, corner_rows, invert6};

use glam::{DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Body, Cam, Intrinsics, Pose, World};

use crate::layout::Square;

/// How camera and tag relate to the unknown pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Geometry {
    /// A camera fixed in the room sees a tag on the vehicle.
    OutsideIn {
        /// Where the camera is.
        world_from_cam: Pose<World, Cam>,
        /// Where the tag is.
        body_from_tag: Pose<Body, Square>,
    },
    /// A camera on the vehicle sees a tag in the room.
    InsideOut {
        /// Where the camera is.
        body_from_cam: Pose<Body, Cam>,
        /// Where the tag is.
        world_from_tag: Pose<World, Square>,
    },
}

/// One tag seen by one camera.
#[derive(Clone, Copy, Debug)]
pub struct Sighting<'a> {
    /// The camera's lens.
    pub camera: &'a Intrinsics,
    /// Camera and tag.
    pub sight: Geometry,
    /// Edge of the tag's square. [m]
    pub size_m: f64,
    /// Its corners, in the layout's order. [px]
    pub corners_px: [DVec2; 4],
    /// How far a corner may be off, one standard deviation along x or y. [px]
    pub sigma_px: f64,
    /// How much later the pose is asked for than the image's middle row was exposed. [s]
    pub lag_s: f64,
    /// From the exposure of the image's first row to that of its last. [s]
    pub readout_s: f64,
}

impl Sighting<'_> {
    /// Returns how much later the pose is asked for than a row of the image was exposed. [s]
    pub(crate) fn lag_at_s(&self, row_px: f64) -> f64 {
        self.lag_s - self.readout_s * self.row_share(row_px)
    }

    /// Returns where a row is in the image: -0.5 is the first, 0.5 the last.
    pub(crate) fn row_share(&self, row_px: f64) -> f64 {
        row_px / f64::from(self.camera.height_px) - 0.5
    }

    fn middle_lag_s(&self) -> f64 {
        self.lag_at_s(0.5 * (self.corners_px[0].y + self.corners_px[2].y))
    }
}

/// How the vehicle moves, to relate images that were not exposed together.
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
    /// Returns where a vehicle is `dt_s` later; earlier where that is negative.
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

/// The answer, and the second one where there is one.
#[derive(Clone, Copy, Debug)]
pub struct Solved {
    /// The pose that explains the corners best.
    pub best: PoseFit,
    /// Another minimum, turned by more than a few degrees, that explains them nearly as well:
    /// corners alone do not decide.
    pub other: Option<PoseFit>,
}

/// Returns the pose from all sightings; `None` where no start leads to one.
///
/// `expected` is where the vehicle should be by its last motion: one more start.
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
        // Starts in the same valley end in the same place.
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

/// Returns the root mean square distance of a tag's corners from where a pose puts them; infinite behind the
/// camera. [px]
pub fn residual_px(
    sighting: &Sighting,
    motion: &VehicleTwist,
    world_from_body: &Pose<World, Body>,
) -> f64 {
    adjust::residual_px(sighting, motion, world_from_body)
}

/// Returns the poses that one tag alone can have.
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

/// Two valleys of one square lie further apart than this, or cannot be distinguished at all. [rad]
const SAME_ANSWER_RAD: f64 = 0.06;
/// Starts closer together than this are one. [rad]
const SAME_START_RAD: f64 = 0.1;
/// More starts come from tags that are misread or hardly seen.
const MAX_STARTS: usize = 5;
/// A second answer whose cost (half the sum of squares in units of sigma) is greater by this is e^12 times less likely
/// by the corners' noise; what light, blur and print add is covered by the rest.
const AMBIGUOUS_COST: f64 = 12.0;

#[cfg(test)]
mod tests;
