//! `--renderer`: which renderer is used, as the command line names it and as the page shows it.

use std::fmt;

use anyhow::{Context, Result};
use clap::ValueEnum;
use serde::Serialize;
use vizflyt_splat::{Backend, Chosen, Scene};

/// Which renderer renders, for reports and the page.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct RendererInfo {
    /// What it runs on: `cpu avx2`, `gpu NVIDIA GeForce RTX 3080 (Vulkan)`.
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

/// Returns the renderer of a scene, which it packs a copy of.
///
/// # Errors
/// If a graphics adapter was asked for and none can be used.
pub fn choose<'a>(scene: impl Into<Scene<'a>>, kind: RendererKind) -> Result<Chosen> {
    vizflyt_splat::choose(scene, kind.into()).with_context(|| format!("--renderer {kind}"))
}
