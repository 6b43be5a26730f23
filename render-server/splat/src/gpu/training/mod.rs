//! Training on a graphics card: rows of parameters -> the channels of a photo, and the derivative of a loss by
//! them back to the rows.
//!
//! Data flow, the files in run order: `photo` turns a camera into numbers; `project` brings rows onto its image
//! plane; the renderer's own `sort` and `bin` give each tile its list; `invert` notes where each pair stands in
//! the lists; `blend` renders the tiles. The caller compares image and photo. Then `blend` takes what the loss
//! feels at the pixels to the pairs, and `unproject` adds each row's pairs up and takes them to its
//! parameters. `vizflyt-twin` has the same passes for the processor, and what they are held against.
//!
//! Every sum has one order and a place of its own (`blend.rs`): the same rows, photo and derivative give the
//! same gradients, bit for bit, in every run on one device.
//!
//! Budget: `project`, `blend` and `unproject` say theirs. The bus carries the rows up, the image down, its
//! derivative up and 64 bytes per visible row down: 60 k rows of degree 2 at 320x240, 9.1 + 1.8 + 2.2 + 3.8 MB.

mod bin;
mod blend;
mod buffers;
mod invert;
mod photo;
mod project;
mod sort;
mod tiling;
mod unproject;

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

pub use photo::Photo;

use super::Budget;
use super::device::{Adapter, Device};
use super::read::{self, Staging};
use super::view::{GpuView, Tick};
use crate::blocks::BLOCK;
use crate::rasterizer::RenderError;

use bin::{Bin, BinBindings};
use buffers::{TrainingBuffers, TrainingCapacity};
use sort::{Count, Pairs, Sort};

/// Channels of an image: red, green, blue, `sum w z`, `sum w z^2`, transmittance. Numbers lie band of tiles by
/// band, channel by channel, row by row, padded to whole tiles of 16 pixels.
pub const CHANNELS: usize = 6;
/// Channels of a derivative: by each of these, and how wrong a pixel is.
pub const BY_CHANNELS: usize = 7;

/// The derivative of a loss by a row that a photo shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct RowGradient {
    /// By mean, 3; logarithms of the scales, 3; rotation, 4; logit of the opacity.
    pub geometry: [f32; 11],
    /// The error seen through it.
    pub error: f32,
    /// By the colour; times a basis function, by a harmonic.
    pub rgb: [f32; 3],
    row: f32,
}

const _: () = assert!(size_of::<RowGradient>() == 64);

impl RowGradient {
    /// Returns its row.
    pub fn row(&self) -> usize {
        // Rows are fewer than 2^24: exact.
        self.row as usize
    }
}

/// Digits of a depth: 32 bits.
const DEPTH_BITS: u32 = 32;
/// Words of `sizes` and `dispatches`, as in `sizes.wgsl`.
const SLOTS: Count = Count { size: 1, groups: 0 };
const VISIBLE: Count = Count { size: 2, groups: 4 };

/// Where the image lies in a staging buffer, behind what the device counted.
const IMAGE_AT: usize = super::buffers::SIZES_BYTES as usize;

/// Renders rows, and takes derivatives back to them, with a graphics card.
#[derive(Debug)]
pub struct TrainingRenderer {
    name: String,
    device: Device,
    passes: Passes,
    budget: Budget,
    limit: TrainingCapacity,
    bound: Option<Bound>,
    staging: Option<Staging>,
    /// Of the photo rendered last: tiles, rows that it shows, pairs.
    tiles: u32,
    visible: u32,
    pairs: u32,
}

/// The kernels.
#[derive(Debug)]
struct Passes {
    project: project::Project,
    sort: Sort,
    bin: Bin,
    invert: invert::Invert,
    blend: blend::Blend,
    unproject: unproject::Unproject,
}

/// Buffers, and the kernels' bindings to them.
#[derive(Debug)]
struct Bound {
    buffers: TrainingBuffers,
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
            device,
            passes,
            budget,
            bound: None,
            staging: None,
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

    /// Returns the number of (tile, row) pairs of the photo rendered last.
    pub fn pairs(&self) -> usize {
        self.pairs as usize
    }

    /// Destroys the device, as a driver's reset does: to test what takes over.
    pub fn lose_device(&self) {
        self.device.device.destroy();
    }

    /// Renders rows of `stride` numbers as a photo shows them into `image`, [`CHANNELS`] padded to whole tiles.
    ///
    /// # Errors
    /// [`RenderError::Device`] if the device is lost, or has no room for so much.
    ///
    /// # Panics
    /// If the image has another size, or rows lack harmonics of the photo's degree.
    pub fn forward(
        &mut self,
        rows: &[f32],
        stride: usize,
        photo: &Photo,
        image: &mut [f32],
    ) -> Result<(), RenderError> {
        assert!(
            stride >= 11 + 3 * (usize::from(photo.degree) + 1).pow(2),
            "{stride} numbers a row"
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
        // One number more than there are tiles: that of none.
        shared.tile_digits = sort::digits(u32::BITS - self.tiles.leading_zeros());
        loop {
            self.reserve(&wanted)?;
            let bytes = IMAGE_AT + image.len() * 4;
            let staging = Staging::of(self.staging.take(), &self.device, bytes as u64);
            let submission = self.submit_forward(rows, stride, photo, &staging, image.len() as u64);
            let sizes = staging.read(&self.device, submission, |bytes| {
                let (sizes, _) = read::sizes(bytes, None);
                if sizes.pairs == sizes.pairs_wanted {
                    let numbers = &bytes[IMAGE_AT..][..image.len() * 4];
                    image.as_mut_bytes().copy_from_slice(numbers);
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

    /// Takes the derivative of a loss by the last image, [`BY_CHANNELS`] padded to whole tiles, back to the
    /// rows that it shows; fills `out` with them, nearest first.
    ///
    /// # Errors
    /// [`RenderError::Device`] if the device is lost.
    ///
    /// # Panics
    /// If no image was rendered, or `by` has another size.
    pub fn backward(&mut self, by: &[f32], out: &mut Vec<RowGradient>) -> Result<(), RenderError> {
        let bound = self.bound.as_ref().expect("an image was rendered before");
        let (device, passes, buffers) = (&self.device, &self.passes, &bound.buffers);
        let pixels = u64::from(self.tiles) * 256;
        assert_eq!(by.len() as u64, pixels * BY_CHANNELS as u64);
        device.queue.write_buffer(&buffers.by, 0, by.as_bytes());
        let bytes = u64::from(self.visible) * size_of::<RowGradient>() as u64;
        let staging = Staging::of(self.staging.take(), device, bytes);
        let mut encoder = device
            .device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("backward") });
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: Some("backward"),
                timestamp_writes: None,
            });
            passes.blend.run_back(&mut pass, &bound.blend, self.tiles);
            passes.unproject.run(&mut pass, &bound.unproject, &buffers.shared.dispatches);
        }
        staging.copy_from(&mut encoder, &buffers.gradients, 0, bytes);
        let submission = device.queue.submit([encoder.finish()]);
        staging.map();
        out.clear();
        let taken = staging.read(device, submission, |view| {
            let gradients = <[RowGradient]>::ref_from_bytes(&view[..bytes as usize]);
            out.extend_from_slice(gradients.expect("staging is aligned"));
        });
        self.staging = Some(staging);
        taken.map_err(RenderError::Device)
    }

    /// Makes sure of buffers for what is wanted.
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
        // The old buffers go first: the new ones may need their memory.
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

    /// Writes rows and photo, and submits the passes to the image and its copy.
    fn submit_forward(
        &self,
        rows: &[f32],
        stride: usize,
        photo: &Photo,
        staging: &Staging,
        numbers: u64,
    ) -> wgpu::SubmissionIndex {
        let bound = self.bound.as_ref().expect("buffers were made before");
        let (device, passes, buffers) = (&self.device, &self.passes, &bound.buffers);
        let shared = &buffers.shared;
        let count = (rows.len() / stride) as u32;
        let photo = photo.packed(count, stride as u32);
        let tick = Tick {
            cameras: 1,
            parts: 1,
            tiles: self.tiles,
            regions: shared.capacity.regions as u32,
            pairs: shared.capacity.pairs as u32,
            ..Tick::default()
        };
        let view = GpuView::of_size(photo.size);
        // A row's slot is its index; how many are sorted is known here.
        let mut sizes = [0u32; 8];
        sizes[SLOTS.size as usize] = count;
        let mut dispatches = [0u32; 16];
        let groups = u64::from(count).div_ceil(sort::SORT_GROUP) as u32;
        dispatches[SLOTS.groups as usize..][..3].copy_from_slice(&[groups, 1, 1]);
        let write =
            |buffer: &wgpu::Buffer, bytes: &[u8]| device.queue.write_buffer(buffer, 0, bytes);
        write(&buffers.rows, rows.as_bytes());
        write(&buffers.photo, photo.as_bytes());
        write(&shared.tick, tick.as_bytes());
        write(&shared.views, view.as_bytes());
        write(&shared.sizes, sizes.as_bytes());
        write(&shared.dispatches, dispatches.as_bytes());

        let mut encoder = device
            .device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("forward") });
        encoder.clear_buffer(&shared.lists, 0, Some(u64::from(self.tiles) * 8));
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: Some("forward"),
                timestamp_writes: None,
            });
            passes.project.run(&mut pass, &bound.project, count);
            for (i, digit) in bound.sort.iter().enumerate() {
                passes.sort.run(&mut pass, digit, &shared.dispatches);
                if i == 0 {
                    passes.bin.count_visible(&mut pass, &bound.bin);
                }
            }
            passes.bin.run(&mut pass, &bound.bin, &passes.sort, shared);
            passes.invert.run(&mut pass, &bound.invert, &shared.dispatches);
            passes.blend.run(&mut pass, &bound.blend, self.tiles);
        }
        staging.copy_from(&mut encoder, &shared.sizes, 0, super::buffers::SIZES_BYTES);
        staging.copy_from(&mut encoder, &buffers.image, IMAGE_AT as u64, numbers * 4);
        let submission = device.queue.submit([encoder.finish()]);
        staging.map();
        submission
    }
}
