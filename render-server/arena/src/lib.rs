//! The rules of the room, pure: text and poses in, events and distances out. No sockets, files,
//! clock or threads of its own (the baker borrows rayon's).
//!
//! Read in this order:
//! - [`config`]: `arena.toml` as validated types; also what the runtime is told of the arena.

// Why: guards are stated positively, so that NaN fails them (`if !(depth_m >= near_m)`).
#![allow(clippy::neg_cmp_op_on_partial_ord)]

pub mod config;

pub use config::{ArenaConfig, ConfigError};
