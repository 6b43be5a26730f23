//! Generated twins with exactly known geometry: a forest, a race, and the netted room.
//!
//! [`generate`] plans a place from a seed as true solids ([`Volume`]), then lays flat Gaussians on
//! their surfaces with textures and baked light, so that pictures, rendered depth and truth agree
//! within centimetres. [`Generated::write`] stores `scene.ply`, `arena.toml` and `truth.json`. The
//! same seed gives the same bytes on every machine: all randomness is hashed integers, all
//! functions come from `libm`, and nothing depends on the order of threads.
//!
//! [`film_set`] also plans a [`walk`] through it, with boards for printed tags along it, and [`film`] makes of rendered
//! images what a phone would have filmed on this walk.
//!
//! Called once per scene by the command line; takes well under two seconds.

mod canvas;
mod draw;
pub mod film;
mod forest;
mod hall;
pub mod parts;
mod prints;
pub mod projects;
mod random;
mod solids;
mod staging;
mod variant;
pub mod walk;
mod write;

use core::fmt;
use core::str::FromStr;

use vizflyt_arena::ArenaConfig;
use vizflyt_protocol::geometry::Volume;
use vizflyt_splat::{RigidObject, Splats};

use parts::ScenePart;
use staging::Staging;

pub use draw::{DrawBounds, Weather};
pub use prints::Print;
pub use staging::{FilmSet, film_set};
pub use variant::{MAX_DRAWN, UnknownVariant, Variant, VariantChoice};
pub use write::{WriteError, Written};

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

/// Generates a scene; the same kind and seed give the same result on every machine.
///
/// ```
/// use vizflyt_scenes::{SceneKind, generate};
/// let forest = generate(SceneKind::Forest, 7);
/// assert!((50_000..150_000).contains(&forest.splats.len()));
/// // Nothing solid within 2 m of the place of take-off, but for the floor.
/// let start_m = forest.arena.spawn.position_m + glam::DVec3::Z * forest.arena.takeoff_height_m;
/// let clearance_m =
///     forest.truth.iter().map(|v| v.signed_distance_m(start_m)).fold(f64::MAX, f64::min);
/// assert!((clearance_m - 1.2).abs() < 1e-9);
/// ```
pub fn generate(kind: SceneKind, seed: u64) -> Generated {
    match kind {
        SceneKind::Forest => forest::build(seed),
        SceneKind::Race => hall::build_race(seed, &mut Staging::none()),
        SceneKind::Room => hall::build_room(seed, &mut Staging::none()),
        SceneKind::Moving => hall::build_moving(seed, &mut Staging::none()),
    }
}

#[cfg(test)]
mod tests;
