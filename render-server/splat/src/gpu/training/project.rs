//! Pass 1 of training: projects rows onto the image plane.
//!
//! Budget: the whole row is read if it is visible, 44 bytes of it otherwise; 4 bytes written per row and 48 per
//! visible row. At 1 TB/s: 0.2 ms per million rows of degree 2.

use super::super::device::{Device, Groups, Kernel};
use super::buffers::TrainingBuffers;
use crate::blocks::BLOCK;

const SOURCE: &str = concat!(
    include_str!("../common.wgsl"),
    include_str!("photo.wgsl"),
    include_str!("rows.wgsl"),
    include_str!("project.wgsl")
);

/// Pass with its kernel.
#[derive(Debug)]
pub(super) struct Project {
    kernel: Kernel,
}

impl Project {
    pub(super) fn new(device: &Device) -> Self {
        Self { kernel: device.kernel(SOURCE, "project", &[]) }
    }

    pub(super) fn bind(&self, device: &Device, training: &TrainingBuffers) -> wgpu::BindGroup {
        let b = &training.shared;
        device.bind(
            &self.kernel,
            &[
                (0, &training.photo),
                (1, &training.rows),
                (2, &b.shapes),
                (3, &b.extents),
                (4, &b.colours),
                (5, &b.keys[0]),
            ],
        )
    }

    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &wgpu::BindGroup,
        rows: u32,
    ) {
        self.kernel.run(pass, bindings, Groups::Known(rows.div_ceil(BLOCK as u32), 1));
    }
}
