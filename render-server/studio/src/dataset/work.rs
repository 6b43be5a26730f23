//! Rendering of a data set: scenes one after the other, with their images on all threads. Complete images are skipped.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use anyhow::{Context, Result};
use serde_json::Value;
use vizflyt_process::print_fmt;
use vizflyt_process::processor_seconds;
use vizflyt_scenes::projects::CourseProject;
use vizflyt_server::scene::{BareArgs, PartsFile};

use super::classes::Classes;
use super::render::{LabelRenderer, Layers, Wanted};
use super::sheet::Sheet;
use super::shot::Shooting;
use super::store::{ImageName, Layer, Store};
use super::world::World;
use crate::labels::{layers, picture};
use crate::shard::Shard;

/// Checked settings of a data set.
pub(super) struct Plan {
    /// Settings that determine the files, for `dataset.json`.
    pub(super) asked: Value,
    pub(super) source: SceneSource,
    pub(super) parts: PartsFile,
    pub(super) shooting: Shooting,
    pub(super) classes: Classes,
    pub(super) things: Vec<String>,
    pub(super) min_area_px: u32,
    pub(super) seeds: u32,
    pub(super) images: u64,
    pub(super) val: f64,
    pub(super) layers: Vec<Layer>,
    pub(super) wanted: Wanted,
    pub(super) jpeg: Option<u8>,
    pub(super) shard: Option<Shard>,
    pub(super) threads: Option<usize>,
}

/// Source of the scenes.
pub(super) enum SceneSource {
    Project(Box<CourseProject>),
    Scene(PathBuf, BareArgs),
}

/// Rendered images and times.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Rendered {
    pub(super) images: usize,
    /// Time for rendering and writing, without the preparation of scenes. [s]
    pub(super) seconds: f64,
    pub(super) processor_seconds: f64,
}

impl Plan {
    /// Returns the index of an image's scene, from 0.
    fn scene(&self, index: u64) -> u64 {
        // The last scene with its first image at or before `index`.
        ((index + 1) * u64::from(self.seeds)).div_ceil(self.images) - 1
    }

    /// Returns the images of a scene.
    fn of_scene(&self, scene: u64) -> std::ops::Range<u64> {
        let first = |scene: u64| scene * self.images / u64::from(self.seeds);
        first(scene)..first(scene + 1)
    }

    /// Returns `train` or `val`. The last images are held out, or the last complete scenes if there are several.
    pub(super) fn split(&self, index: u64) -> &'static str {
        let held_out = |count: u64| ((count as f64 * self.val).ceil() as u64).min(count - 1);
        let is_val = if self.seeds > 1 {
            let seeds = u64::from(self.seeds);
            self.scene(index) >= seeds - held_out(seeds)
        } else {
            index >= self.images - held_out(self.images)
        };
        if is_val { "val" } else { "train" }
    }

    /// Returns the splits with images.
    pub(super) fn splits(&self) -> Vec<&'static str> {
        if self.split(self.images - 1) == "val" { vec!["train", "val"] } else { vec!["train"] }
    }

    /// Calls `with` with the name data of an image.
    pub(super) fn with_name<T>(&self, index: u64, with: impl FnOnce(&ImageName<'_>) -> T) -> T {
        let scene = self.scene(index);
        let within = (index - self.of_scene(scene).start) as usize;
        let seed = self.seed(scene);
        let scene = match &self.source {
            SceneSource::Project(project) => format!("{}-{seed}", project.name()),
            SceneSource::Scene(..) => format!("scene-{seed}"),
        };
        let at_ns = self.shooting.at_ns(within, self.count(index));
        with(&ImageName { index, split: self.split(index), scene: &scene, at_ns })
    }

    /// Whether an image is complete.
    pub(super) fn is_there(&self, store: &Store, index: u64) -> bool {
        self.with_name(index, |name| store.has(name))
    }

    fn count(&self, index: u64) -> usize {
        let images = self.of_scene(self.scene(index));
        (images.end - images.start) as usize
    }

    fn seed(&self, scene: u64) -> u64 {
        self.shooting.seed.wrapping_add(scene)
    }

    /// Whether an image belongs to the requested shard. Shards are consecutive images, so that each needs few scenes.
    fn is_mine(&self, index: u64) -> bool {
        self.shard.is_none_or(|shard| {
            let part = u128::from(index) * u128::from(shard.count) / u128::from(self.images);
            part == u128::from(shard.index - 1)
        })
    }

    fn world(&self, scene: u64) -> Result<World> {
        let (how, seed) = (&self.shooting.randomize, self.seed(scene));
        match &self.source {
            SceneSource::Project(project) => {
                World::generate(project, seed, how, &self.parts, &self.classes)
            }
            SceneSource::Scene(path, bare) => {
                World::load(path, bare, seed, how, &self.parts, &self.classes)
            }
        }
    }
}

/// Renders all missing images.
///
/// # Errors
/// The first image or scene that fails. Complete images stay.
pub(super) fn render_all(plan: &Plan, store: &Store) -> Result<Rendered> {
    let mut rendered = Rendered::default();
    for scene in 0..u64::from(plan.seeds) {
        let mine = plan.of_scene(scene).filter(|&index| plan.is_mine(index));
        let todo: Vec<u64> = mine.filter(|&index| !plan.is_there(store, index)).collect();
        if todo.is_empty() {
            continue;
        }
        let start = Instant::now();
        let world = plan.world(scene)?;
        print_fmt!(
            "{:<11} {} things, {} gates, in {:.1} s; {} images",
            world.name,
            world.things.len(),
            world.gates.len(),
            start.elapsed().as_secs_f64(),
            todo.len()
        );
        let (start, before) = (Instant::now(), processor_seconds()?);
        render_scene(plan, store, &world, &todo)?;
        rendered.images += todo.len();
        rendered.seconds += start.elapsed().as_secs_f64();
        rendered.processor_seconds += processor_seconds()? - before;
    }
    Ok(rendered)
}

fn render_scene(plan: &Plan, store: &Store, world: &World, todo: &[u64]) -> Result<()> {
    let available = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = plan.threads.unwrap_or(available).min(todo.len());
    let next = AtomicUsize::new(0);
    let failed = Mutex::new(None);
    let worker = || -> Result<()> {
        let mut renderer = LabelRenderer::new(world, &plan.classes);
        let mut layers = Layers::default();
        while let Some(&index) = todo.get(next.fetch_add(1, Ordering::Relaxed)) {
            render_one(plan, store, world, index, &mut renderer, &mut layers)
                .with_context(|| format!("image {index}"))?;
        }
        Ok(())
    };
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                // Each image is rendered on one thread; the cores work on different images.
                let pool =
                    rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build();
                let done = pool.context("cannot start a thread").and_then(|_pool| worker());
                if let Err(error) = done {
                    // The other threads stop before their next image.
                    next.store(todo.len(), Ordering::Relaxed);
                    failed
                        .lock()
                        .unwrap_or_else(std::sync::PoisonError::into_inner)
                        .get_or_insert(error);
                }
            });
        }
    });
    let failed = failed.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
    failed.map_or(Ok(()), Err)
}

fn render_one(
    plan: &Plan,
    store: &Store,
    world: &World,
    index: u64,
    renderer: &mut LabelRenderer<'_>,
    layers: &mut Layers,
) -> Result<()> {
    let (scene, count) = (plan.scene(index), plan.count(index));
    let within = (index - plan.of_scene(scene).start) as usize;
    let shot = plan.shooting.shot(world, within, count)?;
    renderer.render(&shot, plan.wanted, layers)?;
    let size = [shot.intrinsics.width_px, shot.intrinsics.height_px];
    plan.with_name(index, |name| -> Result<()> {
        for &layer in &plan.layers {
            if layer == Layer::Next && shot.next.is_none() {
                continue;
            }
            store.write(&store.layer(layer, name), &encoded(plan, layer, layers, size)?)?;
        }
        let record = renderer.record(&shot, index, name.split, name.scene, &plan.classes, layers);
        store.finish(name, &record)
    })
}

fn encoded(plan: &Plan, layer: Layer, layers: &Layers, size: [u32; 2]) -> Result<Vec<u8>> {
    let colour = |rgb: &[u8]| match plan.jpeg {
        Some(quality) => picture::jpeg(rgb, size, quality),
        None => picture::rgb8(rgb, size),
    };
    let file = match layer {
        Layer::Rgb => colour(&layers.rgb),
        Layer::Next => colour(&layers.next),
        Layer::Depth => {
            let mut mm = Vec::new();
            layers::depth_mm(&layers.depth_m, &mut mm);
            picture::grey16(&mm, size)
        }
        Layer::Normals => picture::rgb8(&layers.normals, size),
        Layer::Instances => picture::grey16(&layers.instances, size),
        Layer::Classes => picture::grey8(&layers.classes, size),
        Layer::Flow => picture::rgb16(&layers.flow, size),
    };
    Ok(file?)
}

/// Renders some images again with all layers, and writes the overview.
pub(super) fn write_sheet(plan: &Plan, path: &Path) -> Result<()> {
    let rows = plan.images.min(SHEET_ROWS);
    let mut sheet = Sheet::default();
    let mut current: Option<(u64, World)> = None;
    let mut layers = Layers::default();
    for row in 0..rows {
        let index = row * plan.images / rows;
        let scene = plan.scene(index);
        if current.as_ref().is_none_or(|(there, _)| *there != scene) {
            current = Some((scene, plan.world(scene)?));
        }
        let Some((_, world)) = &current else { continue };
        let mut renderer = LabelRenderer::new(world, &plan.classes);
        let within = (index - plan.of_scene(scene).start) as usize;
        let shot = plan.shooting.shot(world, within, plan.count(index))?;
        let all = Wanted { next: false, normals: true, classes: true, flow: true };
        renderer.render(&shot, all, &mut layers)?;
        let record = renderer.record(&shot, index, "", &world.name, &plan.classes, &layers);
        sheet.add(&shot.intrinsics, &layers, &record);
    }
    sheet.write(path)
}

const SHEET_ROWS: u64 = 6;
