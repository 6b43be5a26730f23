//! CPU renderer: SIMD, all cores, no allocation per image after the first one.
//!
//! Data flow, with the files in run order: `scene` packs the splats once. In adaptive detail, `detail` adds coarser
//! levels, which `merge` computes. Then, per camera: `cull` lists the blocks of splats in view, `project` projects
//! their splats onto the image plane, `sort` orders them by depth, `bin` assigns them to tiles of 16x16 pixels, and
//! `blend` renders the tiles. `cover` computes which blocks of pixels a splat touches. `simd` contains the
//! instruction sets and all unsafe code; every pass is written once, generic over them. `streamed` replaces `scene`
//! and `cull` for scenes larger than memory.
//!
//! Budget on two cores at 3.7 GHz, 125 k splats: 5 ms at 320x240, 11 ms at 640x480.

mod bin;
mod blend;
mod cover;
mod cull;
pub(crate) mod detail;
mod lens;
mod merge;
mod need;
mod project;
pub(crate) mod scene;
pub mod simd;
mod sort;
mod streamed;

use std::borrow::Cow;
use std::time::Instant;

pub use detail::Detail;
pub use need::{Machine, Need};
use simd::{InstructionSet, Simd};
pub use streamed::{Loading, PackSummary, PackedError, PackedScene, Source, Streaming, pack};

pub(crate) use streamed::MAGIC as PACKED_MAGIC;

use crate::rasterizer::{self, PassTimes, Rasterizer, RenderError, Workload};
use crate::{Camera, Placement, RgbdImage, RigidObject, Scene};

/// Renderer that uses all cores of the processor.
#[derive(Debug)]
pub struct CpuRenderer {
    instructions: InstructionSet,
    detail: Detail,
    depth_alone: bool,
    /// Static part, then the objects. In a streamed scene, the static part is a pool of some of its blocks.
    parts: Vec<scene::Part>,
    /// Loader of a packed scene; `None` if the scene is in memory.
    streamed: Option<streamed::Streamed>,
    buffers: Buffers,
}

/// Buffers between the passes; reused for the next image.
#[derive(Debug, Default)]
struct Buffers {
    lenses: lens::Lenses,
    /// Views per part. The view of an absent object is unused, because none of its blocks is visible.
    views: Vec<cull::ObjectView>,
    visible: Vec<cull::Visible>,
    projected: project::Projected,
    sorter: sort::Sorter,
    bins: bin::Bins,
    tiles: Vec<f32>,
}

impl CpuRenderer {
    /// Packs a scene for the fastest instruction set of this processor. Omits splats that no image would show
    /// (opacity below 1/255) and splats with numbers that are not finite.
    pub fn new<'a>(scene: impl Into<Scene<'a>>) -> Self {
        Self::with_detail(scene, Detail::Full)
    }

    /// Same as [`Self::new`], with coarser levels for distant splats if `detail` is adaptive.
    pub fn with_detail<'a>(scene: impl Into<Scene<'a>>, detail: Detail) -> Self {
        Self::with_instructions(scene.into(), detail, InstructionSet::available()[0])
    }

    /// Creates a renderer of a packed scene, in the adaptive detail of the packing. At most `memory_bytes` of its
    /// blocks are in memory at once. Buffers of an image and the objects need additional memory.
    ///
    /// # Errors
    /// If the scene cannot be read or needs more memory.
    pub fn streamed(
        scene: PackedScene,
        objects: &[RigidObject],
        memory_bytes: usize,
        loading: Loading,
    ) -> Result<Self, PackedError> {
        let instructions = InstructionSet::available()[0];
        let detail = Detail::Adaptive { max_error_px: scene.max_error_px() };
        let (streamed, pool) = streamed::Streamed::new(scene, memory_bytes, loading)?;
        let mut parts = vec![pool];
        parts.extend(moving(objects, detail));
        Ok(Self {
            instructions,
            detail,
            depth_alone: false,
            parts,
            streamed: Some(streamed),
            buffers: Buffers::default(),
        })
    }

    /// Returns the statistics of the last image of a packed scene.
    pub fn streaming(&self) -> Option<Streaming> {
        self.streamed.as_ref().map(streamed::Streamed::streaming)
    }

    /// Packs a scene once per instruction set of this processor, fastest first: for tests and benchmarks.
    pub fn every<'a>(scene: impl Into<Scene<'a>>) -> Vec<Self> {
        let scene = scene.into();
        let sets = InstructionSet::available().into_iter();
        sets.map(|set| Self::with_instructions(scene, Detail::Full, set)).collect()
    }

    /// Restricts the next images to median depths and ids, which stay bit-identical; colour, alpha and expected depth
    /// are then unspecified. Faster, because a pixel ends at half of its light.
    pub fn set_depth_alone(&mut self, is_alone: bool) {
        self.depth_alone = is_alone;
    }

    /// Counts the work of the last image of [`Rasterizer::render`], of size `size_px` [px]. Takes many times as long
    /// as rendering.
    pub fn need(&self, size_px: [usize; 2]) -> Need {
        let Buffers { visible, projected, sorter, bins, .. } = &self.buffers;
        Need {
            projected: (visible.len() * scene::BLOCK) as u64,
            visible: sorter.order().len() as u64,
            harmonics_bytes: (self.parts[0].coefficients * 3 * 2) as u64,
            ..need::count(&projected.splats, bins, size_px, self.instructions.lanes())
        }
    }

    /// Measures the maximum throughput of this machine: with this renderer's instruction set, and `bytes` of memory.
    pub fn machine(&self, bytes: usize) -> Machine {
        Machine::measure(self.instructions, bytes)
    }

    /// Returns the packed parts and the allowed error of splats [px]; `None` for a scene larger than memory.
    #[cfg(feature = "gpu")]
    pub(crate) fn packed(&self) -> Option<(&[scene::Part], f32)> {
        self.streamed.is_none().then_some((&self.parts, self.max_error_px()))
    }

    fn max_error_px(&self) -> f32 {
        match self.detail {
            Detail::Full => 0.0,
            Detail::Adaptive { max_error_px } => max_error_px,
        }
    }

    fn with_instructions(scene: Scene<'_>, detail: Detail, instructions: InstructionSet) -> Self {
        let mut parts = vec![scene::Part::new(0, scene.splats, detail)];
        parts.extend(moving(scene.objects, detail));
        let buffers = Buffers::default();
        Self { instructions, detail, depth_alone: false, parts, streamed: None, buffers }
    }

    fn render_one<S: Simd>(
        &mut self,
        simd: S,
        placements: &[Placement],
        camera: &Camera,
        image: &mut RgbdImage,
        times: &mut PassTimes,
    ) -> Result<(), RenderError> {
        let max_error_px = self.max_error_px();
        let Buffers { lenses, views, visible, projected, sorter, bins, tiles } = &mut self.buffers;
        let start = Instant::now();
        views.clear();
        visible.clear();
        let lens = lenses.of(camera);
        let still = cull::ObjectView::new(camera, &lens, &camera.world_from_cam);
        views.push(still);
        if let Some(streamed) = &mut self.streamed {
            let wide = streamed::looking_beyond(camera);
            let soon = cull::ObjectView::new(&wide, &lenses.of(&wide), &camera.world_from_cam);
            let views = streamed::Views { image: &still, soon: &soon };
            let drawn = streamed.cull(&mut self.parts[0], views, visible);
            drawn.map_err(RenderError::Scene)?;
        } else {
            cull::cull(0, &self.parts[0], &still, max_error_px, visible);
        }
        let parts = &self.parts[..];
        for (i, (part, placement)) in parts[1..].iter().zip(placements).enumerate() {
            views.push(still);
            if let Some(world_from_object) = placement {
                let object_from_cam = world_from_object.inverse() * camera.world_from_cam;
                let view = cull::ObjectView::new(camera, &lens, &object_from_cam);
                cull::cull(i + 1, part, &view, max_error_px, visible);
                views[i + 1] = view;
            }
        }
        times.cull_ms += milliseconds(start);
        let start = Instant::now();
        project::project(simd, parts, views, visible, projected);
        times.project_ms += milliseconds(start);
        let start = Instant::now();
        sorter.sort(projected);
        times.sort_ms += milliseconds(start);
        let start = Instant::now();
        bins.bin(simd, &still, projected, sorter.order());
        times.bin_ms += milliseconds(start);
        let start = Instant::now();
        let tagged = blend::Tagged {
            splats: &projected.splats,
            parts,
            visible,
            depth_alone: self.depth_alone,
        };
        blend::blend(simd, &still, bins, &tagged, tiles, image);
        times.blend_ms += milliseconds(start);
        Ok(())
    }
}

impl Rasterizer for CpuRenderer {
    /// Returns `cpu avx512`, `cpu avx2`, `cpu neon` or `cpu portable`, and adds adaptive detail and streaming.
    fn name(&self) -> Cow<'_, str> {
        let name = self.instructions.name();
        match self.detail {
            Detail::Full => name.into(),
            Detail::Adaptive { .. } if self.streamed.is_some() => {
                format!("{name}, adaptive detail, streamed").into()
            }
            Detail::Adaptive { .. } => format!("{name}, adaptive detail").into(),
        }
    }

    fn render(
        &mut self,
        placements: &[Placement],
        cameras: &[Camera],
        images: &mut [RgbdImage],
    ) -> Result<PassTimes, RenderError> {
        rasterizer::validate(self.parts.len() - 1, placements, cameras, images)?;
        let start = Instant::now();
        let mut times = PassTimes::default();
        for (camera, image) in cameras.iter().zip(images) {
            match self.instructions {
                #[cfg(target_arch = "x86_64")]
                InstructionSet::Avx512(simd) => {
                    self.render_one(simd, placements, camera, image, &mut times)?;
                }
                #[cfg(target_arch = "x86_64")]
                InstructionSet::Avx2(simd) => {
                    self.render_one(simd, placements, camera, image, &mut times)?;
                }
                #[cfg(target_arch = "aarch64")]
                InstructionSet::Neon(simd) => {
                    self.render_one(simd, placements, camera, image, &mut times)?;
                }
                InstructionSet::Portable(simd) => {
                    self.render_one(simd, placements, camera, image, &mut times)?;
                }
            }
        }
        times.total_ms = milliseconds(start);
        Ok(times)
    }

    fn workload(&self) -> Workload {
        Workload {
            splats: self.parts.iter().map(|part| part.len).sum(),
            visible: self.buffers.sorter.order().len(),
            pairs: self.buffers.bins.pairs(),
        }
    }
}

/// Packs the objects.
fn moving(objects: &[RigidObject], detail: Detail) -> impl Iterator<Item = scene::Part> {
    objects.iter().map(move |object| scene::Part::new(object.id, &object.splats, detail))
}

fn milliseconds(since: Instant) -> f32 {
    since.elapsed().as_secs_f32() * 1e3
}
