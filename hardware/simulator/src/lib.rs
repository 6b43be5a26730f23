//! The lab in software. VizFlyt connects to it as to a real lab: MAVLink 2 of an ArduCopter, and Vicon's UDP object
//! stream.
//!
//! ```text
//! motors -> airframe (RK4, 800 Hz) -> imu (400 Hz) -> autopilot: estimator -> control -> motors
//!                 |                                       ^  |
//!                 +-> mocap (200 Hz) -> UDP               MAVLink
//!                 +-> truth: clearance, speed, path; truth_feed (400 Hz) -> UDP, for simulated cameras
//! ```
//!
//! Everything except [`driver`], `link`, [`truth_feed`] and `stop` is sans-IO: bytes, samples and `dt` in, bytes and
//! commands out. Tests therefore fly minutes in milliseconds, and the same seed gives the same flight. [`simulation`]
//! combines the parts on one virtual clock.

pub mod airframe;
pub mod battery;
pub mod imu;
pub mod motor;
mod noise;
pub mod wind;

pub mod autopilot;
pub mod control;
pub mod estimator;

pub mod mocap;
pub mod simulation;
pub mod startup;
pub mod truth;
pub mod wifi;

mod args;
pub mod driver;
pub mod link;
pub mod truth_feed;

pub use args::{SimArgs, run};
