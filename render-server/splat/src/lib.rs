//! Renders 3D Gaussian splats: (scene, cameras) -> RGB, metric depth, alpha and object ids.
//!
//! [`format`] reads a twin from a file as [`Splats`]. With its moving objects it is a [`Scene`]. A [`Rasterizer`]
//! packs the scene once and then renders any number of [`Camera`]s per call into [`RgbdImage`]s that the caller
//! keeps. [`render_reference`] is the simple, slow renderer with which all fast renderers are compared.
//!
//! ```
//! use glam::{Quat, Vec3};
//! use vizflyt_protocol::geometry::{Intrinsics, Pose};
//! use vizflyt_splat::{Camera, CpuRenderer, DepthKind, Rasterizer, RgbdImage, Splats};
//!
//! // One opaque grey ball of 10 cm, 2 m ahead of a camera at the origin.
//! let splats = Splats {
//!     means_m: vec![Vec3::new(0.0, 0.0, 2.0)],
//!     scales_m: vec![Vec3::splat(0.1)],
//!     rotations: vec![Quat::IDENTITY],
//!     opacities: vec![1.0],
//!     sh_degree: 0,
//!     sh: vec![0.0; 3],
//!     antialiased: false,
//! };
//! let intrinsics = Intrinsics::from_horizontal_fov(64, 48, 1.2);
//! let camera = Camera::new(intrinsics, Pose::IDENTITY, 0.01);
//! let mut images = [RgbdImage::default()];
//! CpuRenderer::new(&splats).render(&[], &[camera], &mut images)?;
//! let mut depth_mm = Vec::new();
//! images[0].write_depth_mm(DepthKind::Median, &mut depth_mm);
//! assert_eq!(depth_mm[24 * 64 + 32], 2000);
//! # Ok::<(), vizflyt_splat::RenderError>(())
//! ```
//!
//! Results depend only on the arguments: the crate uses no network, no tokio, and no clock except for [`PassTimes`].

#![warn(missing_docs)]

mod atmosphere;
mod backend;
mod blocks;
pub mod builtin_models;
mod camera;
mod cpu;
pub mod edit;
mod fallback;
pub mod format;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod harmonics;
mod image;
pub mod imaging;
pub mod limits;
mod rasterizer;
mod reference;
mod scene;
pub mod sensor;
mod splats;
pub mod weather;

pub use atmosphere::Atmosphere;
pub use backend::{Backend, Chosen, NoRenderer, UnknownBackend, choose};
pub use camera::{Camera, InvalidCamera};
pub use cpu::{
    CpuRenderer, Detail, Loading, Machine, Need, PackSummary, PackedError, PackedScene, Source,
    Streaming, pack, simd,
};
pub use fallback::FallbackRenderer;
pub use format::ply;
pub use image::{DepthKind, RgbdImage};
pub use rasterizer::{PassTimes, Rasterizer, RenderError, Workload};
pub use reference::render_reference;
pub use scene::{Placement, RigidObject, Scene};
pub use splats::Splats;
