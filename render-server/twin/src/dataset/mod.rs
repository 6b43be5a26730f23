//! Photos with poses, and points: what training starts from.

use glam::Vec3;

use crate::loss::Target;
use crate::view::View;

/// A capture whose poses are known. All lengths are in units of the dataset, in its own frame.
#[derive(Clone, Debug, Default)]
pub struct Dataset {
    /// At least one, in the order of their names.
    pub photos: Vec<Photo>,
    /// Points of structure from motion; may be none.
    pub points: Vec<Point>,
}

/// A photo, undistorted.
#[derive(Clone, Debug)]
pub struct Photo {
    /// The file's name within the dataset.
    pub name: String,
    /// Where it was taken from.
    pub view: View,
    /// What it shows.
    pub target: Target,
}

/// A point of structure from motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Where it is.
    pub position: Vec3,
    /// sRGB.
    pub rgb: [u8; 3],
}

impl Dataset {
    /// Returns the greatest distance of a camera from their middle, and a tenth more: by it trainers
    /// scale what has a length. 1 where all cameras are in one place.
    pub fn extent(&self) -> f32 {
        let positions = || self.photos.iter().map(|photo| photo.view.position);
        let middle = positions().sum::<Vec3>() / self.photos.len().max(1) as f32;
        let reach = positions().map(|p| p.distance(middle)).fold(0.0, f32::max) * 1.1;
        if reach > 1e-6 { reach } else { 1.0 }
    }
}
