//! The rules of the room, pure: text and poses in, events and distances out. No sockets, files,
//! clock or threads of its own (the baker borrows rayon's).
//!
//! Read in this order:
//! - [`config`]: `arena.toml` as validated types; also what the runtime gets of the arena;
//! - [`seen`]: space that a capture has seen to be free;
//! - [`occupancy`], [`distance`]: splats baked into voxels, and the distance to them;
//! - [`objects`]: where what moves by itself is at any instant;
//! - [`obstacles`], [`neighbours`]: what must not be touched: still, moving, other vehicles;
//! - [`pose`]: which measurements are accepted, and the twist;
//! - [`body`], [`collision`], [`fence`], [`course`]: one rule each;
//! - [`check`]: whether a course can be flown at all;
//! - [`referee`]: all of it for one vehicle, as one state machine;
//! - [`verdict`]: what a flight was worth, by all that happened in it;
//! - [`points`]: what the figures over all flights are worth;
//! - [`crash`]: why one failed, in words and drawings.

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
