//! Copies images from the device's memory to the host.
//!
//! Each tick uses one of two staging buffers: while one tick is read on the host, the next is rendered on the device.
//! If the adapter lets shaders write to host memory, `blend` writes the pixels there itself, across the bus while it
//! still computes; otherwise they are copied.
//!
//! Budget: 16 bytes per pixel over the bus (20 with ids): 4.9 MB at 640x480, 0.2 ms at 25 GB/s. Then 28 bytes written
//! per pixel, by all cores.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rayon::prelude::*;
use zerocopy::{FromBytes, Immutable, KnownLayout};

use super::blend::{Blend, Output};
use super::buffers::{Buffers, SIZES_BYTES};
use super::device::Device;
use super::view::ImageOffset;
use crate::blocks::BLOCK;
use crate::{Camera, RgbdImage};

/// Number of passes with timestamps.
pub(super) const PASSES: usize = 5;
/// Offset of the timestamps in a staging buffer.
const STAMPS_AT: u64 = SIZES_BYTES;
/// Offset of the pixels; a multiple of the binding alignment of every adapter.
const PIXELS_AT: u64 = 256;
/// `pixels` of `blend.wgsl`.
type Pixel = [u32; 4];
const PIXEL_BYTES: u64 = size_of::<Pixel>() as u64;

/// Returns the offset of the ids in a staging buffer for `pixels` pixels.
fn ids_at(pixels: u64) -> u64 {
    (PIXELS_AT + pixels * PIXEL_BYTES).next_multiple_of(PIXELS_AT)
}

/// `sizes` of `sizes.wgsl`.
#[derive(Clone, Copy, Debug, Default, FromBytes, Immutable, KnownLayout)]
#[repr(C)]
pub(super) struct Sizes {
    pub(super) regions_wanted: u32,
    pub(super) slots: u32,
    pub(super) visible: u32,
    pub(super) pairs_wanted: u32,
    pub(super) pairs: u32,
    padding: [u32; 3],
}

const _: () = assert!(size_of::<Sizes>() as u64 == SIZES_BYTES);

impl Sizes {
    /// Returns whether there was room for everything.
    pub(super) fn is_complete(&self) -> bool {
        u64::from(self.regions_wanted) * BLOCK as u64 == u64::from(self.slots)
            && self.pairs_wanted == self.pairs
    }
}

/// Timestamps of passes: start and end of each.
#[derive(Debug)]
pub(super) struct Stamps {
    pub(super) queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    /// Period of a timestamp's tick. [ms]
    period_ms: f64,
}

impl Stamps {
    /// Returns `None` if the adapter has no timestamps.
    pub(super) fn new(device: &Device) -> Option<Self> {
        device.has_timestamps.then(|| Self {
            queries: device.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("passes"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * PASSES as u32,
            }),
            resolved: device.buffer(
                "stamps",
                16 * PASSES as u64,
                wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            ),
            period_ms: f64::from(device.queue.get_timestamp_period()) * 1e-6,
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
}

/// Buffer that the host can read.
#[derive(Debug)]
pub(super) struct Staging {
    buffer: wgpu::Buffer,
    /// Whether the buffer is mapped.
    is_mapped: Arc<AtomicBool>,
    /// Binding of this buffer as output of `blend`, if shaders can write to it, and its number of pixels.
    output: Option<(Output, u64)>,
}

impl Staging {
    /// Returns a buffer for `pixels` pixels; reuses `old` if it is large enough.
    pub(super) fn for_pixels(
        old: Option<Self>,
        device: &Device,
        blend: &Blend,
        pixels: u64,
        has_ids: bool,
    ) -> Self {
        // A binding must not be empty.
        let ids = if has_ids { pixels * 4 } else { PIXELS_AT };
        let mut staging = Self::of(old, device, ids_at(pixels) + ids);
        let is_bound = staging.output.as_ref().is_some_and(|&(_, bound)| bound == pixels);
        if device.maps_storage && !is_bound {
            let (buffer, ids_at) = (&staging.buffer, ids_at(pixels));
            let (pixels_slice, ids_slice) =
                (buffer.slice(PIXELS_AT..ids_at), buffer.slice(ids_at..));
            staging.output = Some((blend.bind_output(device, pixels_slice, ids_slice), pixels));
        }
        staging
    }

    /// Returns this buffer as output of `blend`, if shaders can write to it.
    pub(super) fn output(&self) -> Option<&Output> {
        self.output.as_ref().map(|(output, _)| output)
    }

    /// Returns a buffer of at least `bytes` bytes; reuses `old` if it is large enough.
    pub(super) fn of(old: Option<Self>, device: &Device, bytes: u64) -> Self {
        old.filter(|old| old.buffer.size() >= bytes).unwrap_or_else(|| {
            let mut usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
            if device.maps_storage {
                usage |= wgpu::BufferUsages::STORAGE;
            }
            let buffer = device.buffer("staging", bytes, usage);
            Self { buffer, is_mapped: Arc::default(), output: None }
        })
    }

    /// Adds a copy of the first bytes of a buffer.
    pub(super) fn copy_from(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        from: &wgpu::Buffer,
        at: u64,
        bytes: u64,
    ) {
        encoder.copy_buffer_to_buffer(from, 0, &self.buffer, at, bytes);
    }

    /// Adds the copies of a tick of `pixels` pixels.
    pub(super) fn copy(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        buffers: &Buffers,
        stamps: Option<&Stamps>,
        pixels: u64,
        has_ids: bool,
    ) {
        encoder.copy_buffer_to_buffer(&buffers.sizes, 0, &self.buffer, 0, SIZES_BYTES);
        if let Some(stamps) = stamps {
            encoder.resolve_query_set(&stamps.queries, 0..2 * PASSES as u32, &stamps.resolved, 0);
            let bytes = 16 * PASSES as u64;
            encoder.copy_buffer_to_buffer(&stamps.resolved, 0, &self.buffer, STAMPS_AT, bytes);
        }
        if self.output.is_some() {
            return;
        }
        let bytes = pixels * PIXEL_BYTES;
        encoder.copy_buffer_to_buffer(&buffers.pixels, 0, &self.buffer, PIXELS_AT, bytes);
        if has_ids {
            let at = ids_at(pixels);
            encoder.copy_buffer_to_buffer(&buffers.ids, 0, &self.buffer, at, pixels * 4);
        }
    }

    /// Starts mapping for the host; [`Self::read`] waits for it.
    pub(super) fn map(&self) {
        let is_mapped = Arc::clone(&self.is_mapped);
        is_mapped.store(false, Ordering::Relaxed);
        // The result is checked later: an unmapped buffer has no view.
        self.buffer.map_async(wgpu::MapMode::Read, .., move |_| {
            is_mapped.store(true, Ordering::Release);
        });
    }

    /// Waits for the submission, and passes its bytes to `take`.
    pub(super) fn read<R>(
        &self,
        device: &Device,
        submission: wgpu::SubmissionIndex,
        take: impl FnOnce(&[u8]) -> R,
    ) -> Result<R, String> {
        // Waking up takes a tenth of a millisecond, so a card that is almost done is polled.
        let start = Instant::now();
        while device.is_card && start.elapsed() < AWAKE && !self.is_mapped.load(Ordering::Acquire) {
            if device.device.poll(wgpu::PollType::Poll).is_err() {
                break;
            }
            std::hint::spin_loop();
        }
        let wait = wgpu::PollType::Wait {
            submission_index: Some(submission),
            timeout: Some(Duration::from_secs(TIMEOUT_S)),
        };
        let polled = device.device.poll(wait);
        if let Some(fault) = device.fault() {
            return Err(fault);
        }
        polled.map_err(|error| error.to_string())?;
        let taken = {
            let view = self.buffer.get_mapped_range(..).map_err(|error| error.to_string())?;
            take(&view)
        };
        self.buffer.unmap();
        Ok(taken)
    }
}

/// Maximum time of polling per tick.
const AWAKE: Duration = Duration::from_millis(1);
/// Maximum time for an image; drivers give up after 2 to 10 s themselves. [s]
const TIMEOUT_S: u64 = 60;

/// Returns the counts of the device, and the time of each pass [ms]; 0 without timestamps.
pub(super) fn sizes(bytes: &[u8], stamps: Option<&Stamps>) -> (Sizes, [f32; PASSES]) {
    let (sizes, _) = Sizes::read_from_prefix(bytes).expect("staging holds the sizes");
    let mut times_ms = [0.0; PASSES];
    if let Some(stamps) = stamps {
        for (pass, ms) in times_ms.iter_mut().enumerate() {
            let at = STAMPS_AT as usize + 16 * pass;
            let stamp = |at: usize| {
                bytes[at..at + 8].iter().rev().fold(0u64, |sum, &b| sum << 8 | u64::from(b))
            };
            // The clock may be reset in between.
            *ms = (stamp(at + 8).saturating_sub(stamp(at)) as f64 * stamps.period_ms) as f32;
        }
    }
    (sizes, times_ms)
}

/// Unpacks the images of a tick; `pixels` is their total number of pixels.
pub(super) fn images(
    bytes: &[u8],
    cameras: &[Camera],
    places: &[ImageOffset],
    pixels: usize,
    has_ids: bool,
    images: &mut [RgbdImage],
) {
    let all =
        <[Pixel]>::ref_from_bytes(&bytes[PIXELS_AT as usize..][..pixels * size_of::<Pixel>()])
            .expect("staging is aligned");
    for ((camera, place), image) in cameras.iter().zip(places).zip(images) {
        let k = &camera.intrinsics;
        let (first, count) = (place.first_pixel as usize, k.pixels());
        image.resize(k.width_px, k.height_px);
        unpack(&all[first..first + count], image);
        if has_ids {
            let at = ids_at(pixels as u64) as usize + 4 * first;
            let ids =
                <[u32]>::ref_from_bytes(&bytes[at..at + 4 * count]).expect("staging is aligned");
            image.ids.par_chunks_mut(BAND).zip(ids.par_chunks(BAND)).for_each(|(out, ids)| {
                for (out, &id) in out.iter_mut().zip(ids) {
                    *out = id as u16;
                }
            });
        } else {
            image.ids.fill(0);
        }
    }
}

/// Pixels per task: about 10 us of work.
const BAND: usize = 4 * 1024;

fn unpack(pixels: &[Pixel], image: &mut RgbdImage) {
    image
        .rgb
        .par_chunks_mut(3 * BAND)
        .zip(image.alpha.par_chunks_mut(BAND))
        .zip(image.depth_expected_m.par_chunks_mut(BAND))
        .zip(image.depth_median_m.par_chunks_mut(BAND))
        .zip(pixels.par_chunks(BAND))
        .for_each(|((((rgb, alpha), expected), median), pixels)| {
            let (rgb, _) = rgb.as_chunks_mut::<3>();
            let out = rgb.iter_mut().zip(alpha).zip(expected.iter_mut().zip(median));
            for (&[red_green, blue_alpha, first, second], ((rgb, alpha), (expected, median))) in
                pixels.iter().zip(out)
            {
                *rgb = [red_green, red_green >> 16, blue_alpha].map(half_to_f32);
                *alpha = (blue_alpha >> 16) as f32 / 65535.0;
                *expected = f32::from_bits(first);
                *median = f32::from_bits(second);
            }
        });
}

/// Converts the half in the lower 16 bits to single precision; it must be finite. Written in plain arithmetic, so
/// that compilers vectorise it; the processor's conversion would need a target feature.
fn half_to_f32(bits: u32) -> f32 {
    // The exponent bias of halves is 112 less: a product corrects it, also for subnormal numbers.
    let magnitude = f32::from_bits((bits & 0x7fff) << 13) * f32::from_bits(0x7780_0000);
    f32::from_bits(magnitude.to_bits() | (bits & 0x8000) << 16)
}

#[cfg(test)]
mod tests {
    use half::f16;

    #[test]
    fn converts_every_finite_half() {
        let finite = (0..=u16::MAX).filter(|&bits| f16::from_bits(bits).is_finite());
        for bits in finite {
            let expected = f16::from_bits(bits).to_f32().to_bits();
            assert_eq!(super::half_to_f32(0xabcd_0000 | u32::from(bits)).to_bits(), expected);
        }
    }
}
