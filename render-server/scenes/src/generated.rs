//! What can be generated, and what comes of it.

use core::fmt;
use core::str::FromStr;

use vizflyt_arena::ArenaConfig;
use vizflyt_protocol::geometry::Volume;
use vizflyt_splat::{RigidObject, Splats};

use crate::parts::ScenePart;

/// What can be generated.
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
    /// Every kind.
    pub const ALL: [Self; 4] = [Self::Forest, Self::Race, Self::Room, Self::Moving];

    /// Returns the names of all, as help and messages list them.
    pub fn names() -> String {
        Self::ALL.map(Self::name).join(", ")
    }

    /// Returns the kind's name as the command line takes it.
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

/// A name that is no [`SceneKind`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no generated scene is called '{0}'; there are {all}", all = SceneKind::names())]
pub struct UnknownScene(pub String);

/// A generated place.
#[derive(Clone, Debug, PartialEq)]
pub struct Generated {
    /// What cameras see, SH degree 0. [m, world]
    pub splats: Splats,
    /// Which of the splats are of which thing; in the order of their splats, which no two share.
    pub parts: Vec<ScenePart>,
    /// The room and its rules; names the scene file that [`Self::write`] makes.
    pub arena: ArenaConfig,
    /// The true obstacles, and the floor as a half space; not the fence. [m, world]
    pub truth: Vec<Volume>,
    /// What moves, in the order of `arena.objects`. [m, object]
    pub objects: Vec<RigidObject>,
    /// The true solids of each object. [m, object]
    pub true_objects: Vec<Vec<Volume>>,
    /// Whether plugins may read the map: then [`Self::write`] stores `map.json` too.
    pub map_is_known: bool,
}
