//! Result of structure from motion, in a form independent of the program.

use std::collections::HashMap;

use glam::{DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

/// Cameras, poses and points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SparseModel {
    /// Images in the order of the file.
    pub images: Vec<SparseImage>,
    /// Points by id.
    pub points: HashMap<u64, SparsePoint>,
}

/// An image with a pose.
#[derive(Clone, Debug, PartialEq)]
pub struct SparseImage {
    /// Name, relative to the folder of images.
    pub name: String,
    /// Camera with its distortion.
    pub intrinsics: Intrinsics,
    /// Camera pose. [units of the dataset]
    pub world_from_cam: Pose<World, Cam>,
    /// Observed points.
    pub seen: Vec<SparseSighting>,
}

/// Observation of a point in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SparseSighting {
    pub point: u64,
    /// Position in the image. [px]
    pub pixel: DVec2,
}

/// A reconstructed point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SparsePoint {
    /// Position. [units of the dataset]
    pub position: DVec3,
    /// sRGB.
    pub rgb: [u8; 3],
    /// Number of images that see the point.
    pub track: usize,
}

/// Returns `world_from_cam` from COLMAP's rotation (w, x, y, z) and translation of `cam_from_world`; `None` if they are
/// not a valid pose.
pub(super) fn pose([w, x, y, z]: [f64; 4], translation: [f64; 3]) -> Option<Pose<World, Cam>> {
    let q = DQuat::from_xyzw(x, y, z, w);
    let t = DVec3::from_array(translation);
    let right = (0.5..2.0).contains(&q.length()) && t.is_finite() && t.length() < 1e7;
    right.then(|| Pose::<Cam, World>::new(t, q.normalize()).inverse())
}
