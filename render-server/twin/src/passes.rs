//! Selects the device of a training's passes: the processor, or a graphics card with the processor as fallback. If a
//! device is lost, only one step's rendering is repeated, because the Gaussians and the optimiser are in the host's
//! memory.

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
    /// `None` on the processor, and after the device was lost.
    gpu: Option<GpuPasses>,
    /// Lost device and the reason, until read.
    lost: Option<String>,
}

impl Default for Passes {
    fn default() -> Self {
        Self::cpu()
    }
}

impl Passes {
    /// Returns the passes of the processor.
    pub fn cpu() -> Self {
        Self { cpu: Renderer::default(), gpu: None, lost: None }
    }

    /// Returns the passes of a graphics adapter.
    ///
    /// # Errors
    /// [`RenderError::Device`] if its device does not open or does not compile the kernels.
    pub fn gpu(adapter: &Adapter, budget: Budget) -> Result<Self, RenderError> {
        Ok(Self { gpu: Some(GpuPasses::new(adapter, budget)?), ..Self::cpu() })
    }

    /// Selects a device, and returns the reason: the first graphics adapter whose derivatives of a test scene match the
    /// processor's, else the processor. [`Backend::Auto`] skips software Vulkan.
    ///
    /// # Errors
    /// [`NoRenderer::Gpu`] if [`Backend::Gpu`] is requested and no adapter works.
    pub fn choose(backend: Backend) -> Result<(Self, String), NoRenderer> {
        if backend == Backend::Cpu {
            return Ok((Self::cpu(), "asked for".to_owned()));
        }
        let mut found = Vec::new();
        for adapter in Adapter::all() {
            let AdapterName { name, is_software } = adapter.name();
            if *is_software && backend == Backend::Auto {
                found.push(format!("software adapter {name} skipped"));
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

    /// Returns the name of the device in use: `cpu avx2`, or `gpu` and the adapter's name.
    pub fn name(&self) -> &str {
        self.gpu.as_ref().map_or_else(|| self.cpu.name(), GpuPasses::name)
    }

    /// Returns the lost device and the reason, once; from then on the processor renders.
    pub fn take_lost(&mut self) -> Option<String> {
        self.lost.take()
    }

    /// Destroys the device, if any, as a driver reset does: for tests of the fallback.
    pub fn lose_device(&self) {
        if let Some(gpu) = &self.gpu {
            gpu.lose_device();
        }
    }

    /// Returns the device's time by part, over all images; `None` on the processor.
    pub fn device_times(&self) -> Option<TrainingTimes> {
        self.gpu.as_ref().map(GpuPasses::times)
    }

    /// Renders a view. `changed` lists the Gaussians that may differ from the last call.
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

    /// Propagates a derivative by the last image's channels: fills `seen` with the visible rows, in ascending order,
    /// and `out` with one gradient each.
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
            // The device's image is lost with it.
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
