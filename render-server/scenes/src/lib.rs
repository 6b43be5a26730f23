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
mod generated;
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

use staging::Staging;

pub use draw::{DrawBounds, Weather};
pub use generated::{Generated, SceneKind, UnknownScene};
pub use prints::Print;
pub use staging::{FilmSet, film_set};
pub use variant::{MAX_DRAWN, UnknownVariant, Variant, VariantChoice};
pub use write::{WriteError, Written};

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
