//! Where tags and cameras really are.
//!
//! Glued sheets are off by millimetres, cameras are screwed on somewhere. From images of one calibrated
//! camera carried over a mat, [`mat`] finds where each tag lies: the scale is that of the printed tags,
//! the `world` frame that of the layout they were printed by. From images of fixed cameras,
//! [`cameras`] finds where each camera is: by the surveyed mat, or by a cube that is carried where
//! several see it.

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

/// Why nothing was surveyed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SurveyError {
    /// Not enough was seen.
    #[error("{found} usable {what}, and {needed} are needed; {advice}")]
    TooFew {
        /// Images, tags.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many there must be.
        needed: usize,
        /// What to do.
        advice: &'static str,
    },
    /// What was seen contradicts itself.
    #[error("corners are {rms_px:.2} px off where {most_px} px is much; {advice}")]
    Contradiction {
        /// Root mean square. [px]
        rms_px: f64,
        /// What is allowed. [px]
        most_px: f64,
        /// What to do.
        advice: &'static str,
    },
    /// A tag that is to be the origin was not surveyed.
    #[error("tag {family} {id} is not among those surveyed; choose one that the images show")]
    Anchor {
        /// Its family.
        family: TagFamily,
        /// Its number.
        id: u32,
    },
    /// Nothing ties a camera to the room.
    #[error(
        "camera {name:?} sees neither the mat nor a cube that a placed camera sees at the same time; \
         lay the mat where it sees it, or carry the cube where both see it"
    )]
    Unplaced {
        /// Which camera.
        name: String,
    },
    /// The corners do not determine the answer.
    #[error("the images do not determine the answer; {advice}")]
    Undetermined {
        /// What to do.
        advice: &'static str,
    },
}

/// Returns the pose of a camera that sees these tags of the room.
fn camera_pose(
    lens: &Intrinsics,
    tags: &[(Pose<World, Square>, f64, [DVec2; 4])],
) -> Option<(Pose<World, Cam>, Solved)> {
    // A vehicle that is the camera.
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

/// A cube's tag in the image of a camera in the room: its lens and pose, the tag's pose and size, and
/// its corners.
type OnCube<'a> = (&'a Intrinsics, Pose<World, Cam>, Pose<Body, Square>, f64, [DVec2; 4]);

/// Returns the pose of a cube of which cameras in the room see tags.
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

/// Corners of a still camera are within a fraction of a pixel. [px]
const SIGMA_PX: f64 = 0.3;
/// Corners count half at this distance. [px]
const LOSS_PX: f64 = 1.5;
/// Calibrated lenses leave 0.1 to 0.4 px, and hardly a corner beyond [`LOSS_PX`] but those of misread
/// tags; a wrong camera file leaves many.
const MAX_OUTLIERS: f64 = 0.1;

#[cfg(test)]
mod tests;
