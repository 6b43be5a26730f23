//! The rules of the room, pure: text and poses in, events and distances out. No sockets, files,
//! clock or threads of its own (the baker borrows rayon's).
//!
//! Read in this order:
//! - [`config`]: `arena.toml` as validated types; also what the runtime is told of the arena;
//! - [`occupancy`], [`distance`]: splats baked into voxels, and the distance to them;
//! - [`pose`]: which measurements are believed, and the twist;
//! - [`collision`], [`fence`], [`course`]: one rule each;
//! - [`referee`]: all of it for one vehicle, as one state machine.

pub mod collision;
pub mod config;
pub mod course;
pub mod distance;
pub mod fence;
pub mod grid;
pub mod occupancy;
pub mod pose;
pub mod referee;

pub use config::{ArenaConfig, ConfigError};
pub use distance::{DistanceField, ObstacleSlice};
pub use occupancy::{BakeSpec, Ellipsoid, OccupancyGrid};
pub use referee::Referee;
