//! Input of a renderer: the twin, and the rigid objects that move in it.

use vizflyt_protocol::geometry::{Object, Pose, World};

use crate::Splats;

/// Twin and moving objects. Borrowed, because every renderer packs its own copy.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// Static part. [m, world]
    pub splats: &'a Splats,
    /// Moving objects; placements have the same order.
    pub objects: &'a [RigidObject],
}

impl<'a> From<&'a Splats> for Scene<'a> {
    fn from(splats: &'a Splats) -> Self {
        Self { splats, objects: &[] }
    }
}

/// Rigid part of a scene with its own pose: a door, the hand of a clock, another vehicle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RigidObject {
    /// Value in [`crate::RgbdImage::ids`] where the object is visible; 0 is the static part.
    pub id: u16,
    /// Splats of the object. [m, object]
    pub splats: Splats,
}

/// Pose of an object while an image is rendered; `None` if the object is absent.
pub type Placement = Option<Pose<World, Object>>;
