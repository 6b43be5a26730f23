//! Before pass 1 of training: uploads the rows, or only the changed ones if the device has those of the last photo.
//!
//! Budget: 4 bytes per changed row and 4 per value of it over the bus, then 8 bytes moved per value. For 60 k rows of
//! degree 2: 9.4 MB, 0.4 ms at 25 GB/s.

use zerocopy::IntoBytes;

use super::super::device::{Device, Groups, Kernel};
use super::buffers::TrainingBuffers;
use super::upload::Upload;

const SOURCE: &str = include_str!("scatter.wgsl");

/// Workgroups along x; `GRID` in `scatter.wgsl`.
const GRID: u32 = 32_768;

/// Rows that differ from those of the last rendered photo.
#[derive(Clone, Copy, Debug)]
pub enum Changed<'a> {
    /// Any row may differ.
    All,
    /// Only the first values of these rows differ; each row is listed once.
    Rows {
        /// Indices of the rows.
        rows: &'a [u32],
        /// Number of changed values of each row.
        columns: usize,
    },
}

/// Words before the list of rows: number of rows, changed values of each, values of each.
const HEADER: usize = 4;

impl Changed<'_> {
    /// Returns start and end of the changed values, in words: even numbers.
    fn extent(rows: usize, columns: usize) -> [usize; 2] {
        let first = (HEADER + rows).next_multiple_of(2);
        [first, (first + rows * columns).next_multiple_of(2)]
    }

    /// Returns the number of words to upload, or `None` if all `all` values are uploaded.
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

/// Pass with its kernel.
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

    /// Returns the number of bytes that [`Self::write`] writes.
    pub(super) fn bytes(rows: usize, columns: usize) -> u64 {
        let [_, end] = Changed::extent(rows, columns);
        end as u64 * 4
    }

    /// Writes the input of `scatter`.
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
