//! How long the parts of training take: on the device by its own clock, where the adapter has one.

use std::fmt;
use std::ops::Range;
use std::time::Instant;

use serde::Serialize;

use super::super::device::Device;
use super::super::read::Staging;

/// Where the time of photos went, all together. Those of the device are 0 where it has no clock. [ms]
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TrainingTimes {
    /// The host writes rows.
    pub rows: f64,
    /// The device puts changed ones in their places.
    pub scatter: f64,
    /// It takes rows onto the image plane.
    pub project: f64,
    /// It sorts them by depth.
    pub sort: f64,
    /// It gives each tile its list.
    pub bin: f64,
    /// It renders the tiles.
    pub blend: f64,
    /// The host reads the image.
    pub image: f64,
    /// The host writes the derivative by the image.
    pub derivative: f64,
    /// The device takes it to the pairs of tiles and rows.
    pub blend_back: f64,
    /// It takes that to the rows.
    pub unproject: f64,
    /// The host reads the gradients.
    pub gradients: f64,
}

impl TrainingTimes {
    /// Returns a share of all.
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

/// The device's parts of a forward pass, in order.
pub(super) const FORWARD: Range<usize> = 0..5;
/// Those of a backward pass.
pub(super) const BACKWARD: Range<usize> = 5..7;
const PASSES: usize = 7;

/// Bytes of the stamps of so many passes.
pub(super) fn stamp_bytes(passes: &Range<usize>) -> u64 {
    16 * passes.len() as u64
}

/// The device's clock.
#[derive(Debug)]
pub(super) struct Clock {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    /// [ms]
    period: f64,
}

impl Clock {
    /// Is `None` where the adapter has none.
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

    /// Returns the two stamps of a pass.
    pub(super) fn of_pass(&self, pass: usize) -> wgpu::ComputePassTimestampWrites<'_> {
        wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(2 * pass as u32),
            end_of_pass_write_index: Some(2 * pass as u32 + 1),
        }
    }

    /// Adds the copy of the stamps of passes that have run.
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

    /// Returns how long each of `N` passes took, from their stamps. [ms]
    pub(super) fn times<const N: usize>(&self, stamps: &[u8]) -> [f64; N] {
        let stamp = |i: usize| {
            let bytes = &stamps[8 * i..8 * i + 8];
            bytes.iter().rev().fold(0u64, |sum, &byte| sum << 8 | u64::from(byte))
        };
        // Clocks may be reset in between.
        std::array::from_fn(|pass| {
            stamp(2 * pass + 1).saturating_sub(stamp(2 * pass)) as f64 * self.period
        })
    }
}

/// Adds what has passed since an instant. [ms]
pub(super) fn add(to: &mut f64, since: Instant) {
    *to += since.elapsed().as_secs_f64() * 1e3;
}
