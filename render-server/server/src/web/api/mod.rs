//! Handlers of the page's routes: one file per subject.

pub(super) mod cameras;
pub(super) mod crash;
pub(super) mod environment;
pub(super) mod lab;
mod lab_view;
pub(super) mod leaderboard;
pub(super) mod login;
pub(super) mod pairing;
pub(super) mod pictures;
pub(super) mod scenes;
pub(super) mod sensors;
pub(super) mod stats;
pub(super) mod vehicles;
pub(super) mod watch;
