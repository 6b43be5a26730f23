//! Who flies, and how it goes: control leases, events, tracks, crash cards, the leaderboard.
//!
//! ```text
//! in   poses and the referee's events, from the pose thread; reports of the runtimes; orders of
//!      people (start, land, stop, reset), from the page
//! out  events, to runtimes, page and standard output; runs, to the database; crash cards, to the page
//! ```

pub mod crash;
pub mod events;
pub mod leaderboard;
pub mod vehicle;
