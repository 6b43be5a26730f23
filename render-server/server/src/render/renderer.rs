//! `--renderer` and `--detail`: choice of the renderer and its level of detail, with names for the command line
//! and the page.

use std::fmt;
use std::path::Path;

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use serde::Serialize;
use vizflyt_splat::{
    Backend, Chosen, CpuRenderer, Detail, Loading, PackedScene, RigidObject, Scene,
};

/// Renderer in use, for reports and the page.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct RendererInfo {
    /// Device: `cpu avx2`, `gpu NVIDIA GeForce RTX 3080 (Vulkan)`; with a note if it renders in adaptive
    /// detail.
    pub name: String,
    /// Reason for this renderer.
    pub reason: String,
}

/// Values of `--renderer`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum RendererKind {
    /// A graphics card if available, else the processor
    #[default]
    Auto,
    /// The processor
    Cpu,
    /// Any graphics adapter, including software Vulkan
    Gpu,
}

impl From<RendererKind> for Backend {
    fn from(kind: RendererKind) -> Self {
        match kind {
            RendererKind::Auto => Self::Auto,
            RendererKind::Cpu => Self::Cpu,
            RendererKind::Gpu => Self::Gpu,
        }
    }
}

/// The value on the command line.
impl fmt::Display for RendererKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Auto => "auto",
            Self::Cpu => "cpu",
            Self::Gpu => "gpu",
        })
    }
}

/// Values of `--detail`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum DetailKind {
    /// Every splat
    Full,
    /// Merged splats for small image parts, in scenes with a million splats or more
    #[default]
    Adaptive,
}

impl DetailKind {
    /// Returns the level of detail for a scene.
    pub fn of(self, scene: &Scene<'_>) -> Detail {
        match self {
            Self::Full => Detail::Full,
            Self::Adaptive => Detail::suited_to(scene),
        }
    }
}

/// The value on the command line.
impl fmt::Display for DetailKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Full => "full",
            Self::Adaptive => "adaptive",
        })
    }
}

/// Returns the renderer of a packed scene ([`vizflyt_splat::pack`]) and its moving objects. It keeps at most
/// this many bytes of the scene in memory.
///
/// # Errors
/// If the file cannot be used, or a graphics adapter is required: they render only scenes in memory.
pub fn open_packed(
    path: &Path,
    objects: &[RigidObject],
    kind: RendererKind,
    memory_bytes: usize,
    loading: Loading,
) -> Result<CpuRenderer> {
    if kind == RendererKind::Gpu {
        bail!("--renderer gpu: packed scenes are rendered by the processor; choose cpu or auto");
    }
    let cannot = || format!("cannot use scene {}", path.display());
    let scene = PackedScene::open(path).with_context(cannot)?;
    CpuRenderer::streamed(scene, objects, memory_bytes, loading).with_context(cannot)
}

/// Returns the renderer of a scene, with its own packed copy of it.
///
/// # Errors
/// If a graphics adapter is required and none can be used.
pub fn choose<'a>(
    scene: impl Into<Scene<'a>>,
    kind: RendererKind,
    detail: DetailKind,
) -> Result<Chosen> {
    let scene = scene.into();
    vizflyt_splat::choose(scene, kind.into(), detail.of(&scene))
        .with_context(|| format!("--renderer {kind}"))
}
