//! Renders the images of a step. They are small, so each core renders different images with a separate renderer.

use std::io::Write;

use anyhow::{Context, Result};
use rayon::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use vizflyt_protocol::geometry::{Body, Cam, Intrinsics, Pose};
use vizflyt_server::render::environment::atmosphere;
use vizflyt_splat::{
    Atmosphere, Camera, CpuRenderer, Detail, Rasterizer, RenderError, RgbdImage, Scene,
};
use vizflyt_studio::course::CourseInstance;
use vizflyt_studio::scene::camera::ImageSize;

use super::{Env, Place};
use crate::episode::append_depth_mm;

/// Requested layers of the images.
#[derive(Clone, Copy, Debug)]
pub(super) struct Drawn {
    pub(super) depth: bool,
    pub(super) rgb: bool,
}

/// Renderers of a course, and the camera on its vehicles.
pub(super) struct View {
    /// One per core.
    lanes: Vec<Lane>,
    intrinsics: Intrinsics,
    body_from_cam: Pose<Body, Cam>,
    near_m: f32,
    atmosphere: Atmosphere,
    images: Vec<RgbdImage>,
}

/// A renderer, and the single thread on which it renders.
struct Lane {
    pool: ThreadPool,
    renderer: CpuRenderer,
}

impl View {
    /// Creates a view of the course's first camera, with this size and field of view. With `depth_alone`, it renders
    /// only depth. [px, deg]
    pub(super) fn new(
        course: &CourseInstance,
        size: ImageSize,
        fov_deg: Option<f64>,
        max_error_px: f32,
        depth_alone: bool,
    ) -> Result<Self> {
        let config = course.arena.cameras.first().context("the course has no camera")?;
        let ImageSize { width_px, height_px } = size;
        let seen = config.info().intrinsics;
        let own_rad = 2.0 * (f64::from(seen.width_px) / 2.0 / seen.fx_px).atan();
        let fov_rad = fov_deg.map_or(own_rad, f64::to_radians);
        let intrinsics = Intrinsics::from_horizontal_fov(width_px, height_px, fov_rad);
        intrinsics.validate().context("--camera and --fov")?;
        let scene = Scene { splats: &course.splats, objects: &course.objects };
        let lane = |_| {
            let pool = ThreadPoolBuilder::new().num_threads(1).build()?;
            let mut renderer = CpuRenderer::with_detail(scene, Detail::Adaptive { max_error_px });
            renderer.set_depth_alone(depth_alone);
            Ok::<_, ThreadPoolBuildError>(Lane { pool, renderer })
        };
        let lanes: Result<Vec<_>, _> = (0..rayon::current_num_threads()).map(lane).collect();
        Ok(Self {
            lanes: lanes?,
            intrinsics,
            body_from_cam: config.info().body_from_cam,
            near_m: config.near_m as f32,
            atmosphere: atmosphere(&course.arena.environment),
            images: Vec::new(),
        })
    }

    /// Returns height and width. [px]
    pub(super) fn size(&self) -> [u32; 2] {
        [self.intrinsics.height_px, self.intrinsics.width_px]
    }

    fn camera(&self, env: &Env) -> Camera {
        let world_from_cam = env.episode.airframe().state().pose() * self.body_from_cam;
        Camera {
            atmosphere: self.atmosphere,
            ..Camera::new(self.intrinsics, world_from_cam, self.near_m)
        }
    }
}

/// Renders the images of all vehicles, and writes depth of all, then colour of all.
pub(super) fn images(
    out: &mut impl Write,
    envs: &[Env],
    places: &mut [Place],
    drawn: Drawn,
) -> Result<()> {
    for (index, place) in places.iter_mut().enumerate() {
        let (Some(view), objects) = (&mut place.view, &place.rules.obstacles.objects) else {
            continue;
        };
        let here: Vec<&Env> = envs.iter().filter(|env| env.place == index).collect();
        let cameras: Vec<Camera> = here.iter().map(|env| view.camera(env)).collect();
        view.images.resize_with(here.len(), RgbdImage::default);
        let share = here.len().div_ceil(view.lanes.len()).max(1);
        let shares = here.par_chunks(share).zip(cameras.par_chunks(share));
        let shares = shares.zip(view.images.par_chunks_mut(share)).zip(&mut view.lanes);
        shares.try_for_each(|(((envs, cameras), images), lane)| {
            // Moving objects have a different placement in each episode.
            let batch = if objects.is_empty() { cameras.len() } else { 1 };
            let batches =
                envs.chunks(batch).zip(cameras.chunks(batch)).zip(images.chunks_mut(batch));
            lane.pool.install(|| {
                for ((envs, cameras), images) in batches {
                    let placements = objects.placements(envs[0].episode.elapsed_ns());
                    lane.renderer.render(&placements, cameras, images)?;
                }
                Ok::<_, RenderError>(())
            })
        })?;
    }
    let mut bytes = Vec::new();
    if drawn.depth {
        each(envs, places, |image| {
            bytes.clear();
            append_depth_mm(&image.depth_median_m, &mut bytes);
            out.write_all(&bytes)
        })?;
    }
    if drawn.rgb {
        each(envs, places, |image| {
            image.write_rgb8(&mut bytes);
            out.write_all(&bytes)
        })?;
    }
    Ok(())
}

/// Passes the image of each environment, in their order, to `take`.
fn each(
    envs: &[Env],
    places: &[Place],
    mut take: impl FnMut(&RgbdImage) -> std::io::Result<()>,
) -> Result<()> {
    let mut taken = vec![0; places.len()];
    for env in envs {
        let Some(view) = &places[env.place].view else { continue };
        take(&view.images[taken[env.place]])?;
        taken[env.place] += 1;
    }
    Ok(())
}
