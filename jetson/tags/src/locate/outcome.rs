//! What comes of a set of images.

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::HostTime;

use crate::detect::Region;
use crate::detection::Detection;

/// The vehicle's pose.
#[derive(Clone, Copy, Debug)]
pub struct Located {
    /// When it was there.
    pub stamp: HostTime,
    /// Where.
    pub world_from_body: Pose<World, Body>,
    /// Standard deviation of the position. [m, world]
    pub position_sigma_m: DVec3,
    /// Standard deviation of the attitude, about the vehicle's axes. [rad, body]
    pub rotation_sigma_rad: DVec3,
    /// Covariance of both, position first, without the floors. [m, world; rad, body]
    pub covariance: [[f64; 6]; 6],
    /// How many tags it rests on; one in two cameras counts twice.
    pub tags: usize,
    /// In how many cameras.
    pub cameras: usize,
    /// Root mean square distance of corners from where the pose puts them. [px]
    pub rms_px: f64,
}

/// Why there is no pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Unlocated {
    /// No tag of a layout is in the images.
    NoTag,
    /// Tags do not lead to any pose.
    NoPose,
    /// Corners lie too far from where the best pose puts them, root mean square. [px]
    Residuals(f64),
    /// One tag, and two poses that explain it: more images will decide.
    Ambiguous,
    /// The images are older than those before.
    Old,
}

/// What one camera saw.
#[derive(Clone, Debug)]
pub struct CameraResult {
    /// Index of the camera.
    pub camera: usize,
    /// When.
    pub stamp: HostTime,
    /// Where it was looked; the whole image if nothing.
    pub region: Option<Region>,
    /// Whether no tag should be in its image, by where the vehicle should be.
    pub out_of_view: bool,
    /// Tags of the layouts.
    pub seen: Vec<TagObservation>,
    /// Tags of no layout, or of one that this camera cannot use.
    pub strangers: Vec<Detection>,
}

/// A tag of a layout in an image.
#[derive(Clone, Copy, Debug)]
pub struct TagObservation {
    /// The tag.
    pub detection: Detection,
    /// Where the pose puts its corners; absent without one. [px]
    pub expected_px: Option<[DVec2; 4]>,
}

/// What came of a set of images.
#[derive(Clone, Debug)]
pub struct LocateOutcome {
    /// The pose, or why there is none.
    pub located: Result<Located, Unlocated>,
    /// What each camera saw.
    pub looks: Vec<CameraResult>,
}
