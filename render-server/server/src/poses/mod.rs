//! Where the vehicles are: drivers of localization systems, and the thread that fuses and judges.
//!
//! ```text
//! in   packets of Vicon, NatNet, JSON, MAVLink; IMU readings of the autopilots
//! out  each vehicle's newest pose, track and quality; the referee's events;
//!      the newest motions of all vehicles, to the render thread
//! ```

pub mod drivers;
pub mod thread;
