//! (scene, cameras) -> RGB, metric depth and alpha of 3D Gaussian splats.
//!
//! A scene comes from a file ([`ply`]) as [`Splats`]; a renderer ([`CpuRenderer`]) takes it once and
//! then draws any number of [`Camera`]s per call into [`RgbdImage`]s that the caller keeps.
//! [`render_reference`] is the plain truth every fast renderer is compared with.
//!
//! ```
//! use glam::{Quat, Vec3};
//! use vizflyt_protocol::geometry::{Intrinsics, Pose};
//! use vizflyt_splat::{Camera, CpuRenderer, DepthKind, RgbdImage, Splats};
//!
//! // One opaque grey ball of 10 cm, 2 m ahead of a camera at the origin.
//! let splats = Splats {
//!     means_m: vec![Vec3::new(0.0, 0.0, 2.0)],
//!     scales_m: vec![Vec3::splat(0.1)],
//!     rotations: vec![Quat::IDENTITY],
//!     opacities: vec![1.0],
//!     sh_degree: 0,
//!     sh: vec![0.0; 3],
//! };
//! let camera = Camera {
//!     intrinsics: Intrinsics::from_horizontal_fov(64, 48, 1.2),
//!     world_from_cam: Pose::IDENTITY,
//!     near_m: 0.01,
//!     background: [0.0; 3],
//! };
//! let mut images = [RgbdImage::default()];
//! CpuRenderer::new(&splats).render(&[camera], &mut images)?;
//! let mut depth_mm = Vec::new();
//! images[0].write_depth_mm(DepthKind::Median, &mut depth_mm);
//! assert_eq!(depth_mm[24 * 64 + 32], 2000);
//! # Ok::<(), vizflyt_splat::InvalidCamera>(())
//! ```
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
