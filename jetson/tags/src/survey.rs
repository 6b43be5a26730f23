//! Survey: measured poses of tags and cameras.
//!
//! Glued sheets deviate by millimetres, and cameras are mounted by eye. [`mat`] estimates the pose of each tag from
//! images of one calibrated camera that is carried over the mat. The scale is that of the printed tags; the `world`
//! frame is that of the printed layout. [`cameras`] estimates the poses of fixed cameras from their images, by the
//! surveyed mat or by a cube that is carried through the view of several cameras.

mod cameras;
mod mat;
mod picker;

pub use cameras::{CameraImages, CubeScale, PlacedCamera, SurveyedCameras, cameras};
pub use mat::{Surveyed, TagResidual, mat};
pub use picker::Picker;

use glam::DVec2;
use vizflyt_protocol::geometry::{Body, Cam, Intrinsics, Pose, World};

use crate::family::TagFamily;
use crate::layout::Square;
use crate::solve::{Geometry, Sighting, Solved, VehicleTwist, solve};

/// Why a survey failed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SurveyError {
    /// Too few images or tags.
    #[error("{found} usable {what}, and {needed} are needed; {advice}")]
    TooFew {
        /// Counted items: images, tags.
        what: &'static str,
        found: usize,
        needed: usize,
        /// Correction.
        advice: &'static str,
    },
    /// The detected corners are inconsistent.
    #[error("corners are {rms_px:.2} px off, limit {most_px} px; {advice}")]
    Contradiction {
        /// Root mean square reprojection error. [px]
        rms_px: f64,
        /// Limit. [px]
        most_px: f64,
        /// Correction.
        advice: &'static str,
    },
    /// The tag that defines the origin was not surveyed.
    #[error("tag {family} {id} is not among those surveyed; choose one that the images show")]
    Anchor {
        family: TagFamily,
        /// Number in the family.
        id: u32,
    },
    /// No detected tag connects the camera to the room.
    #[error(
        "camera {name:?} sees neither the mat nor a cube that a placed camera sees at the same time; \
         lay the mat where it sees it, or carry the cube where both see it"
    )]
    Unplaced { name: String },
    /// The corners do not determine the answer.
    #[error("the images do not determine the answer; {advice}")]
    Undetermined {
        /// Correction.
        advice: &'static str,
    },
}

/// Returns the pose of a camera from detected tags of the room.
fn camera_pose(
    lens: &Intrinsics,
    tags: &[(Pose<World, Square>, f64, [DVec2; 4])],
) -> Option<(Pose<World, Cam>, Solved)> {
    // The solver estimates a vehicle's pose: the camera stands in for the vehicle.
    let sightings: Vec<Sighting> = tags
        .iter()
        .map(|&(world_from_tag, size_m, corners_px)| Sighting {
            camera: lens,
            sight: Geometry::InsideOut { body_from_cam: Pose::IDENTITY, world_from_tag },
            size_m,
            corners_px,
            sigma_px: SIGMA_PX,
            lag_s: 0.0,
            readout_s: 0.0,
        })
        .collect();
    let solved = solve(&sightings, &VehicleTwist::default(), None)?;
    let body = solved.best.world_from_body;
    Some((Pose::new(body.translation_m, body.rotation), solved))
}

/// A tag of the cube, detected by a camera in the room: lens and pose of the camera, pose and size of the tag, and its
/// corners.
type OnCube<'a> = (&'a Intrinsics, Pose<World, Cam>, Pose<Body, Square>, f64, [DVec2; 4]);

/// Returns the pose of a cube from tags that cameras in the room detect.
fn cube_pose(seen: &[OnCube<'_>]) -> Option<Solved> {
    let sightings: Vec<Sighting> = seen
        .iter()
        .map(|&(camera, world_from_cam, body_from_tag, size_m, corners_px)| Sighting {
            camera,
            sight: Geometry::OutsideIn { world_from_cam, body_from_tag },
            size_m,
            corners_px,
            sigma_px: SIGMA_PX,
            lag_s: 0.0,
            readout_s: 0.0,
        })
        .collect();
    solve(&sightings, &VehicleTwist::default(), None)
}

/// Standard deviation of corners in images of a still camera. [px]
const SIGMA_PX: f64 = 0.3;
/// Distance at which a corner has half the weight. [px]
const LOSS_PX: f64 = 1.5;
/// Maximum share of corners beyond [`LOSS_PX`]. Calibrated lenses leave 0.1 to 0.4 px, so only misread tags exceed it.
/// A wrong camera file produces many outliers.
const MAX_OUTLIERS: f64 = 0.1;

#[cfg(test)]
mod tests;
