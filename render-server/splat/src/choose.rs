//! Which renderer a machine gets, and why: asked once at start, printed, shown on the page.

use std::str::FromStr;

use crate::{CpuRenderer, Rasterizer, Scene};

/// What the user asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Backend {
    /// A graphics card if one answers and draws a test image as the processor does, else the
    /// processor. Software Vulkan is left alone.
    #[default]
    Auto,
    /// The processor.
    Cpu,
    /// Any graphics adapter, software Vulkan too.
    Gpu,
}

impl FromStr for Backend {
    type Err = UnknownBackend;

    fn from_str(name: &str) -> Result<Self, UnknownBackend> {
        match name {
            "auto" => Ok(Self::Auto),
            "cpu" => Ok(Self::Cpu),
            "gpu" => Ok(Self::Gpu),
            _ => Err(UnknownBackend(name.to_owned())),
        }
    }
}

/// The name is no backend's.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no renderer {0:?}; choose auto, cpu or gpu")]
pub struct UnknownBackend(String);

/// A renderer, and why it is this one.
pub struct Chosen {
    /// Holds its own packed copy of the scene.
    pub rasterizer: Box<dyn Rasterizer>,
    /// In words: `no graphics adapter; cpu avx2`.
    pub reason: String,
}

impl std::fmt::Debug for Chosen {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Chosen").field(&self.rasterizer.name()).field(&self.reason).finish()
    }
}

/// No renderer does what was asked.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoRenderer {
    /// The GPU was asked for and none can be used.
    #[error("no graphics adapter can be used: {0}; choose cpu or auto")]
    Gpu(String),
}

/// Returns the renderer for a scene on this machine.
///
/// # Errors
/// [`NoRenderer::Gpu`] if [`Backend::Gpu`] was asked for and there is none; the others always
/// find one.
pub fn choose<'a>(scene: impl Into<Scene<'a>>, backend: Backend) -> Result<Chosen, NoRenderer> {
    let scene = scene.into();
    let cpu = |why: &str| {
        let cpu = CpuRenderer::new(scene);
        let reason = format!("{why}; {}", cpu.name());
        Ok(Chosen { rasterizer: Box::new(cpu), reason })
    };
    match backend {
        Backend::Cpu => cpu("asked for"),
        Backend::Auto => cpu("no graphics renderer in this build"),
        Backend::Gpu => Err(NoRenderer::Gpu("built without the feature `gpu`".into())),
    }
}
