//! Renderer for graphics cards, through wgpu: Vulkan, Metal, Direct3D 12.
//!
//! Data flow, with the files in run order: `scene` packs and uploads once. `view` converts cameras and placements to
//! numbers. Then, for all cameras of a tick in one submission: `cull` finds the blocks in view and assigns each a
//! region of slots. `project` projects their splats onto the image planes and counts those of each 16x16-pixel tile
//! (`cover.wgsl`). `bin` builds the list of each tile, `sort` sorts it by depth, `blend` renders the tiles, and
//! `read` copies pixels to the host. `device` selects the adapter; `buffers` contains the shared buffers.
//!
//! Nothing is read back within a tick: the device counts and dispatches by itself. The counts are read with the
//! images. If there was too little room, buffers grow and the tick is rendered again, so that no image lacks a splat.
//! No kernel uses subgroup operations or waits for another workgroup. Slots of regions are in scene order, and lists
//! are sorted by depth and slot: the same tick gives bit-identical images on all adapters with the same rounding.
//!
//! Memory: see the formulas in `scene` and `buffers`.
//!
//! A dispatch has an overhead of about 6 us on a card; a tick takes seven of them.

mod bin;
mod blend;
mod buffers;
mod cull;
mod device;
mod limits;
mod project;
mod read;
mod scene;
mod sort;
pub mod training;
mod view;

use std::borrow::Cow;
use std::collections::VecDeque;
use std::time::Instant;

pub use device::{Adapter, AdapterName};

use buffers::{Buffers, Capacity};
use device::Device;
pub use limits::Budget;
use limits::TILE_PX;
use read::{Staging, Stamps};
use scene::GpuScene;
use view::{GpuView, ImageOffset, Tick};

use vizflyt_protocol::geometry::Intrinsics;

use crate::rasterizer::{self, PassTimes, Rasterizer, RenderError, Workload};
use crate::{Camera, CpuRenderer, Placement, RgbdImage, Scene};

/// Maximum number of ticks in flight.
const MAX_IN_FLIGHT: usize = 2;
/// Maximum number of cameras per tick: `Cover` of `cover.wgsl` has a fixed number of bits for them, and for the tiles
/// along an image's side.
const MAX_CAMERAS: usize = 1 << 12;
const _: () = assert!(Intrinsics::MAX_SIDE_PX.div_ceil(TILE_PX) < 1 << 10);

/// Renderer that uses a graphics card.
#[derive(Debug)]
pub struct GpuRenderer {
    /// Name of the adapter.
    name: String,
    device: Device,
    passes: Passes,
    stamps: Option<Stamps>,
    scene: GpuScene,
    limit: Capacity,
    bound: Option<Bound>,
    spare: Vec<Staging>,
    /// Ticks in flight.
    in_flight: VecDeque<(PendingTick, wgpu::SubmissionIndex)>,
    lenses: view::Lenses,
    /// Maximum number of cameras per submission; reduced when a submission does not fit.
    together: usize,
    budget: Budget,
    workload: Workload,
}

/// Compiled kernels.
#[derive(Debug)]
struct Passes {
    cull: cull::Cull,
    project: project::Project,
    bin: bin::Bin,
    sort: sort::Sort,
    blend: blend::Blend,
}

/// Buffers and the kernels' bindings to them.
#[derive(Debug)]
struct Bound {
    buffers: Buffers,
    cull: cull::CullBindings,
    project: Vec<wgpu::BindGroup>,
    bin: bin::BinBindings,
    sort: wgpu::BindGroup,
    blend: wgpu::BindGroup,
    /// Output of `blend`, if shaders cannot write to host memory.
    output: Option<blend::Output>,
}

/// Tick to be rendered.
#[derive(Debug)]
struct PendingTick {
    placements: Vec<Placement>,
    cameras: Vec<Camera>,
    places: Vec<ImageOffset>,
    /// Required capacity; `tiles` and `pixels` are exact.
    wanted: Capacity,
    staging: Staging,
    began: Instant,
}

/// Why a tick cannot be rendered.
enum SubmitError {
    /// Larger buffers are needed than the device has; fewer cameras at once may fit.
    TooLarge(String),
    Render(RenderError),
}

impl GpuRenderer {
    /// Uploads a scene to a device on `adapter`. Omits splats that no image would show.
    ///
    /// # Errors
    /// [`RenderError::Device`] with the driver's message, if the device does not open or has too little memory.
    pub fn new<'a>(
        scene: impl Into<Scene<'a>>,
        adapter: &Adapter,
        budget: Budget,
    ) -> Result<Self, RenderError> {
        Self::like(&CpuRenderer::new(scene), adapter, budget)
    }

    /// Uploads the packed scene of a CPU renderer, and renders it in the same detail.
    ///
    /// # Errors
    /// Same as [`Self::new`], and if the scene is larger than memory.
    pub fn like(
        packed: &CpuRenderer,
        adapter: &Adapter,
        budget: Budget,
    ) -> Result<Self, RenderError> {
        let device = adapter.open(&budget).map_err(RenderError::Device)?;
        let scene = upload(&device, packed)?;
        let passes = Passes {
            cull: cull::Cull::new(&device),
            project: project::Project::new(&device),
            bin: bin::Bin::new(&device),
            sort: sort::Sort::new(&device),
            blend: blend::Blend::new(&device),
        };
        let stamps = Stamps::new(&device);
        if let Some(fault) = device.fault() {
            return Err(RenderError::Device(fault));
        }
        Ok(Self {
            name: adapter.name().name.clone(),
            limit: Capacity::limit(device.binding_bytes),
            workload: Workload { splats: scene.len, ..Workload::default() },
            device,
            passes,
            stamps,
            scene,
            bound: None,
            spare: Vec::new(),
            in_flight: VecDeque::new(),
            lenses: view::Lenses::default(),
            together: usize::MAX,
            budget,
        })
    }

    /// Replaces the scene, and uses the detail in which the new one is packed.
    ///
    /// # Errors
    /// Same as [`Self::like`]; the renderer is then unusable.
    ///
    /// # Panics
    /// If a tick is in flight.
    pub fn load(&mut self, packed: &CpuRenderer) -> Result<(), RenderError> {
        assert!(self.in_flight.is_empty(), "finish the ticks in flight first");
        self.bound = None;
        self.scene = upload(&self.device, packed)?;
        self.workload = Workload { splats: self.scene.len, ..Workload::default() };
        self.check_device().map_err(SubmitError::into_error)
    }

    /// Starts to render one image per camera and returns at once; [`Self::finish`] fetches the images. Two ticks may
    /// be in flight.
    ///
    /// # Errors
    /// [`RenderError`], as in [`Rasterizer::render`].
    ///
    /// # Panics
    /// If two ticks are in flight, or the number of placements differs from that of the objects.
    pub fn begin(
        &mut self,
        placements: &[Placement],
        cameras: &[Camera],
    ) -> Result<(), RenderError> {
        let none = vec![RgbdImage::default(); cameras.len()];
        rasterizer::validate(self.scene.ids.len() - 1, placements, cameras, &none)?;
        self.submit_tick(placements, cameras).map_err(SubmitError::into_error)
    }

    /// Waits for the oldest tick in flight, fills its images, and returns the time of the passes on the device.
    /// `total_ms` starts at [`Self::begin`].
    ///
    /// # Errors
    /// [`RenderError::Device`]; the tick is then dropped.
    ///
    /// # Panics
    /// If no tick is in flight, or the number of images differs from that of its cameras.
    pub fn finish(&mut self, images: &mut [RgbdImage]) -> Result<PassTimes, RenderError> {
        self.finish_tick(images).map_err(SubmitError::into_error)
    }

    /// Destroys the device, like a driver reset: for tests of the fallback.
    pub fn lose_device(&self) {
        self.device.device.destroy();
    }

    /// Submits a tick.
    fn submit_tick(
        &mut self,
        placements: &[Placement],
        cameras: &[Camera],
    ) -> Result<(), SubmitError> {
        assert!(self.in_flight.len() < MAX_IN_FLIGHT, "two ticks are already in flight");
        let began = Instant::now();
        if cameras.len() > MAX_CAMERAS {
            return Err(SubmitError::TooLarge(format!("{} cameras at once", cameras.len())));
        }
        let mut places = Vec::with_capacity(cameras.len());
        let (mut tiles, mut pixels) = (0u64, 0u64);
        for camera in cameras {
            let k = &camera.intrinsics;
            places.push(ImageOffset { first_tile: tiles as u32, first_pixel: pixels as u32 });
            let across = k.width_px.div_ceil(TILE_PX);
            tiles += u64::from(across) * u64::from(k.height_px.div_ceil(TILE_PX));
            pixels += k.pixels() as u64;
        }
        let wanted = Capacity {
            views: (cameras.len() * self.scene.ids.len()) as u64,
            camera_blocks: cameras.len() as u64 * u64::from(self.scene.block_count),
            regions: u64::from(self.budget.regions).min(self.limit.regions),
            pairs: u64::from(self.budget.pairs).min(self.limit.pairs),
            tiles,
            pixels,
        };
        self.reserve(&wanted)?;
        let (old, blend) = (self.spare.pop(), &self.passes.blend);
        let staging = Staging::for_pixels(old, &self.device, blend, pixels, self.has_ids());
        let tick = PendingTick {
            placements: placements.to_vec(),
            cameras: cameras.to_vec(),
            places,
            wanted,
            staging,
            began,
        };
        let submission = self.submit(&tick);
        self.in_flight.push_back((tick, submission));
        Ok(())
    }

    fn has_ids(&self) -> bool {
        self.scene.ids.len() > 1
    }

    /// Grows the buffers if the capacity is insufficient.
    fn reserve(&mut self, wanted: &Capacity) -> Result<(), SubmitError> {
        if !wanted.is_within(&self.limit) {
            return Err(SubmitError::TooLarge(format!(
                "a tick needs {wanted:?}, and the graphics device has {:?}",
                self.limit
            )));
        }
        let has = self.bound.as_ref().map(|bound| bound.buffers.capacity).unwrap_or_default();
        if self.bound.is_some() && has.holds(wanted) {
            return Ok(());
        }
        // The old buffers are dropped first: the new ones may need their memory.
        self.bound = None;
        let capacity = has.grown_to(wanted, &self.limit);
        let buffers = Buffers::new(&self.device, capacity, self.has_ids());
        let (device, passes) = (&self.device, &self.passes);
        self.bound = Some(Bound {
            cull: passes.cull.bind(device, &self.scene, &buffers),
            project: passes.project.bind(device, &self.scene, &buffers),
            bin: passes.bin.bind(device, &buffers),
            sort: passes.sort.bind(device, &buffers),
            blend: passes.blend.bind(device, &buffers),
            output: (!device.maps_storage).then(|| {
                let (pixels, ids) = (buffers.pixels.slice(..), buffers.ids.slice(..));
                passes.blend.bind_output(device, pixels, ids)
            }),
            buffers,
        });
        self.check_device()
    }

    fn check_device(&self) -> Result<(), SubmitError> {
        match self.device.fault() {
            Some(fault) => Err(SubmitError::Render(RenderError::Device(fault))),
            None => Ok(()),
        }
    }

    /// Writes the inputs of a tick and submits its passes and copies.
    fn submit(&mut self, pending: &PendingTick) -> wgpu::SubmissionIndex {
        let tiles = pending.wanted.tiles as u32;
        let views = self.views(pending);
        let bound = self.bound.as_ref().expect("buffers were made before");
        let (device, passes, buffers) = (&self.device, &self.passes, &bound.buffers);
        let cameras = pending.cameras.len() as u32;
        let tick = Tick {
            cameras,
            parts: self.scene.ids.len() as u32,
            blocks: self.scene.block_count,
            tiles,
            regions: buffers.capacity.regions as u32,
            pairs: buffers.capacity.pairs as u32,
            has_ids: u32::from(self.has_ids()),
            max_error_px: self.scene.max_error_px,
        };
        device.queue.write_buffer(&buffers.tick, 0, zerocopy::IntoBytes::as_bytes(&tick));
        device.queue.write_buffer(&buffers.views, 0, zerocopy::IntoBytes::as_bytes(&views[..]));

        let mut encoder = device
            .device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("tick") });
        let mut stage = 0;
        let mut begin = |encoder: &mut wgpu::CommandEncoder| {
            let label = ["cull", "project", "bin", "sort", "blend"][stage];
            let pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: Some(label),
                timestamp_writes: self.stamps.as_ref().map(|stamps| stamps.of_pass(stage)),
            });
            stage += 1;
            pass.forget_lifetime()
        };
        encoder.clear_buffer(&buffers.firsts, 0, Some((u64::from(tiles) + 1) * 4));
        let mut pass = begin(&mut encoder);
        passes.cull.run(&mut pass, &bound.cull, cameras * self.scene.block_count);
        drop(pass);
        let mut pass = begin(&mut encoder);
        passes.project.run(&mut pass, &bound.project, &self.scene, cameras);
        drop(pass);
        let mut pass = begin(&mut encoder);
        passes.bin.run(&mut pass, &bound.bin, buffers);
        drop(pass);
        let mut pass = begin(&mut encoder);
        passes.sort.run(&mut pass, &bound.sort, tiles);
        drop(pass);
        let mut pass = begin(&mut encoder);
        let output = pending.staging.output().or(bound.output.as_ref()).expect("one of both is");
        passes.blend.run(&mut pass, &bound.blend, output, tiles);
        drop(pass);
        let has_ids = self.has_ids();
        let pixels = pending.wanted.pixels;
        pending.staging.copy(&mut encoder, buffers, self.stamps.as_ref(), pixels, has_ids);
        let submission = device.queue.submit([encoder.finish()]);
        pending.staging.map();
        submission
    }

    /// Returns the cameras as seen from each part.
    fn views(&mut self, pending: &PendingTick) -> Vec<GpuView> {
        let mut views = Vec::with_capacity(pending.cameras.len() * self.scene.ids.len());
        for (camera, &place) in pending.cameras.iter().zip(&pending.places) {
            let lens = self.lenses.of(camera);
            views.push(GpuView::new(
                camera,
                &lens,
                &camera.world_from_cam,
                place,
                self.scene.ids[0],
                self.scene.antialiased[0],
            ));
            let parts = self.scene.ids[1..].iter().zip(&self.scene.antialiased[1..]);
            for (placement, (&id, &antialiased)) in pending.placements.iter().zip(parts) {
                views.push(match placement {
                    Some(world_from_object) => {
                        // A moving object before a camera is the same as a static object before a moving camera.
                        let object_from_cam = world_from_object.inverse() * camera.world_from_cam;
                        GpuView::new(camera, &lens, &object_from_cam, place, id, antialiased)
                    }
                    None => GpuView::absent(),
                });
            }
        }
        views
    }

    /// Waits for the oldest tick in flight; renders it again if it had too little room.
    fn finish_tick(&mut self, images: &mut [RgbdImage]) -> Result<PassTimes, SubmitError> {
        let (mut pending, mut submission) =
            self.in_flight.pop_front().expect("a tick is in flight");
        assert_eq!(pending.cameras.len(), images.len(), "one image per camera");
        let has_ids = self.has_ids();
        loop {
            let mut read_ms = 0.0;
            let read = pending.staging.read(&self.device, submission, |bytes| {
                let start = Instant::now();
                let (sizes, passes_ms) = read::sizes(bytes, self.stamps.as_ref());
                if sizes.is_complete() {
                    let pixels = pending.wanted.pixels as usize;
                    read::images(bytes, &pending.cameras, &pending.places, pixels, has_ids, images);
                }
                read_ms = milliseconds(start);
                (sizes, passes_ms)
            });
            let (sizes, [cull_ms, project_ms, bin_ms, sort_ms, blend_ms]) =
                read.map_err(|fault| SubmitError::Render(RenderError::Device(fault)))?;
            if sizes.is_complete() {
                let cameras = pending.cameras.len().max(1);
                self.workload.visible = sizes.visible as usize / cameras;
                self.workload.pairs = sizes.pairs as usize / cameras;
                let total_ms = milliseconds(pending.began);
                self.spare.push(pending.staging);
                return Ok(PassTimes {
                    cull_ms,
                    project_ms,
                    sort_ms,
                    bin_ms,
                    blend_ms,
                    read_ms,
                    total_ms,
                });
            }
            let wanted = &mut pending.wanted;
            wanted.regions = wanted.regions.max(u64::from(sizes.regions_wanted));
            wanted.pairs = wanted.pairs.max(u64::from(sizes.pairs_wanted));
            self.reserve(&pending.wanted)?;
            submission = self.submit(&pending);
        }
    }
}

fn upload(device: &Device, packed: &CpuRenderer) -> Result<GpuScene, RenderError> {
    let (parts, max_error_px) = packed.packed().ok_or_else(|| {
        RenderError::Device("a scene larger than memory is the processor's".to_owned())
    })?;
    GpuScene::new(device, parts, max_error_px)
}

impl SubmitError {
    fn into_error(self) -> RenderError {
        match self {
            // Another renderer must render it, as if this device were lost.
            Self::TooLarge(why) => RenderError::Device(why),
            Self::Render(error) => error,
        }
    }
}

impl Rasterizer for GpuRenderer {
    /// Returns `gpu`, the name of the adapter with its interface, and whether the detail is adaptive:
    /// `gpu llvmpipe (Vulkan)`.
    fn name(&self) -> Cow<'_, str> {
        let detail = if self.scene.max_error_px > 0.0 { ", adaptive detail" } else { "" };
        format!("gpu {}{detail}", self.name).into()
    }

    fn render(
        &mut self,
        placements: &[Placement],
        cameras: &[Camera],
        images: &mut [RgbdImage],
    ) -> Result<PassTimes, RenderError> {
        rasterizer::validate(self.scene.ids.len() - 1, placements, cameras, images)?;
        assert!(self.in_flight.is_empty(), "finish the ticks in flight first");
        let start = Instant::now();
        let mut times = PassTimes::default();
        let mut done = 0;
        while done < cameras.len() {
            let count = (cameras.len() - done).min(self.together);
            let group = done..done + count;
            let rendered = self
                .submit_tick(placements, &cameras[group.clone()])
                .and_then(|()| self.finish_tick(&mut images[group]));
            match rendered {
                Ok(part) => {
                    times.cull_ms += part.cull_ms;
                    times.project_ms += part.project_ms;
                    times.sort_ms += part.sort_ms;
                    times.bin_ms += part.bin_ms;
                    times.blend_ms += part.blend_ms;
                    times.read_ms += part.read_ms;
                    done += count;
                }
                Err(SubmitError::TooLarge(_)) if count > 1 => self.together = count.div_ceil(2),
                Err(refused) => return Err(refused.into_error()),
            }
        }
        times.total_ms = milliseconds(start);
        Ok(times)
    }

    /// Returns the mean per camera of the last submission.
    fn workload(&self) -> Workload {
        self.workload
    }
}

fn milliseconds(since: Instant) -> f32 {
    since.elapsed().as_secs_f32() * 1e3
}
