//! Result of a set of images.

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::HostTime;

use crate::detect::Region;
use crate::detection::Detection;

/// Estimated pose of the vehicle.
#[derive(Clone, Copy, Debug)]
pub struct Located {
    /// Time of the pose.
    pub stamp: HostTime,
    pub world_from_body: Pose<World, Body>,
    /// Standard deviation of the position. [m, world]
    pub position_sigma_m: DVec3,
    /// Standard deviation of the attitude, about the vehicle's axes. [rad, body]
    pub rotation_sigma_rad: DVec3,
    /// Covariance of both, position first, without the floors. [m, world; rad, body]
    pub covariance: [[f64; 6]; 6],
    /// Number of tags used; a tag in two cameras counts twice.
    pub tags: usize,
    /// Number of cameras used.
    pub cameras: usize,
    /// Root mean square reprojection error. [px]
    pub rms_px: f64,
}

/// Why a pose is not available.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Unlocated {
    /// No tag of a layout is in the images.
    NoTag,
    /// The solver found no pose for the tags.
    NoPose,
    /// The best pose has too large a root mean square reprojection error. [px]
    Residuals(f64),
    /// A single tag with two possible poses; more images will decide.
    Ambiguous,
    /// The images are older than earlier ones.
    Old,
}

/// Detections of one camera.
#[derive(Clone, Debug)]
pub struct CameraResult {
    /// Index of the camera.
    pub camera: usize,
    /// Stamp of the image.
    pub stamp: HostTime,
    /// Searched region; `None` for the whole image.
    pub region: Option<Region>,
    /// Whether the predicted pose puts all tags outside the image.
    pub out_of_view: bool,
    /// Tags of the layouts.
    pub seen: Vec<TagObservation>,
    /// Tags in no layout, or in one that this camera cannot use.
    pub strangers: Vec<Detection>,
}

/// A tag of a layout in an image.
#[derive(Clone, Copy, Debug)]
pub struct TagObservation {
    pub detection: Detection,
    /// Corners projected from the estimated pose; `None` without a pose. [px]
    pub expected_px: Option<[DVec2; 4]>,
}

/// Result of a set of images.
#[derive(Clone, Debug)]
pub struct LocateOutcome {
    /// The pose, or the reason why it is not available.
    pub located: Result<Located, Unlocated>,
    /// Detections of each camera.
    pub looks: Vec<CameraResult>,
}
