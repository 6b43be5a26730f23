//! `--renderer` and `--detail`: which renderer is used, and how much of a scene it renders, as the command line names
//! it and as the page shows it.

use std::fmt;
use std::path::Path;

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use serde::Serialize;
use vizflyt_splat::{
    Backend, Chosen, CpuRenderer, Detail, Loading, PackedScene, RigidObject, Scene,
};

/// Which renderer renders, for reports and the page.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct RendererInfo {
    /// What it runs on: `cpu avx2`, `gpu NVIDIA GeForce RTX 3080 (Vulkan)`; and where that is so, that it renders in
    /// adaptive detail.
    pub name: String,
    /// Why it is this one.
    pub reason: String,
}

/// Values of `--renderer`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum RendererKind {
    /// A graphics card if one answers, else the processor.
    #[default]
    Auto,
    /// The processor.
    Cpu,
    /// Any graphics adapter, software Vulkan too.
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

/// As the command line spells it, for those who pass it on.
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
    /// Every splat.
    Full,
    /// Merged splats for what is small in the image, where the scene has a million and more.
    #[default]
    Adaptive,
}

impl DetailKind {
    /// Returns what the renderer of a scene is told.
    pub fn of(self, scene: &Scene<'_>) -> Detail {
        match self {
            Self::Full => Detail::Full,
            Self::Adaptive => Detail::suited_to(scene),
        }
    }
}

/// As the command line spells it, for those who pass it on.
impl fmt::Display for DetailKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Full => "full",
            Self::Adaptive => "adaptive",
        })
    }
}

/// Returns the renderer of a packed scene ([`vizflyt_splat::pack`]), which has at most so many bytes of it in memory, and of
/// what moves in it.
///
/// # Errors
/// If the file cannot be used, or a graphics adapter was asked for: they render what is in memory.
pub fn open_packed(
    path: &Path,
    objects: &[RigidObject],
    kind: RendererKind,
    memory_bytes: usize,
    loading: Loading,
) -> Result<CpuRenderer> {
    if kind == RendererKind::Gpu {
        bail!("--renderer gpu: packed scenes are rendered by the processor");
    }
    let cannot = || format!("cannot use scene {}", path.display());
    let scene = PackedScene::open(path).with_context(cannot)?;
    CpuRenderer::streamed(scene, objects, memory_bytes, loading).with_context(cannot)
}

/// Returns the renderer of a scene, which it packs a copy of.
///
/// # Errors
/// If a graphics adapter was asked for and none can be used.
pub fn choose<'a>(
    scene: impl Into<Scene<'a>>,
    kind: RendererKind,
    detail: DetailKind,
) -> Result<Chosen> {
    let scene = scene.into();
    vizflyt_splat::choose(scene, kind.into(), detail.of(&scene))
        .with_context(|| format!("--renderer {kind}"))
}
