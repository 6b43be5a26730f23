//! Time of the passes of training, measured on the device if the adapter has timestamps.

use std::fmt;
use std::ops::Range;
use std::time::Instant;

use serde::Serialize;

use super::super::device::Device;
use super::super::read::Staging;

/// Accumulated time of the passes of all photos. Times of the device are 0 if it has no timestamps. [ms]
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TrainingTimes {
    /// Host: writing rows.
    pub rows: f64,
    /// Device: copying changed rows to their places.
    pub scatter: f64,
    /// Device: projecting rows onto the image plane.
    pub project: f64,
    /// Device: sorting by depth.
    pub sort: f64,
    /// Device: building the list of each tile.
    pub bin: f64,
    /// Device: rendering the tiles.
    pub blend: f64,
    /// Host: reading the image.
    pub image: f64,
    /// Host: writing the derivative by the image.
    pub derivative: f64,
    /// Device: propagating the derivative to the pairs of tiles and rows.
    pub blend_back: f64,
    /// Device: propagating the derivative to the rows.
    pub unproject: f64,
    /// Host: reading the gradients.
    pub gradients: f64,
}

impl TrainingTimes {
    /// Returns all times multiplied by `share`.
    #[must_use]
    pub fn times(self, share: f64) -> Self {
        Self {
            rows: self.rows * share,
            scatter: self.scatter * share,
            project: self.project * share,
            sort: self.sort * share,
            bin: self.bin * share,
            blend: self.blend * share,
            image: self.image * share,
            derivative: self.derivative * share,
            blend_back: self.blend_back * share,
            unproject: self.unproject * share,
            gradients: self.gradients * share,
        }
    }
}

impl fmt::Display for TrainingTimes {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { rows, scatter, project, sort, bin, blend, image, .. } = self;
        let Self { derivative, blend_back, unproject, gradients, .. } = self;
        write!(
            out,
            "rows up {rows:.2}, scatter {scatter:.2}, project {project:.2}, sort {sort:.2}, bin {bin:.2}, \
             blend {blend:.2}, image down {image:.2}; derivative up {derivative:.2}, blend back {blend_back:.2}, \
             unproject {unproject:.2}, gradients down {gradients:.2}"
        )
    }
}

/// Passes of the device in a forward step, in order.
pub(super) const FORWARD: Range<usize> = 0..5;
/// Passes of the device in a backward step.
pub(super) const BACKWARD: Range<usize> = 5..7;
const PASSES: usize = 7;

/// Returns the size of the timestamps of `passes`. [byte]
pub(super) fn stamp_bytes(passes: &Range<usize>) -> u64 {
    16 * passes.len() as u64
}

/// Timestamps of the device.
#[derive(Debug)]
pub(super) struct Clock {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    /// Period of a timestamp's tick. [ms]
    period: f64,
}

impl Clock {
    /// Returns `None` if the adapter has no timestamps.
    pub(super) fn new(device: &Device) -> Option<Self> {
        device.has_timestamps.then(|| Self {
            queries: device.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("training"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * PASSES as u32,
            }),
            resolved: device.buffer(
                "training's stamps",
                stamp_bytes(&(0..PASSES)),
                wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            ),
            period: f64::from(device.queue.get_timestamp_period()) * 1e-6,
        })
    }

    /// Returns the two timestamps of a pass.
    pub(super) fn of_pass(&self, pass: usize) -> wgpu::ComputePassTimestampWrites<'_> {
        wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(2 * pass as u32),
            end_of_pass_write_index: Some(2 * pass as u32 + 1),
        }
    }

    /// Adds a copy of the timestamps of finished passes.
    pub(super) fn copy(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        passes: &Range<usize>,
        staging: &Staging,
        at: u64,
    ) {
        let queries = 2 * passes.start as u32..2 * passes.end as u32;
        encoder.resolve_query_set(&self.queries, queries, &self.resolved, 0);
        staging.copy_from(encoder, &self.resolved, at, stamp_bytes(passes));
    }

    /// Returns the time of each of `N` passes from their timestamps. [ms]
    pub(super) fn times<const N: usize>(&self, stamps: &[u8]) -> [f64; N] {
        let stamp = |i: usize| {
            let bytes = &stamps[8 * i..8 * i + 8];
            bytes.iter().rev().fold(0u64, |sum, &byte| sum << 8 | u64::from(byte))
        };
        // The clock may be reset in between.
        std::array::from_fn(|pass| {
            stamp(2 * pass + 1).saturating_sub(stamp(2 * pass)) as f64 * self.period
        })
    }
}

/// Adds the time since an instant. [ms]
pub(super) fn add(to: &mut f64, since: Instant) {
    *to += since.elapsed().as_secs_f64() * 1e3;
}
