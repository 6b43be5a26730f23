//! What a bundle adjustment starts from: images that structure from motion has placed, and what is known of the room.

use std::collections::{BTreeMap, HashMap};

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

use crate::dataset::SparseModel;

/// Images, points and tags. Places are in the frame of structure from motion, of any size and turn: `scene`.
#[derive(Clone, Debug, PartialEq)]
pub struct Capture {
    /// The lens of all images.
    pub lens: Intrinsics,
    /// Placed images, in the order of time.
    pub images: Vec<Image>,
    /// What they saw. [scene]
    pub points: Vec<DVec3>,
    /// Printed tags that stood in the room.
    pub tags: Vec<Tag>,
    /// Where the point that [`Place`] tells of sits beside the lens. [m, cam]
    pub tracked_in_cam_m: DVec3,
}

/// An image that was placed.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Its file's name.
    pub name: String,
    /// When it was taken, from the start of the video. [s]
    pub at_s: f64,
    /// Where from. [scene]
    pub scene_from_cam: Pose<World, Cam>,
    /// Points that were found in it.
    pub seen: Vec<Sighting>,
    /// Tags that were found in it.
    pub tags: Vec<TagSighting>,
    /// Where the tracked point was, if something else followed it.
    pub place: Option<Place>,
    /// Which way is up, if something else knows it.
    pub up: Option<Up>,
}

/// A point that was found in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Which of [`Capture::points`].
    pub point: usize,
    /// Where. [px]
    pub pixel: DVec2,
}

/// A tag that was found in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TagSighting {
    /// Which of [`Capture::tags`].
    pub tag: usize,
    /// Lower left, lower right, upper right, upper left. [px]
    pub corners_px: [DVec2; 4],
}

/// A printed tag.
#[derive(Clone, Debug, PartialEq)]
pub struct Tag {
    /// For people, as "tag36h11 7".
    pub name: String,
    /// Edge of the outer black square. [m]
    pub size_m: f64,
    /// Where its corners are, in the order of sightings, if that was measured. [m, world]
    pub corners_m: Option<[DVec3; 4]>,
}

/// A measured place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// Where. [m, world]
    pub position_m: DVec3,
    /// How well that is known along each axis, one sigma. [m]
    pub sigma_m: f64,
}

/// A measured vertical.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Up {
    /// Of unit length. [cam]
    pub direction: DVec3,
    /// One sigma. [rad]
    pub sigma_rad: f64,
}

/// Why a model is no capture.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CaptureError {
    /// Each image, or some, with a lens of its own.
    #[error(
        "{first} and {other} have lenses of their own; film with one camera at one zoom, and let structure from \
         motion share one lens among all images"
    )]
    ManyLenses {
        /// An image.
        first: String,
        /// One that differs.
        other: String,
    },
    /// Nothing was placed.
    #[error("no image was placed; film slowly, with much in view that has texture")]
    Empty,
}

impl Capture {
    /// Makes a capture of a model; `at_s` tells when an image was taken, by its name, and may put them into another
    /// order. No tags, no places.
    ///
    /// # Errors
    /// More than one lens, or no image.
    pub fn new(model: &SparseModel, at_s: impl Fn(&str) -> f64) -> Result<Self, CaptureError> {
        let first = model.images.first().ok_or(CaptureError::Empty)?;
        let alike = |image: &&crate::dataset::SparseImage| image.intrinsics != first.intrinsics;
        if let Some(other) = model.images.iter().find(alike) {
            let (first, other) = (first.name.clone(), other.name.clone());
            return Err(CaptureError::ManyLenses { first, other });
        }
        // In the order of their ids: a map has none that is the same twice.
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

/// Corners of a tag of edge 1: x to the right and y up as its reader sees it.
const SQUARE: [DVec2; 4] =
    [DVec2::new(-0.5, -0.5), DVec2::new(0.5, -0.5), DVec2::new(0.5, 0.5), DVec2::new(-0.5, 0.5)];
