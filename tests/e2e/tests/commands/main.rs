//! Black-box tests of commands without a clock, and of the imports between crates.

mod align;
mod arrows;
mod capture;
mod circles;
mod command_line;
mod dataset;
mod features;
mod locate;
mod obstacles;
mod scene;
