//! Pass 5: blends the pixels of each tile from near to far.
//!
//! Budget: 48 bytes read per pair that is not hidden by opaque ones, 16 written per pixel (20 with ids). Limited by
//! arithmetic: about 10 operations per splat and pixel of a patch that the splat reaches, 25 if it is visible there.

use super::buffers::Buffers;
use super::device::{Device, Groups, Kernel, Slice};

const SOURCE: &str =
    concat!(include_str!("common.wgsl"), include_str!("ellipse.wgsl"), include_str!("blend.wgsl"));

/// Bindings of the output: pixels and ids.
#[derive(Debug)]
pub(super) struct Output(wgpu::BindGroup);

/// Pass with its kernel.
#[derive(Debug)]
pub(super) struct Blend {
    kernel: Kernel,
}

impl Blend {
    pub(super) fn new(device: &Device) -> Self {
        Self { kernel: device.kernel(SOURCE, "blend", &[]) }
    }

    pub(super) fn bind(&self, device: &Device, buffers: &Buffers) -> wgpu::BindGroup {
        let b = buffers;
        device.bind(
            &self.kernel,
            &[
                (0, &b.tick),
                (1, &b.views),
                (2, &b.projected),
                (3, &b.pairs[0]),
                (4, &b.firsts),
                (5, &b.ends),
            ],
        )
    }

    /// Binds the output: pixels and ids.
    pub(super) fn bind_output(&self, device: &Device, pixels: Slice<'_>, ids: Slice<'_>) -> Output {
        Output(device.bind_group(&self.kernel, 1, &[(0, pixels), (1, ids)]))
    }

    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &wgpu::BindGroup,
        output: &Output,
        tiles: u32,
    ) {
        pass.set_bind_group(1, &output.0, &[]);
        self.kernel.run(pass, bindings, Groups::of_tiles(tiles));
    }
}
