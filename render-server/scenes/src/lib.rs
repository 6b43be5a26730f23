//! Generated twins with exactly known geometry: a forest, a race, and the netted room.
//!
//! [`generate`] plans a place from a seed as true solids ([`Volume`]). It then covers their surfaces with flat
//! Gaussians with textures and baked light, so that images, rendered depth and truth agree within centimetres.
//! [`Generated::write`] stores `scene.ply`, `arena.toml` and `truth.json`. The same seed gives the same bytes on every
//! machine: random numbers are hashed integers, all functions come from `libm`, and no result depends on the order of
//! threads.
//!
//! [`film_set`] also plans a [`walk`] through the scene, with boards for printed tags along it. [`film`] converts
//! rendered images into the video that a phone would record on this walk.
//!
//! The command line calls it once per scene; it takes less than two seconds.

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
/// // Within 2 m of the takeoff, only the floor is solid.
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
