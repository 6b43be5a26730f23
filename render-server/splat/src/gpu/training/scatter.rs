//! Before pass 1 of training: rows onto the device; where it has them from the last photo, the changed ones alone.
//!
//! Budget: 4 bytes per changed row and 4 per number of it over the bus, then 8 moved per number: of 60 k rows of
//! degree 2, 9.4 MB, 0.4 ms at 25 GB/s.

use zerocopy::IntoBytes;

use super::super::device::{Device, Groups, Kernel};
use super::buffers::TrainingBuffers;
use super::upload::Upload;

const SOURCE: &str = include_str!("scatter.wgsl");

/// Workgroups along x; `GRID` in `scatter.wgsl`.
const GRID: u32 = 32_768;

/// What of the rows differs from those that the last photo was rendered from.
#[derive(Clone, Copy, Debug)]
pub enum Changed<'a> {
    /// Any of it.
    All,
    /// Of these rows, each named once, no more than the first numbers.
    Rows {
        /// Which rows.
        rows: &'a [u32],
        /// How many numbers of each.
        columns: usize,
    },
}

/// Words before the list of rows: rows, numbers of each that changed, numbers of each.
const HEADER: usize = 4;

impl Changed<'_> {
    /// Returns where the changed numbers begin, in words, and where they end: even numbers.
    fn extent(rows: usize, columns: usize) -> [usize; 2] {
        let first = (HEADER + rows).next_multiple_of(2);
        [first, (first + rows * columns).next_multiple_of(2)]
    }

    /// Returns the words that go over the bus; `None` if that is all numbers, `all` of them.
    pub(super) fn words(&self, all: usize) -> Option<u64> {
        match *self {
            Self::All => None,
            Self::Rows { rows, columns } => {
                let [_, end] = Self::extent(rows.len(), columns);
                (end < all).then_some(end as u64)
            }
        }
    }
}

/// The pass.
#[derive(Debug)]
pub(super) struct Scatter {
    kernel: Kernel,
}

impl Scatter {
    pub(super) fn new(device: &Device) -> Self {
        Self { kernel: device.kernel(SOURCE, "scatter", &[]) }
    }

    pub(super) fn bind(&self, device: &Device, training: &TrainingBuffers) -> wgpu::BindGroup {
        device.bind(&self.kernel, &[(0, &training.changes), (1, &training.rows)])
    }

    /// Returns the bytes that [`Self::write`] writes.
    pub(super) fn bytes(rows: usize, columns: usize) -> u64 {
        let [_, end] = Changed::extent(rows, columns);
        end as u64 * 4
    }

    /// Writes what `scatter` reads.
    pub(super) fn write(
        upload: &Upload,
        values: &[f32],
        stride: usize,
        rows: &[u32],
        columns: usize,
    ) -> Result<(), String> {
        let header: [u32; HEADER] = [rows.len() as u32, columns as u32, stride as u32, 0];
        upload.write(0, header.as_bytes())?;
        upload.write(4 * HEADER as u64, rows.as_bytes())?;
        let [first, _] = Changed::extent(rows.len(), columns);
        upload.gather(4 * first as u64, 4 * columns, rows.len(), |i| {
            values[rows[i] as usize * stride..][..columns].as_bytes()
        })
    }

    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &wgpu::BindGroup,
        rows: usize,
        columns: usize,
    ) {
        let groups = (rows * columns).div_ceil(256) as u32;
        self.kernel.run(pass, bindings, Groups::Known(groups.min(GRID), groups.div_ceil(GRID)));
    }
}
