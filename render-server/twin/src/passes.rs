//! What renders a training and takes derivatives back: the processor, or a graphics card with the processor
//! behind it. A device that is lost costs one step's rendering again, for the Gaussians and the optimiser are
//! the host's.

mod trial;

use vizflyt_splat::gpu::training::{Changed, TrainingTimes};
use vizflyt_splat::gpu::{Adapter, AdapterName, Budget};
use vizflyt_splat::{Backend, NoRenderer, RenderError};

use crate::gaussians::Gaussians;
use crate::gpu::GpuPasses;
use crate::planes::Planes;
use crate::project::{RowGradient, Style};
use crate::render::Renderer;
use crate::view::View;

/// Forward and backward passes of a training.
#[derive(Debug)]
pub struct Passes {
    cpu: Renderer,
    /// Until it is lost.
    gpu: Option<GpuPasses>,
    /// What was lost, and why.
    lost: Option<String>,
}

impl Default for Passes {
    fn default() -> Self {
        Self::cpu()
    }
}

impl Passes {
    /// Returns those of the processor.
    pub fn cpu() -> Self {
        Self { cpu: Renderer::default(), gpu: None, lost: None }
    }

    /// Returns those of a graphics adapter.
    ///
    /// # Errors
    /// [`RenderError::Device`] if its device does not open, or compiles no kernels.
    pub fn gpu(adapter: &Adapter, budget: Budget) -> Result<Self, RenderError> {
        Ok(Self { gpu: Some(GpuPasses::new(adapter, budget)?), ..Self::cpu() })
    }

    /// Returns those for a machine, and why: of the first graphics adapter that renders a test scene and finds its
    /// derivatives as the processor does, else of the processor. [`Backend::Auto`] leaves software Vulkan alone.
    ///
    /// # Errors
    /// [`NoRenderer::Gpu`] if [`Backend::Gpu`] was asked for and there is none.
    pub fn choose(backend: Backend) -> Result<(Self, String), NoRenderer> {
        if backend == Backend::Cpu {
            return Ok((Self::cpu(), "asked for".to_owned()));
        }
        let mut found = Vec::new();
        for adapter in Adapter::all() {
            let AdapterName { name, is_software } = adapter.name();
            if *is_software && backend == Backend::Auto {
                found.push(format!("software adapter {name} left alone"));
                continue;
            }
            let tried = GpuPasses::new(&adapter, Budget::default())
                .map_err(|error| error.to_string())
                .and_then(|mut passes| Ok((trial::check(&mut passes)?, passes)));
            match tried {
                Ok((off, passes)) => {
                    found.push(format!(
                        "graphics adapter {name} trains as the processor does, within {off:.0e}"
                    ));
                    return Ok((Self { gpu: Some(passes), ..Self::cpu() }, found.join("; ")));
                }
                Err(why) => found.push(format!("graphics adapter {name} refused: {why}")),
            }
        }
        let why =
            if found.is_empty() { "no graphics adapter".to_owned() } else { found.join("; ") };
        if backend == Backend::Gpu {
            return Err(NoRenderer::Gpu(why));
        }
        Ok((Self::cpu(), why))
    }

    /// Returns what computes now: `cpu avx2`, or `gpu` and the adapter's name.
    pub fn name(&self) -> &str {
        self.gpu.as_ref().map_or_else(|| self.cpu.name(), GpuPasses::name)
    }

    /// Returns which device was lost and why, once; the processor has taken over then.
    pub fn take_lost(&mut self) -> Option<String> {
        self.lost.take()
    }

    /// Destroys the device, if there is one, as a driver's reset does: to test what takes over.
    pub fn lose_device(&self) {
        if let Some(gpu) = &self.gpu {
            gpu.lose_device();
        }
    }

    /// Returns where a device's time went in all images so far; `None` where none renders.
    pub fn device_times(&self) -> Option<TrainingTimes> {
        self.gpu.as_ref().map(GpuPasses::times)
    }

    /// Renders the image of a view; `changed` is what may differ from the Gaussians of the last one.
    pub(crate) fn forward(
        &mut self,
        gaussians: &Gaussians,
        changed: Changed<'_>,
        view: &View,
        style: Style,
    ) -> &Planes {
        let rendered = self.gpu.as_mut().map(|gpu| gpu.forward(gaussians, changed, view, style));
        if let Some(Err(why)) = rendered {
            self.lose(&why);
        }
        match &self.gpu {
            Some(gpu) => gpu.image(),
            None => self.cpu.forward(gaussians, view, style),
        }
    }

    /// Takes the derivative of a loss by the last image's channels back: fills `seen` with the rows that it
    /// shows, ascending, and `out` with as many gradients.
    pub(crate) fn backward(
        &mut self,
        gaussians: &Gaussians,
        view: &View,
        style: Style,
        by: &Planes,
        seen: &mut Vec<u32>,
        out: &mut Vec<RowGradient>,
    ) {
        if let Some(gpu) = &mut self.gpu {
            match gpu.backward(gaussians, view, style, by, seen, out) {
                Ok(()) => return,
                Err(why) => self.lose(&why),
            }
            // What the device rendered is gone with it.
            self.cpu.forward(gaussians, view, style);
        }
        seen.clear();
        seen.extend(self.cpu.seen().map(|row| row as u32));
        self.cpu.backward(gaussians, view, style, by, out);
    }

    fn lose(&mut self, why: &RenderError) {
        if let Some(gpu) = self.gpu.take() {
            self.lost = Some(format!("{}: {why}", gpu.name()));
        }
    }
}
