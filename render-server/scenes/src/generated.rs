//! Kinds of generated scenes, and their result.

use core::fmt;
use core::str::FromStr;

use vizflyt_arena::ArenaConfig;
use vizflyt_protocol::geometry::Volume;
use vizflyt_splat::{RigidObject, Splats};

use crate::parts::ScenePart;

/// Kind of a generated scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum SceneKind {
    /// 40 m of trees between start and goal.
    Forest,
    /// Three racing windows, a wall with a gap, and a window with a rotating hand, in the net.
    Race,
    /// The 11 x 4.5 x 3.65 m netted lab, empty.
    Room,
    /// The lab with a sliding door, a pendulum and a second drone.
    Moving,
}

impl SceneKind {
    /// All kinds.
    pub const ALL: [Self; 4] = [Self::Forest, Self::Race, Self::Room, Self::Moving];

    /// Returns the names of all kinds, for help and messages.
    pub fn names() -> String {
        Self::ALL.map(Self::name).join(", ")
    }

    /// Returns the name of the kind on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Forest => "forest",
            Self::Race => "race",
            Self::Room => "room",
            Self::Moving => "moving",
        }
    }
}

impl fmt::Display for SceneKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for SceneKind {
    type Err = UnknownScene;

    fn from_str(text: &str) -> Result<Self, UnknownScene> {
        Self::ALL
            .into_iter()
            .find(|kind| kind.name() == text)
            .ok_or_else(|| UnknownScene(text.to_owned()))
    }
}

/// Unknown name of a [`SceneKind`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no generated scene is called '{0}'; there are {all}", all = SceneKind::names())]
pub struct UnknownScene(pub String);

/// Generated place.
#[derive(Clone, Debug, PartialEq)]
pub struct Generated {
    /// Static splats, SH degree 0. [m, world]
    pub splats: Splats,
    /// Ranges of splats for each thing, in order, without overlaps.
    pub parts: Vec<ScenePart>,
    /// Room and rules; refers to the scene file that [`Self::write`] writes.
    pub arena: ArenaConfig,
    /// True obstacles, and the floor as a half space, without the fence. [m, world]
    pub truth: Vec<Volume>,
    /// Moving objects, in the order of `arena.objects`. [m, object]
    pub objects: Vec<RigidObject>,
    /// True solids of each moving object. [m, object]
    pub true_objects: Vec<Vec<Volume>>,
    /// Whether plugins may read the map. In this case, [`Self::write`] also stores `map.json`.
    pub map_is_known: bool,
}
