//! Work on files: scenes, arenas, courses, data sets, trajectories, logs. Nothing here flies.
//!
//! ```text
//! scene      vizflyt scene: generate, capture, train, align, edit, carve, convert, bake, inspect, pack, render, view
//! arena      vizflyt arena: make a room for a captured scene, set up its course, check it
//! stage      what a simulated lab flies in: a generated scene on disk (kept for the next start), or the one at a path
//! course     an instance of a project, from a seed, in memory
//! dataset    vizflyt dataset: labelled images; labels: what each pixel of them shows
//! evaluate   vizflyt evaluate: how far a trajectory is from the true one
//! export     vizflyt export: a flight's log as tables and images
//! ```
//! Each command is its arguments and one function that runs it; `vizflyt` only calls them.

// `println!` panics where its reader has gone, as `head` does.
#![deny(clippy::print_stdout, clippy::print_stderr)]

pub mod arena;
pub mod course;
pub mod dataset;
pub mod evaluate;
pub mod export;
mod kept;
pub mod labels;
mod page;
pub mod scene;
pub mod shard;
pub mod stage;
