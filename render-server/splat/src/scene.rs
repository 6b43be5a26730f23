//! What a renderer is given once: the twin, and the rigid objects that move in it.

use vizflyt_protocol::geometry::{Object, Pose, World};

use crate::Splats;

/// A twin and what moves in it; borrowed, because every renderer packs its own copy.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// What stands still. [m, world]
    pub splats: &'a Splats,
    /// What moves; placed again for every image, in this order.
    pub objects: &'a [RigidObject],
}

impl<'a> From<&'a Splats> for Scene<'a> {
    fn from(splats: &'a Splats) -> Self {
        Self { splats, objects: &[] }
    }
}

/// A rigid part of a scene with a pose of its own: a door, a clock's hand, another vehicle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RigidObject {
    /// What [`crate::RgbdImage::ids`] holds where it is seen; 0 is what stands still.
    pub id: u16,
    /// Its splats. [m, object]
    pub splats: Splats,
}

/// Where an object is while an image is rendered; `None` where it is not there at all.
pub type Placement = Option<Pose<World, Object>>;
