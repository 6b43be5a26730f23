//! (scene, cameras) -> RGB, metric depth and alpha of 3D Gaussian splats.
//!
//! No network, no tokio, no clock: a function of its arguments.

mod camera;
mod image;
mod splats;

pub use camera::Camera;
pub use image::RgbdImage;
pub use splats::Splats;
