//! Input of a bundle adjustment: images placed by structure from motion, and other measurements of the room.

use std::collections::{BTreeMap, HashMap};

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

use crate::dataset::SparseModel;

/// Images, points and tags. Positions are in the frame of structure from motion (`scene`), with arbitrary scale and
/// rotation.
#[derive(Clone, Debug, PartialEq)]
pub struct Capture {
    /// Common lens of all images.
    pub lens: Intrinsics,
    /// Images with poses, in the order of time.
    pub images: Vec<Image>,
    /// Points seen in the images. [scene]
    pub points: Vec<DVec3>,
    /// Printed tags in the room.
    pub tags: Vec<Tag>,
    /// Position of the point that [`Place`] measures, relative to the lens. [m, cam]
    pub tracked_in_cam_m: DVec3,
}

/// An image with a pose.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// File name.
    pub name: String,
    /// Time from the start of the video. [s]
    pub at_s: f64,
    /// Camera pose. [scene]
    pub scene_from_cam: Pose<World, Cam>,
    /// Points detected in the image.
    pub seen: Vec<Sighting>,
    /// Tags detected in the image.
    pub tags: Vec<TagSighting>,
    /// Measured position of the tracked point, if available.
    pub place: Option<Place>,
    /// Measured vertical, if available.
    pub up: Option<Up>,
}

/// Observation of a point in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Index in [`Capture::points`].
    pub point: usize,
    /// Position in the image. [px]
    pub pixel: DVec2,
}

/// Observation of a tag in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TagSighting {
    /// Index in [`Capture::tags`].
    pub tag: usize,
    /// Corners of the tag as printed: lower left, lower right, upper right, upper left. [px]
    pub corners_px: [DVec2; 4],
}

/// A printed tag.
#[derive(Clone, Debug, PartialEq)]
pub struct Tag {
    /// Display name, for example "tag36h11 7".
    pub name: String,
    /// Edge of the outer black square. [m]
    pub size_m: f64,
    /// Measured corners, in the order of sightings, if available. [m, world]
    pub corners_m: Option<[DVec3; 4]>,
}

/// A measured position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    pub position_m: DVec3,
    /// Standard deviation along each axis. [m]
    pub sigma_m: f64,
}

/// A measured vertical.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Up {
    /// Upward direction, of unit length. [cam]
    pub direction: DVec3,
    /// Standard deviation. [rad]
    pub sigma_rad: f64,
}

/// Why a model cannot be used as a capture.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CaptureError {
    /// Images have different lenses.
    #[error(
        "{first} and {other} have different lenses; film with one camera at one zoom, and let structure from \
         motion share one lens among all images"
    )]
    ManyLenses {
        /// Name of an image.
        first: String,
        /// Name of an image with another lens.
        other: String,
    },
    /// The model has no images.
    #[error("no image was placed; film slowly, with much in view that has texture")]
    Empty,
}

impl Capture {
    /// Creates a capture from a model, without tags and measured positions. `at_s` returns the time of an image by its
    /// name; images are sorted by it.
    ///
    /// # Errors
    /// Different lenses, or no images.
    pub fn new(model: &SparseModel, at_s: impl Fn(&str) -> f64) -> Result<Self, CaptureError> {
        let first = model.images.first().ok_or(CaptureError::Empty)?;
        let alike = |image: &&crate::dataset::SparseImage| image.intrinsics != first.intrinsics;
        if let Some(other) = model.images.iter().find(alike) {
            let (first, other) = (first.name.clone(), other.name.clone());
            return Err(CaptureError::ManyLenses { first, other });
        }
        // Sorted by id, because the order of a hash map is not reproducible.
        let points: BTreeMap<u64, DVec3> =
            model.points.iter().map(|(&id, point)| (id, point.position)).collect();
        let number: HashMap<u64, usize> =
            points.keys().enumerate().map(|(number, &id)| (id, number)).collect();
        let mut images: Vec<Image> = model
            .images
            .iter()
            .map(|image| {
                let find = |seen: &crate::dataset::SparseSighting| {
                    let point = *number.get(&seen.point)?;
                    Some(Sighting { point, pixel: seen.pixel })
                };
                Image {
                    name: image.name.clone(),
                    at_s: at_s(&image.name),
                    scene_from_cam: image.world_from_cam,
                    seen: image.seen.iter().filter_map(find).collect(),
                    tags: Vec::new(),
                    place: None,
                    up: None,
                }
            })
            .collect();
        images.sort_by(|a, b| a.at_s.total_cmp(&b.at_s).then_with(|| a.name.cmp(&b.name)));
        Ok(Self {
            lens: first.intrinsics,
            images,
            points: points.into_values().collect(),
            tags: Vec::new(),
            tracked_in_cam_m: DVec3::ZERO,
        })
    }

    /// Returns the corners of a tag in its own frame, in the order of sightings. [m]
    pub(crate) fn square_m(&self, tag: usize) -> [DVec3; 4] {
        SQUARE.map(|corner| (corner * self.tags[tag].size_m).extend(0.0))
    }
}

/// Corners of a tag with edge length 1: x right and y up for its reader.
const SQUARE: [DVec2; 4] =
    [DVec2::new(-0.5, -0.5), DVec2::new(0.5, -0.5), DVec2::new(0.5, 0.5), DVec2::new(-0.5, 0.5)];
