//! Training on a graphics card: renders rows of parameters to the channels of a photo, and propagates the derivative
//! of a loss by these channels back to the rows.
//!
//! Data flow, with the files in run order: `scatter` updates the rows on the device. `photo` converts a camera to
//! numbers. `project` projects the rows onto its image plane; `sort` and `bin` build the list of each tile. `invert`
//! stores the position of each pair in the lists. `blend` renders the tiles. The caller compares the image with the
//! photo. Then `blend` propagates the derivative from the pixels to the pairs, and `unproject` sums the pairs of each
//! row and propagates them to its parameters. `vizflyt-twin` has the same passes for the processor, with which these
//! are compared.
//!
//! Every sum has a fixed order and its own memory (`blend.rs`): on one device, the same rows, photo and derivative
//! give bit-identical gradients in every run.
//!
//! The rows stay on the device: only changes since the last photo are uploaded (`scatter.rs`), and the rows of the
//! host are authoritative. All rows are uploaded if their number differs or the buffers are new.
//!
//! Budget: see `scatter`, `project`, `blend` and `unproject`; [`TrainingTimes`] contains the measured times. The bus
//! carries changed rows up, the image down, its derivative up, and 64 bytes per visible row down: 9.4 + 1.8 + 2.2 +
//! 3.8 MB for 60 k visible rows of degree 2 at 320x240.

mod bin;
mod blend;
mod buffers;
mod clock;
mod invert;
mod photo;
mod project;
mod scatter;
mod sort;
mod tiling;
mod unproject;
mod upload;

use std::time::Instant;

use rayon::prelude::*;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

pub use clock::TrainingTimes;
pub use photo::Photo;
pub use scatter::Changed;

use super::Budget;
use super::device::{Adapter, Device};
use super::read::{self, Staging};
use super::view::{GpuView, Tick};
use crate::blocks::BLOCK;
use crate::rasterizer::RenderError;

use bin::{Bin, BinBindings};
use buffers::{TrainingBuffers, TrainingCapacity};
use clock::{BACKWARD, Clock, FORWARD};
use scatter::Scatter;
use sort::{Count, Pairs, Sort};
use upload::{PART, Upload};

/// Number of channels of an image: red, green, blue, `sum w z`, `sum w z^2`, transmittance. Values are stored by band
/// of tiles, then channel, then row, padded to whole tiles of 16 pixels.
pub const CHANNELS: usize = 6;
/// Number of channels of a derivative: by each channel of the image, and the error of each pixel.
pub const BY_CHANNELS: usize = 7;

/// Derivative of a loss by a row that is visible in a photo.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct RowGradient {
    /// By mean (3), logarithms of the scales (3), rotation (4), logit of the opacity (1).
    pub geometry: [f32; 11],
    /// Error of the pixels through this row.
    pub error: f32,
    /// By the colour; times a basis function, it is the derivative by a harmonic.
    pub rgb: [f32; 3],
    row: f32,
}

const _: () = assert!(size_of::<RowGradient>() == 64);

impl RowGradient {
    /// Returns the row's index.
    pub fn row(&self) -> usize {
        // Rows are fewer than 2^24, so f32 is exact.
        self.row as usize
    }
}

/// Bits of a depth.
const DEPTH_BITS: u32 = 32;
/// Words of `sizes` and `dispatches`, as in `sizes.wgsl`.
const SLOTS: Count = Count { size: 1, groups: 0 };
const VISIBLE: Count = Count { size: 2, groups: 4 };

/// Offset of the timestamps in a staging buffer, after the device's counts; the image follows.
const STAMPS_AT: usize = super::buffers::SIZES_BYTES as usize;
const IMAGE_AT: usize = 128;
const _: () = assert!(STAMPS_AT + 16 * FORWARD.end <= IMAGE_AT);

/// Renders rows and propagates derivatives back to them, on a graphics card.
#[derive(Debug)]
pub struct TrainingRenderer {
    name: String,
    device: Device,
    passes: Passes,
    budget: Budget,
    limit: TrainingCapacity,
    bound: Option<Bound>,
    staging: Option<Staging>,
    upload: Option<Upload>,
    clock: Option<Clock>,
    times: TrainingTimes,
    /// Of the last rendered photo: tiles, visible rows, pairs.
    tiles: u32,
    visible: u32,
    pairs: u32,
}

/// Compiled kernels.
#[derive(Debug)]
struct Passes {
    scatter: Scatter,
    project: project::Project,
    sort: Sort,
    bin: Bin,
    invert: invert::Invert,
    blend: blend::Blend,
    unproject: unproject::Unproject,
}

/// Buffers and the kernels' bindings to them.
#[derive(Debug)]
struct Bound {
    buffers: TrainingBuffers,
    /// Number of row values and values per row on the device, from the last photo; `None` if the buffers are new.
    rows: Option<(usize, usize)>,
    scatter: wgpu::BindGroup,
    project: wgpu::BindGroup,
    sort: Vec<sort::Digit>,
    bin: BinBindings,
    invert: wgpu::BindGroup,
    blend: blend::BlendBindings,
    unproject: wgpu::BindGroup,
}

impl TrainingRenderer {
    /// Opens a device on `adapter` and compiles the kernels.
    ///
    /// # Errors
    /// [`RenderError::Device`] with the driver's message.
    pub fn new(adapter: &Adapter, budget: Budget) -> Result<Self, RenderError> {
        let device = adapter.open(&budget).map_err(RenderError::Device)?;
        let passes = Passes {
            scatter: Scatter::new(&device),
            project: project::Project::new(&device),
            sort: Sort::new(&device),
            bin: Bin::new(&device),
            invert: invert::Invert::new(&device),
            blend: blend::Blend::new(&device),
            unproject: unproject::Unproject::new(&device),
        };
        let renderer = Self {
            name: format!("gpu {}", adapter.name().name),
            limit: TrainingCapacity::limit(device.binding_bytes),
            clock: Clock::new(&device),
            times: TrainingTimes::default(),
            device,
            passes,
            budget,
            bound: None,
            staging: None,
            upload: None,
            tiles: 0,
            visible: 0,
            pairs: 0,
        };
        renderer.check_device()?;
        Ok(renderer)
    }

    /// Returns `gpu`, the adapter's name and the interface.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the number of (tile, row) pairs of the last rendered photo.
    pub fn pairs(&self) -> usize {
        self.pairs as usize
    }

    /// Returns the accumulated times of all photos.
    pub fn times(&self) -> TrainingTimes {
        self.times
    }

    /// Destroys the device, like a driver reset: for tests of the fallback.
    pub fn lose_device(&self) {
        self.device.device.destroy();
    }

    /// Renders rows of `stride` values for a photo into `image`, [`CHANNELS`] channels padded to whole tiles.
    /// `changed` lists the rows that may differ from those of the last photo.
    ///
    /// # Errors
    /// [`RenderError::Device`] if the device is lost, or has too little memory.
    ///
    /// # Panics
    /// If the size of the image is wrong, or rows lack harmonics of the photo's degree.
    pub fn forward(
        &mut self,
        rows: &[f32],
        stride: usize,
        changed: Changed<'_>,
        photo: &Photo,
        image: &mut [f32],
    ) -> Result<(), RenderError> {
        assert!(
            stride >= 11 + 3 * (usize::from(photo.degree) + 1).pow(2),
            "{stride} values per row"
        );
        assert!(rows.len().is_multiple_of(stride), "whole rows");
        assert_eq!(image.len() as u64, photo.plane() * CHANNELS as u64);
        let count = rows.len() / stride;
        let [across, down] = photo.tiles();
        self.tiles = across * down;
        let mut wanted = TrainingCapacity {
            row_words: rows.len() as u64,
            plane: photo.plane(),
            ..TrainingCapacity::default()
        };
        let shared = &mut wanted.shared;
        shared.regions = (count as u64).div_ceil(BLOCK as u64);
        shared.pairs = u64::from(self.budget.pairs).min(self.limit.shared.pairs);
        shared.tiles = u64::from(self.tiles);
        // One number more than tiles: that of pairs without a tile.
        shared.tile_digits = sort::digits(u32::BITS - self.tiles.leading_zeros());
        let mut changed = changed;
        loop {
            self.reserve(&wanted)?;
            let start = Instant::now();
            let moved = self.write_rows(rows, stride, changed).map_err(RenderError::Device)?;
            clock::add(&mut self.times.rows, start);
            changed = Changed::Rows { rows: &[], columns: 0 };
            let bytes = IMAGE_AT + image.len() * 4;
            let staging = Staging::of(self.staging.take(), &self.device, bytes as u64);
            let count = count as u32;
            let submission = self.submit_forward(
                [count, stride as u32],
                moved,
                photo,
                &staging,
                image.len() as u64,
            );
            let (clock, times) = (self.clock.as_ref(), &mut self.times);
            let sizes = staging.read(&self.device, submission, |bytes| {
                let start = Instant::now();
                let (sizes, _) = read::sizes(bytes, None);
                if sizes.pairs == sizes.pairs_wanted {
                    let numbers = &bytes[IMAGE_AT..][..image.len() * 4];
                    let parts = image.as_mut_bytes().par_chunks_mut(PART);
                    parts
                        .zip(numbers.par_chunks(PART))
                        .for_each(|(to, from)| to.copy_from_slice(from));
                }
                clock::add(&mut times.image, start);
                if let Some(clock) = clock {
                    let [scatter, project, sort, bin, blend] = clock.times(&bytes[STAMPS_AT..]);
                    times.scatter += scatter;
                    times.project += project;
                    times.sort += sort;
                    times.bin += bin;
                    times.blend += blend;
                }
                sizes
            });
            self.staging = Some(staging);
            let sizes = sizes.map_err(RenderError::Device)?;
            if sizes.pairs == sizes.pairs_wanted {
                (self.visible, self.pairs) = (sizes.visible, sizes.pairs);
                return Ok(());
            }
            wanted.shared.pairs = u64::from(sizes.pairs_wanted);
        }
    }

    /// Propagates the derivative of a loss by the last image ([`BY_CHANNELS`] channels padded to whole tiles) back to
    /// the visible rows, and passes their gradients to `take`, from near to far.
    ///
    /// # Errors
    /// [`RenderError::Device`] if the device is lost.
    ///
    /// # Panics
    /// If no image was rendered, or the size of `by` is wrong.
    pub fn backward<R>(
        &mut self,
        by: &[f32],
        take: impl FnOnce(&[RowGradient]) -> R,
    ) -> Result<R, RenderError> {
        let bound = self.bound.as_ref().expect("an image was rendered before");
        let (device, passes, buffers) = (&self.device, &self.passes, &bound.buffers);
        let pixels = u64::from(self.tiles) * 256;
        assert_eq!(by.len() as u64, pixels * BY_CHANNELS as u64);
        let start = Instant::now();
        let upload = Upload::of(self.upload.take(), device, by.len() as u64 * 4);
        upload.write(0, by.as_bytes()).map_err(RenderError::Device)?;
        clock::add(&mut self.times.derivative, start);
        let bytes = u64::from(self.visible) * size_of::<RowGradient>() as u64;
        let staging = bytes + clock::stamp_bytes(&BACKWARD);
        let staging = Staging::of(self.staging.take(), device, staging);
        let mut encoder = device
            .device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("backward") });
        upload.hand_over(&mut encoder, &buffers.by, by.len() as u64 * 4);
        let clock = self.clock.as_ref();
        let [blend_back, unproject] = ["blend back", "unproject"];
        let mut pass = begin(&mut encoder, blend_back, clock, BACKWARD.start);
        passes.blend.run_back(&mut pass, &bound.blend, self.tiles);
        drop(pass);
        let mut pass = begin(&mut encoder, unproject, clock, BACKWARD.start + 1);
        passes.unproject.run(&mut pass, &bound.unproject, &buffers.shared.dispatches);
        drop(pass);
        staging.copy_from(&mut encoder, &buffers.gradients, 0, bytes);
        if let Some(clock) = clock {
            clock.copy(&mut encoder, &BACKWARD, &staging, bytes);
        }
        let submission = device.queue.submit([encoder.finish()]);
        staging.map();
        upload.map();
        let times = &mut self.times;
        let taken = staging.read(device, submission, |view| {
            let (gradients, stamps) = view.split_at(bytes as usize);
            if let Some(clock) = clock {
                let [blend_back, unproject] = clock.times(stamps);
                times.blend_back += blend_back;
                times.unproject += unproject;
            }
            let start = Instant::now();
            let taken =
                take(<[RowGradient]>::ref_from_bytes(gradients).expect("staging is aligned"));
            clock::add(&mut times.gradients, start);
            taken
        });
        (self.staging, self.upload) = (Some(staging), Some(upload));
        taken.map_err(RenderError::Device)
    }

    /// Grows the buffers if the capacity is insufficient.
    fn reserve(&mut self, wanted: &TrainingCapacity) -> Result<(), RenderError> {
        if !wanted.is_within(&self.limit) {
            return Err(RenderError::Device(format!(
                "a photo needs {wanted:?}, and the graphics device has {:?}",
                self.limit
            )));
        }
        let has = self.bound.as_ref().map(|bound| bound.buffers.capacity).unwrap_or_default();
        if self.bound.is_some() && has.holds(wanted) {
            return Ok(());
        }
        // The old buffers are dropped first: the new ones may need their memory.
        self.bound = None;
        let buffers = TrainingBuffers::new(&self.device, has.grown_to(wanted, &self.limit));
        let (device, passes, shared) = (&self.device, &self.passes, &buffers.shared);
        let by_depth = Pairs {
            keys: [&shared.keys[0], &shared.keys[1]],
            values: [&shared.order[0], &shared.order[1]],
            counts: &shared.digits,
            sizes: &shared.sizes,
        };
        let order = &shared.order[sort::digits(DEPTH_BITS) as usize % 2];
        let permutation = Some([&buffers.permutation[0], &buffers.permutation[1]]);
        self.bound = Some(Bound {
            rows: None,
            scatter: passes.scatter.bind(device, &buffers),
            project: passes.project.bind(device, &buffers),
            sort: passes.sort.bind(device, by_depth, DEPTH_BITS, [SLOTS, VISIBLE], true),
            bin: passes.bin.bind(device, &passes.sort, shared, order, permutation),
            invert: passes.invert.bind(device, &buffers),
            blend: passes.blend.bind(device, &buffers),
            unproject: passes.unproject.bind(device, &buffers),
            buffers,
        });
        self.check_device()
    }

    fn check_device(&self) -> Result<(), RenderError> {
        self.device.fault().map_or(Ok(()), |fault| Err(RenderError::Device(fault)))
    }

    /// Updates the rows on the device: all of them through the queue, changed ones through [`Upload`]. Returns the
    /// number of rows that `scatter` must move, and the number of values of each.
    fn write_rows(
        &mut self,
        rows: &[f32],
        stride: usize,
        changed: Changed<'_>,
    ) -> Result<Option<[usize; 2]>, String> {
        let bound = self.bound.as_mut().expect("buffers were made before");
        let has = bound.rows.replace((rows.len(), stride));
        let words = changed.words(rows.len()).filter(|_| has == Some((rows.len(), stride)));
        match (changed, words) {
            (Changed::Rows { rows: [], .. } | Changed::Rows { columns: 0, .. }, Some(_)) => {
                Ok(None)
            }
            (Changed::Rows { rows: which, columns }, Some(words)) => {
                assert!(
                    columns <= stride
                        && which.iter().all(|&row| (row as usize) < rows.len() / stride)
                );
                let upload = Upload::of(self.upload.take(), &self.device, words * 4);
                Scatter::write(&upload, rows, stride, which, columns)?;
                self.upload = Some(upload);
                Ok(Some([which.len(), columns]))
            }
            _ => {
                self.device.queue.write_buffer(&bound.buffers.rows, 0, rows.as_bytes());
                Ok(None)
            }
        }
    }

    /// Writes a photo of `count` rows of `stride` values, and submits the passes up to the image and its copy; before
    /// them, the pass that moves the changed rows.
    fn submit_forward(
        &self,
        [count, stride]: [u32; 2],
        moved: Option<[usize; 2]>,
        photo: &Photo,
        staging: &Staging,
        numbers: u64,
    ) -> wgpu::SubmissionIndex {
        let bound = self.bound.as_ref().expect("buffers were made before");
        let (device, passes, buffers) = (&self.device, &self.passes, &bound.buffers);
        let shared = &buffers.shared;
        let photo = photo.packed(count, stride);
        let tick = Tick {
            cameras: 1,
            parts: 1,
            tiles: self.tiles,
            regions: shared.capacity.regions as u32,
            pairs: shared.capacity.pairs as u32,
            ..Tick::default()
        };
        let view = GpuView::of_size(photo.size);
        // The slot of a row is its index, so the number of keys to sort is known on the host.
        let mut sizes = [0u32; 8];
        sizes[SLOTS.size as usize] = count;
        let mut dispatches = [0u32; 16];
        let groups = u64::from(count).div_ceil(sort::SORT_GROUP) as u32;
        dispatches[SLOTS.groups as usize..][..3].copy_from_slice(&[groups, 1, 1]);
        let write =
            |buffer: &wgpu::Buffer, bytes: &[u8]| device.queue.write_buffer(buffer, 0, bytes);
        write(&buffers.photo, photo.as_bytes());
        write(&shared.tick, tick.as_bytes());
        write(&shared.views, view.as_bytes());
        write(&shared.sizes, sizes.as_bytes());
        write(&shared.dispatches, dispatches.as_bytes());

        let mut encoder = device
            .device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("forward") });
        encoder.clear_buffer(&shared.lists, 0, Some(u64::from(self.tiles) * 8));
        let (upload, clock) =
            (self.upload.as_ref().filter(|_| moved.is_some()), self.clock.as_ref());
        if let (Some(upload), Some([rows, columns])) = (upload, moved) {
            upload.hand_over(&mut encoder, &buffers.changes, Scatter::bytes(rows, columns));
        }
        let mut pass = begin(&mut encoder, "scatter", clock, 0);
        if let Some([rows, columns]) = moved {
            passes.scatter.run(&mut pass, &bound.scatter, rows, columns);
        }
        drop(pass);
        let mut pass = begin(&mut encoder, "project", clock, 1);
        passes.project.run(&mut pass, &bound.project, count);
        drop(pass);
        let mut pass = begin(&mut encoder, "sort", clock, 2);
        for (i, digit) in bound.sort.iter().enumerate() {
            passes.sort.run(&mut pass, digit, &shared.dispatches);
            if i == 0 {
                passes.bin.count_visible(&mut pass, &bound.bin);
            }
        }
        drop(pass);
        let mut pass = begin(&mut encoder, "bin", clock, 3);
        passes.bin.run(&mut pass, &bound.bin, &passes.sort, shared);
        passes.invert.run(&mut pass, &bound.invert, &shared.dispatches);
        drop(pass);
        let mut pass = begin(&mut encoder, "blend", clock, 4);
        passes.blend.run(&mut pass, &bound.blend, self.tiles);
        drop(pass);
        staging.copy_from(&mut encoder, &shared.sizes, 0, super::buffers::SIZES_BYTES);
        if let Some(clock) = clock {
            clock.copy(&mut encoder, &FORWARD, staging, STAMPS_AT as u64);
        }
        staging.copy_from(&mut encoder, &buffers.image, IMAGE_AT as u64, numbers * 4);
        let submission = device.queue.submit([encoder.finish()]);
        staging.map();
        if let Some(upload) = upload {
            upload.map();
        }
        submission
    }
}

/// Begins a pass with its two timestamps.
fn begin(
    encoder: &mut wgpu::CommandEncoder,
    label: &str,
    clock: Option<&Clock>,
    pass: usize,
) -> wgpu::ComputePass<'static> {
    let pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
        label: Some(label),
        timestamp_writes: clock.map(|clock| clock.of_pass(pass)),
    });
    pass.forget_lifetime()
}
