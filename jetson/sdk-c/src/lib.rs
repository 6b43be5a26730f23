//! SDK for C and C++. `include/vizflyt.h` documents its use and defines the interface.
//!
//! A C++ plugin links `libvizflyt_c.a` and gives [`vizflyt_run`] four callbacks. The SDK validates each observation and
//! passes a pointer to the shared memory; no pixel is copied. This crate only converts types; `vizflyt-sdk` connects to
//! the runtime and waits for images.

mod ffi;

pub use ffi::{
    VizflytArena, VizflytPiece, VizflytPlugin, VizflytSetpoint, VizflytWaypoint,
    vizflyt_publish_odometry, vizflyt_run,
};
