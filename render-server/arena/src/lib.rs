//! Rules of the room, pure: text and poses in, events and distances out. The crate opens no sockets or files,
//! reads no clock, and starts no threads (the baker uses rayon's).
//!
//! Read in this order:
//! - [`config`]: `arena.toml` as validated types, and the runtime's view of the arena;
//! - [`seen`]: space that a capture has seen to be free;
//! - [`occupancy`], [`distance`]: splats baked into voxels, and the distance to them;
//! - [`objects`]: poses of moving objects at any instant;
//! - [`obstacles`], [`neighbours`]: obstacles: fixed, moving, other vehicles;
//! - [`pose`]: pose filter: accepts measurements and estimates the twist;
//! - [`body`], [`collision`], [`fence`], [`course`]: one rule each;
//! - [`check`]: check that a course can be flown;
//! - [`referee`]: all rules for one vehicle, as one state machine;
//! - [`verdict`]: result of a flight, from its events and samples;
//! - [`points`]: points for the figures over all flights;
//! - [`crash`]: probable cause of a failed flight, and drawings.

pub mod body;
pub mod check;
pub mod collision;
pub mod config;
pub mod course;
pub mod crash;
pub mod distance;
pub mod fence;
pub mod grid;
pub mod neighbours;
pub mod objects;
pub mod obstacles;
pub mod occupancy;
pub mod points;
pub mod pose;
pub mod referee;
pub mod seen;
pub mod verdict;

pub use body::BodyShape;
pub use config::{ArenaConfig, ConfigError};
pub use distance::{DistanceField, ObstacleSlice};
pub use objects::MovingObjects;
pub use obstacles::Obstacles;
pub use occupancy::{BakeSpec, Ellipsoid, OccupancyGrid};
pub use referee::Referee;
pub use seen::SeenSpace;
