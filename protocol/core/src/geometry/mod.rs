//! Frames, poses, cameras and solids. f64, SI units, no allocation.
//!
//! A transform is named `a_from_b` and has the type [`Pose<A, B>`], so that mismatched frames do not compile. Vectors
//! are plain [`glam`] values with the frame in their names (`p_world`, `v_body`).

mod distortion;
mod frame;
mod intrinsics;
// Parsing needs allocation, which is not available on microcontrollers.
#[cfg(feature = "std")]
mod lens_config;
mod pose;
mod volume;

pub use distortion::Distortion;
pub use frame::{Body, Cam, Frame, Object, Odom, Scene, Sensor, World};
pub use intrinsics::{Intrinsics, InvalidIntrinsics};
#[cfg(feature = "std")]
pub use lens_config::LensConfig;
pub use pose::{Pose, Twist, body_from_forward_cam, wrap_pi, yaw_of};
pub use volume::Volume;
