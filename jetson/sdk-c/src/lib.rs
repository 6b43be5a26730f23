//! The SDK for C and C++: `include/vizflyt.h` documents its use, and is the contract.
//!
//! A C++ plugin links `libvizflyt_c.a` and gives [`vizflyt_run`] four callbacks. Each observation
//! is handed over as it lies in shared memory, after the SDK has validated it: no pixel is copied.
//! The crate only converts; what attaches and waits is `vizflyt-sdk`.

mod ffi;

pub use ffi::{
    VizflytArena, VizflytPiece, VizflytPlugin, VizflytSetpoint, VizflytWaypoint,
    vizflyt_publish_odometry, vizflyt_run,
};
