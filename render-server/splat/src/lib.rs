//! (scene, cameras) -> RGB, metric depth and alpha of 3D Gaussian splats.
//!
//! A scene comes from a file ([`ply`]) as [`Splats`]; a renderer ([`CpuRenderer`]) takes it once and
//! then draws any number of [`Camera`]s per call into [`RgbdImage`]s that the caller keeps.
//! [`render_reference`] is the plain truth every fast renderer is compared with.
//!
//! No network, no tokio, no clock but the stopwatch of [`PassTimes`]: a function of its arguments.

mod camera;
mod cpu;
mod harmonics;
mod image;
mod limits;
pub mod ply;
mod reference;
mod splats;

pub use camera::{Camera, InvalidCamera};
pub use cpu::{CpuRenderer, PassTimes, Workload};
pub use image::{DepthKind, RgbdImage};
pub use reference::render_reference;
pub use splats::Splats;
