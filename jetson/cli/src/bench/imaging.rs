//! `vizflyt bench imaging`: cost of simulated camera effects relative to rendering, and a sheet of
//! sample images.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use glam::{DQuat, DVec3};
use image::{Rgb, RgbImage};
use serde::Serialize;
use vizflyt_arena::config::ImagingConfig;
use vizflyt_process::print_fmt;
use vizflyt_protocol::geometry::{Cam, Pose, World};
use vizflyt_server::render::imaging::camera_model;
use vizflyt_server::render::{DetailKind, RendererKind, choose};
use vizflyt_server::scene::load_as_it_is;
use vizflyt_splat::imaging::events::{Event, EventCamera, EventSensor};
use vizflyt_splat::imaging::noise::NoiseKey;
use vizflyt_splat::imaging::{Imager, Shot};
use vizflyt_splat::{Camera, Chosen, Rasterizer, RgbdImage};
use vizflyt_studio::scene::camera::{self, ImageSize};

use super::sheet::{Sheet, coarse, depth_color};

/// Measure the time of simulated image sensors, relative to rendering
#[derive(Args, Debug)]
#[command(
    after_help = "The camera turns left at 60 degrees a second and flies to its right at 1 m/s.
Ratios to rendering come from the same run.

Examples:
  vizflyt bench imaging forest/arena.toml --camera cam.json
  vizflyt bench imaging forest/arena.toml --camera cam.json --size 176x132 --sheet imaging.png"
)]
pub(super) struct ImagingArgs {
    /// Scene file of any format, or an arena.toml (then its scene)
    scene: PathBuf,
    /// Camera, as for `vizflyt scene render`
    #[arg(long, value_name = "CAM.json")]
    camera: PathBuf,
    /// Image size instead of the camera's; the field of view stays the same
    #[arg(long, value_name = "WxH")]
    size: Option<ImageSize>,
    /// Renderer: usable graphics card, processor, or any graphics adapter
    #[arg(long, value_enum, value_name = "KIND", default_value_t)]
    renderer: RendererKind,
    /// Measured images of each kind
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    images: u32,
    /// File for one PNG with sample images of all kinds, side by side
    #[arg(long, value_name = "FILE.png")]
    sheet: Option<PathBuf>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Kinds of cameras: name, settings as in `[cameras.imaging]`, and the part of the image that the
/// sheet shows.
const KINDS: &[(&str, &str, Shown)] = &[
    ("perfect", "{}", Shown::Color),
    (
        "noise: ov5647 bayer, 5 ms in 200 lx",
        r#"{"sensor": "ov5647", "binning": 1, "illuminance_lx": 200, "exposure_ms": 5, "gain": 40, "filter": "bayer",
            "readout_ms": 0}"#,
        Shown::Color,
    ),
    (
        "the same, denoised",
        r#"{"sensor": "ov5647", "binning": 1, "illuminance_lx": 200, "exposure_ms": 5, "gain": 40, "filter": "bayer",
            "readout_ms": 0, "denoise": true}"#,
        Shown::Color,
    ),
    (
        "blur: imx296, 60 ms",
        r#"{"sensor": "imx296", "exposure_ms": 60, "illuminance_lx": 400}"#,
        Shown::Color,
    ),
    (
        "rolling shutter: imx477, 90 ms",
        r#"{"sensor": "imx477", "readout_ms": 90, "max_exposure_ms": 1, "illuminance_lx": 5000}"#,
        Shown::Color,
    ),
    ("grey: ov9281", r#"{"sensor": "ov9281"}"#, Shown::Color),
    ("perfect depth", "{}", Shown::Depth),
    ("d435", r#"{"depth": {"model": "d435"}}"#, Shown::Depth),
    ("d435 without projector", r#"{"depth": {"model": "d435", "projector": false}}"#, Shown::Depth),
    ("azure-kinect", r#"{"depth": {"model": "azure-kinect"}}"#, Shown::Depth),
    ("tofcam-635", r#"{"depth": {"model": "tofcam-635"}}"#, Shown::Depth),
];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Shown {
    Color,
    Depth,
}

/// Output of `--json`.
#[derive(Debug, Serialize)]
struct Figures {
    scene: String,
    width_px: u32,
    height_px: u32,
    renderer: String,
    images: u32,
    render_ms: f64,
    kinds: Vec<Setting>,
}

#[derive(Debug, Serialize)]
struct Setting {
    name: String,
    median_ms: f64,
    of_render: f64,
}

/// Runs `vizflyt bench imaging`.
pub(super) fn run(args: &ImagingArgs) -> Result<()> {
    let camera = camera::read(&args.camera)?;
    let camera = args.size.map_or(Ok(camera), |size| camera::resized(&camera, size))?;
    let (scene, loaded) = load_as_it_is(&args.scene)?;
    let Chosen { mut rasterizer, .. } =
        choose(&loaded.splats, args.renderer, DetailKind::Adaptive)?;
    drop(loaded);
    let path = |at_s: f64| path(&camera, at_s);
    let mut sheet = Sheet::new(camera.intrinsics.width_px, camera.intrinsics.height_px);
    let mut measure = Measure { camera: &camera, path: &path, rasterizer: &mut *rasterizer };
    let (clean, render_ms) = measure.render(args.images)?;
    let mut kinds = Vec::new();
    for &(name, text, shown) in KINDS {
        let config: ImagingConfig = serde_json::from_str(text)?;
        let (image, median_ms) = measure.take(&config, &clean, args.images);
        sheet.add(picture(&image, shown));
        kinds.push(Setting { name: name.to_owned(), median_ms, of_render: median_ms / render_ms });
    }
    let (events, median_ms) = measure.events(&mut sheet)?;
    let name = format!("event camera ({events} events in 20 ms)");
    kinds.push(Setting { name, median_ms, of_render: median_ms / render_ms });
    let renderer = rasterizer.name().into_owned();
    let k = &camera.intrinsics;
    let (width_px, height_px) = (k.width_px, k.height_px);
    let scene = scene.display().to_string();
    let images = args.images;
    let figures = Figures { scene, width_px, height_px, renderer, images, render_ms, kinds };
    if args.json {
        print_fmt!("{}", serde_json::to_string_pretty(&figures)?);
    } else {
        print(&figures);
    }
    // Written last, so that a write error does not lose the results.
    args.sheet.as_ref().map_or(Ok(()), |file| sheet.save(file))
}

fn print(figures: &Figures) {
    let Figures { scene, width_px, height_px, renderer, images, render_ms, kinds } = figures;
    print_fmt!("scene       {scene}, {width_px}x{height_px}, {renderer}, {images} images each");
    print_fmt!("{:<34} {:>8} {:>10}", "median", "ms", "of render");
    print_fmt!("{:<34} {render_ms:>8.2} {:>10.2}", "rendering", 1.0);
    for Setting { name, median_ms, of_render } in kinds {
        print_fmt!("{name:<34} {median_ms:>8.2} {of_render:>10.2}");
    }
}

/// Pose of the camera after `at_s` on its path.
fn path(camera: &Camera, at_s: f64) -> Pose<World, Cam> {
    let moved: Pose<Cam, Cam> =
        Pose::new(DVec3::X * at_s, DQuat::from_rotation_y(-60f64.to_radians() * at_s));
    camera.world_from_cam * moved
}

struct Measure<'a> {
    camera: &'a Camera,
    path: &'a vizflyt_splat::imaging::Path<'a>,
    rasterizer: &'a mut dyn Rasterizer,
}

impl Measure<'_> {
    fn render(&mut self, count: u32) -> Result<(RgbdImage, f64)> {
        let mut images = [RgbdImage::default()];
        let mut times = Vec::new();
        for n in 0..WARM_UP + count {
            let start = Instant::now();
            self.rasterizer.render(&[], std::slice::from_ref(self.camera), &mut images)?;
            if n >= WARM_UP {
                times.push(start.elapsed().as_secs_f64() * 1e3);
            }
        }
        let [image] = images;
        Ok((image, median(&mut times)))
    }

    fn take(&self, config: &ImagingConfig, clean: &RgbdImage, count: u32) -> (RgbdImage, f64) {
        let model = camera_model(config, clean.width_px);
        let mut imager = Imager::default();
        let (mut image, mut times) = (clean.clone(), Vec::new());
        for n in 0..WARM_UP + count {
            image.clone_from(clean);
            let key = NoiseKey::new(7, 0, n.into());
            let at_s = f64::from(n) / 30.0;
            let start = Instant::now();
            let shot = Shot { camera: self.camera, path: self.path, at_s, key };
            imager.apply(&model, &shot, &mut image);
            if n >= WARM_UP {
                times.push(start.elapsed().as_secs_f64() * 1e3);
            }
        }
        (image, median(&mut times))
    }

    /// Simulates 20 ms of an event camera, with an image every 0.5 ms.
    fn events(&mut self, sheet: &mut Sheet) -> Result<(usize, f64)> {
        let (mut camera, mut events, mut times) = (EventCamera::default(), Vec::new(), Vec::new());
        let mut images = [RgbdImage::default()];
        for n in 0..=40u32 {
            let at_s = f64::from(n) * 5e-4;
            let moved = Camera { world_from_cam: (self.path)(at_s), ..*self.camera };
            self.rasterizer.render(&[], &[moved], &mut images)?;
            let start = Instant::now();
            let at_ns = 1 + u64::from(n) * 500_000;
            camera.push(&EventSensor::default(), &images[0], at_ns, &mut events);
            times.push(start.elapsed().as_secs_f64() * 1e3);
        }
        sheet.add(picture_of_events(&events, sheet));
        Ok((events.len(), median(&mut times)))
    }
}

fn median(times: &mut [f64]) -> f64 {
    times.sort_unstable_by(f64::total_cmp);
    times[times.len() / 2]
}

fn picture(image: &RgbdImage, shown: Shown) -> RgbImage {
    RgbImage::from_fn(image.width_px, image.height_px, |x, y| {
        let n = (y * image.width_px + x) as usize;
        match shown {
            Shown::Color => coarse([0, 1, 2].map(|c| image.rgb[3 * n + c])),
            Shown::Depth => depth_color(image.depth_median_m[n], image.alpha[n]),
        }
    })
}

fn picture_of_events(events: &[Event], sheet: &Sheet) -> RgbImage {
    let mut tile = RgbImage::from_pixel(sheet.width_px, sheet.height_px, Rgb([240; 3]));
    for event in events {
        let color = if event.on { [200, 40, 40] } else { [40, 80, 200] };
        tile.put_pixel(event.x.into(), event.y.into(), Rgb(color));
    }
    tile
}

const WARM_UP: u32 = 3;
