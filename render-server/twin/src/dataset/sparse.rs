//! What structure from motion leaves, whichever program wrote it.

use std::collections::HashMap;

use glam::{DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

/// Cameras, poses and points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SparseModel {
    /// In the order of the file.
    pub images: Vec<SparseImage>,
    /// By their ids.
    pub points: HashMap<u64, SparsePoint>,
}

/// An image that was placed.
#[derive(Clone, Debug, PartialEq)]
pub struct SparseImage {
    /// Its name below the folder of images.
    pub name: String,
    /// Its lens, distortion and all.
    pub intrinsics: Intrinsics,
    /// Where it was taken from. [units of the dataset]
    pub world_from_cam: Pose<World, Cam>,
    /// The points that it saw.
    pub seen: Vec<SparseSighting>,
}

/// A point that was found in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SparseSighting {
    /// The point's id.
    pub point: u64,
    /// Where in the image. [px]
    pub pixel: DVec2,
}

/// A point that images saw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SparsePoint {
    /// Where it is. [units of the dataset]
    pub position: DVec3,
    /// sRGB.
    pub rgb: [u8; 3],
    /// How many images saw it.
    pub track: usize,
}

/// Returns `world_from_cam` of COLMAP's rotation (w, x, y, z) and translation of `cam_from_world`;
/// `None` if that is no pose.
pub(super) fn pose([w, x, y, z]: [f64; 4], translation: [f64; 3]) -> Option<Pose<World, Cam>> {
    let q = DQuat::from_xyzw(x, y, z, w);
    let t = DVec3::from_array(translation);
    let right = (0.5..2.0).contains(&q.length()) && t.is_finite() && t.length() < 1e7;
    right.then(|| Pose::<Cam, World>::new(t, q.normalize()).inverse())
}
