//! Commands that work on files: scenes, arenas, courses, data sets, trajectories and logs. None of them flies.
//!
//! ```text
//! scene      vizflyt scene: generate, capture, train, align, edit, carve, convert, bake, inspect, pack, render, view
//! arena      vizflyt arena: create an arena for a captured scene, edit its course, check it
//! stage      place of a simulated lab: a generated scene on disk (cached for the next start), or the one at a path
//! course     an instance of a project, generated from a seed, in memory
//! dataset    vizflyt dataset: labelled images; labels: contents of each of their pixels
//! evaluate   vizflyt evaluate: error of an estimated trajectory
//! export     vizflyt export: a flight's log as tables and images
//! ```
//! Each command consists of its arguments and one function that runs it. The program `vizflyt` only calls them.

// `println!` panics if its reader has closed the pipe, as `head` does.
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
