//! `vizflyt scene render`: renders images of a scene from given cameras to files.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use glam::DVec3;
use image::{ImageBuffer, Luma, Rgb};
use vizflyt_arena::config::EnvironmentConfig;
use vizflyt_arena::objects::MovingObjects;
use vizflyt_process::print_fmt;
use vizflyt_scenes::Variant;
use vizflyt_server::render::environment::{atmosphere, weather};
use vizflyt_server::render::{DetailKind, RendererKind, choose, open_packed};
use vizflyt_server::scene::{Antialiased, is_in_an_arena, load_as_it_is, load_objects};
use vizflyt_splat::weather::{Moment, WeatherPass};
use vizflyt_splat::{
    Camera, Chosen, DepthKind, Loading, PackedScene, Rasterizer, RgbdImage, Scene,
};

use super::camera;
use super::npy;

/// Render a scene to files, from cameras in its own frame
#[derive(Args, Debug)]
#[command(after_help = "CAM.json:
  {\"fx\": 251.1, \"fy\": 251.1, \"cx\": 160, \"cy\": 120, \"w\": 320, \"h\": 240, \"bg\": [0, 0, 0],
   \"w2c\": [[1,0,0,0], [0,1,0,0], [0,0,1,0], [0,0,0,1]]}
  w2c takes points of the scene file to the camera (x right, y down, z forward); pixel centres at
  +0.5. May also have near_m (0.01), and distortion {\"model\": \"brown-conrady\", \"k1\": ...} or
  {\"model\": \"kannala-brandt\", ...}. `vizflyt scene view` copies one of the current view.

Files:
  png   rgb.png; depth_mm.png (16 bit, millimetres, median, 0 is no return)
  npy   rgb.npy (H,W,3 float32, on bg, unclamped), alpha.npy, depth_expected.npy,
        depth_median.npy (H,W float32, metres along the optical axis, 0 is none), and ids.npy
        (H,W uint16) where objects are seen

Examples:
  vizflyt scene render room.ply --camera cam.json --out pictures
  vizflyt scene render forest/arena.toml --camera a.json --camera b.json --format npy --out poses
  vizflyt scene render race/arena.toml --camera cam.json --at 2.5")]
pub(crate) struct RenderArgs {
    /// Scene file, packed scene (`scene pack`), or arena.toml (then its scene)
    scene: PathBuf,
    /// Light and weather
    #[arg(long, help_heading = "Scene", value_name = "NAME", default_value_t, long_help = format!(
        "Light and weather: {}", Variant::names()
    ))]
    environment: Variant,
    /// Time since the start of the arena's clock, for moving objects and weather
    #[arg(long, help_heading = "Scene", value_name = "SECONDS", default_value_t = 0.0, value_parser = seconds)]
    at: f64,
    /// Seed of weather, and of the initial phase of objects that set none
    #[arg(long, help_heading = "Scene", default_value_t = 7)]
    seed: u64,
    /// Camera file; can be repeated
    ///
    /// With several cameras, each gets a folder of its name in --out.
    #[arg(long = "camera", help_heading = "Rendering", value_name = "CAM.json", required = true)]
    cameras: Vec<PathBuf>,
    /// Renderer: usable graphics card, processor, or any graphics adapter
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "KIND", default_value_t)]
    renderer: RendererKind,
    /// Level of detail for large scenes; flights use adaptive
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "HOW", default_value_t = DetailKind::Full)]
    detail: DetailKind,
    /// Whether the scene was trained with anti-aliasing (mip-splatting)
    ///
    /// auto: as in the arena, or else as in the scene's file.
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "HOW", default_value_t)]
    antialiased: Antialiased,
    /// Memory for the blocks of a packed scene [MiB]
    ///
    /// A packed scene is always rendered with adaptive detail.
    #[arg(long, help_heading = "Rendering", value_name = "MIB", default_value_t = MEMORY_MIB, value_parser = clap::value_parser!(u32).range(1..))]
    memory: u32,
    /// Output folder; created if missing
    #[arg(long, help_heading = "Output", value_name = "DIR", default_value = ".")]
    out: PathBuf,
    /// File format: png for viewing, npy for computing
    #[arg(long, help_heading = "Output", value_enum, default_value_t)]
    format: FileFormat,
}

/// Default memory for the blocks of a packed scene. [MiB]
pub const MEMORY_MIB: u32 = 1024;

#[derive(Clone, Copy, Debug, Default, ValueEnum)]
enum FileFormat {
    /// 8-bit colour and 16-bit depth in millimetres
    #[default]
    Png,
    /// float32 arrays for numpy
    Npy,
}

/// Runs `vizflyt scene render`.
pub(super) fn run(args: &RenderArgs) -> Result<()> {
    // Cameras are read first, so that their errors are reported before the scene is loaded.
    let jobs = jobs(args)?;
    let environment = args.environment.environment();
    let is_metric =
        EnvironmentConfig { light: environment.light, ..EnvironmentConfig::CLEAR } != environment;
    if is_metric && !is_in_an_arena(&args.scene) {
        bail!(
            "--environment {}: weather needs metres and a vertical axis, which {} does not define; give the \
             scene's arena.toml (`vizflyt arena new` creates one)",
            args.environment,
            args.scene.display()
        );
    }
    let (mut rasterizer, moving, start) = opened(args)?;
    let placements = moving.placements((args.at * 1e9).round() as i64);
    print_fmt!("prepared    in {:.0} ms", start.elapsed().as_secs_f64() * 1e3);
    let mut images = [RgbdImage::default()];
    let atmosphere = atmosphere(&environment);
    let at_ns = (args.at * 1e9).round() as i64;
    let moment = Moment { at_ns, v_world_mps: DVec3::ZERO, seed: args.seed };
    let mut pass = WeatherPass::default();
    for RenderJob { camera, folder } in jobs {
        let camera = Camera { atmosphere, ..camera };
        let times = rasterizer.render(&placements, &[camera], &mut images)?;
        pass.apply(&weather(&environment), &camera, &moment, &mut images[0]);
        let [image] = &images;
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("cannot make the folder {}", folder.display()))?;
        match args.format {
            FileFormat::Png => write_png(image, &folder)?,
            FileFormat::Npy => write_npy(image, &folder)?,
        }
        let work = rasterizer.workload();
        print_fmt!(
            "{:<11} {}x{} in {:.1} ms, {} splats in sight",
            folder.display(),
            image.width_px,
            image.height_px,
            times.total_ms,
            work.visible
        );
    }
    Ok(())
}

/// Returns the renderer, the moving objects, and the start time of the preparation.
fn opened(args: &RenderArgs) -> Result<(Box<dyn Rasterizer>, MovingObjects, Instant)> {
    if PackedScene::is_packed(&args.scene) {
        if args.antialiased != Antialiased::default() {
            bail!("--antialiased: a packed scene uses the setting of its original scene");
        }
        let start = Instant::now();
        let memory_bytes = args.memory as usize * (1 << 20);
        let renderer = open_packed(&args.scene, &[], args.renderer, memory_bytes, Loading::Whole)?;
        print_fmt!("scene       {}: {} splats", args.scene.display(), renderer.workload().splats);
        print_fmt!("renderer    {}", renderer.name());
        return Ok((Box::new(renderer), MovingObjects::default(), start));
    }
    let (scene, mut loaded) = load_as_it_is(&args.scene)?;
    args.antialiased.apply(&mut loaded.splats);
    let (objects, moving) = load_objects(&args.scene, args.seed)?;
    let start = Instant::now();
    let twin = Scene { splats: &loaded.splats, objects: &objects };
    let Chosen { rasterizer, reason } = choose(twin, args.renderer, args.detail)?;
    print_fmt!("scene       {}: {} splats", scene.display(), loaded.splats.len());
    if !moving.is_empty() {
        let names: Vec<_> = moving.names().collect();
        print_fmt!("objects     {} at {} s", names.join(", "), args.at);
    }
    if loaded.splats.antialiased {
        print_fmt!("            trained with anti-aliasing, rendered so");
    }
    print_fmt!("renderer    {} ({reason})", rasterizer.name());
    Ok((rasterizer, moving, start))
}

/// Parses a time within the range of a nanosecond clock.
fn seconds(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| format!("'{text}' is not a number of seconds"))?;
    let good = value.is_finite() && value.abs() <= 1e9;
    good.then_some(value).ok_or_else(|| format!("{value} s is out of range: at most 1e9 s"))
}

struct RenderJob {
    camera: Camera,
    folder: PathBuf,
}

fn jobs(args: &RenderArgs) -> Result<Vec<RenderJob>> {
    let mut jobs: Vec<RenderJob> = Vec::new();
    for path in &args.cameras {
        let camera = camera::read(path)?;
        let folder = match &args.cameras[..] {
            [_] => args.out.clone(),
            _ => args.out.join(path.file_stem().unwrap_or(path.as_os_str())),
        };
        if jobs.iter().any(|job| job.folder == folder) {
            bail!(
                "two cameras would write to {}; give their files different names",
                folder.display()
            );
        }
        jobs.push(RenderJob { camera, folder });
    }
    Ok(jobs)
}

fn write_png(image: &RgbdImage, folder: &Path) -> Result<()> {
    let (width, height) = (image.width_px, image.height_px);
    let (mut rgb, mut depth_mm) = (Vec::new(), Vec::new());
    image.write_rgb8(&mut rgb);
    image.write_depth_mm(DepthKind::Median, &mut depth_mm);
    let path = folder.join("rgb.png");
    ImageBuffer::<Rgb<u8>, _>::from_raw(width, height, rgb)
        .expect("three bytes a pixel")
        .save(&path)
        .with_context(|| format!("cannot write {}", path.display()))?;
    let path = folder.join("depth_mm.png");
    ImageBuffer::<Luma<u16>, _>::from_raw(width, height, depth_mm)
        .expect("one depth a pixel")
        .save(&path)
        .with_context(|| format!("cannot write {}", path.display()))
}

fn write_npy(image: &RgbdImage, folder: &Path) -> Result<()> {
    let (height, width) = (image.height_px as usize, image.width_px as usize);
    npy::save(&folder.join("rgb.npy"), &[height, width, 3], &image.rgb)?;
    let shape = [height, width];
    npy::save(&folder.join("alpha.npy"), &shape, &image.alpha)?;
    npy::save(&folder.join("depth_expected.npy"), &shape, &image.depth_expected_m)?;
    npy::save(&folder.join("depth_median.npy"), &shape, &image.depth_median_m)?;
    if image.ids.iter().any(|&id| id != 0) {
        npy::save(&folder.join("ids.npy"), &shape, &image.ids)?;
    }
    Ok(())
}
