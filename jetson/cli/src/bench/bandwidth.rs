//! `vizflyt bench bandwidth`: network bandwidth that the images of a scene need.

use std::path::PathBuf;

use anyhow::{Result, ensure};
use clap::Args;
use glam::DVec3;
use serde::Serialize;
use vizflyt_process::print_fmt;
use vizflyt_protocol::geometry::{Intrinsics, Pose, body_from_forward_cam};
use vizflyt_rgbd::{Decoder, EncodeOptions, Encoder, RgbdView};
use vizflyt_server::render::{DetailKind, RendererKind, choose};
use vizflyt_server::scene::{BareArgs, load, load_as_it_is};
use vizflyt_server::stream::rate_control::LEVELS;
use vizflyt_splat::{Atmosphere, Camera, Chosen, DepthKind, RgbdImage};
use vizflyt_studio::scene::camera::{self, ImageSize};

/// Measure the network bandwidth that the images of a scene need
///
/// Renders views of a scene, encodes them at each quality level of the rate control, and prints
/// sizes and bit rates.
#[derive(Args, Debug)]
#[command(
    after_help = "The views are those of the given cameras, or eight views of 90 degrees in all \
directions from above the start.

Examples:
  vizflyt bench bandwidth forest/arena.toml
  vizflyt bench bandwidth room.ply --camera a.json --camera b.json --size 640x480 --json"
)]
pub(super) struct BandwidthArgs {
    /// Arena (arena.toml or its folder) or scene file
    scene: PathBuf,
    #[command(flatten)]
    bare: BareArgs,
    /// Camera of a view, as for `vizflyt scene render`; can be repeated
    #[arg(long = "camera", help_heading = "Rendering", value_name = "CAM.json")]
    cameras: Vec<PathBuf>,
    /// Image size; can be repeated [default: 320x240, 640x480, 1280x720]
    #[arg(long, help_heading = "Rendering", value_name = "WxH")]
    size: Vec<ImageSize>,
    /// Renderer: usable graphics card, processor, or any graphics adapter
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "KIND", default_value_t)]
    renderer: RendererKind,
    /// Print a JSON array
    #[arg(long, help_heading = "Output")]
    json: bool,
}

/// One row of the table: images of one size at one level.
#[derive(Debug, Serialize)]
struct Row {
    width_px: u32,
    height_px: u32,
    level: &'static str,
    /// Mean size over the views. [bytes]
    bytes: f64,
    /// Size of the largest image. [bytes]
    bytes_most: usize,
    /// PSNR of the colour of the worst view. [dB]
    psnr_db_least: f64,
    /// Bit rate from the mean size, bitstream only. [Mbit/s]
    mbit_s_at_30_hz: f64,
    mbit_s_at_60_hz: f64,
    mbit_s_at_100_hz: f64,
    /// Number of cameras at 60 Hz that fit on a gigabit link, at [`USABLE_MBIT_S`].
    cameras_on_a_gigabit: usize,
}

/// Runs `vizflyt bench bandwidth`.
pub(super) fn run(args: &BandwidthArgs) -> Result<()> {
    let (splats, views) = if args.cameras.is_empty() {
        let scene = load(&args.scene, &args.bare)?;
        let spawn = scene.arena.spawn;
        let eye_m = spawn.position_m + DVec3::Z * scene.arena.takeoff_height_m;
        let view = |n: u32| {
            let yaw_rad = spawn.yaw_deg.to_radians() + f64::from(n) * std::f64::consts::FRAC_PI_4;
            let heading = glam::DQuat::from_rotation_z(yaw_rad);
            Camera {
                intrinsics: Intrinsics::from_horizontal_fov(640, 480, std::f64::consts::FRAC_PI_2),
                world_from_cam: Pose::new(eye_m, heading) * body_from_forward_cam(DVec3::ZERO, 0.0),
                near_m: 0.1,
                background: [0.0; 3],
                atmosphere: Atmosphere::CLEAR,
            }
        };
        (scene.splats, (0..8).map(view).collect())
    } else {
        ensure!(
            args.bare == BareArgs::default(),
            "--up and --scale do not apply with --camera: its cameras are in the frame of the scene's file"
        );
        let views: Vec<_> =
            args.cameras.iter().map(|path| camera::read(path)).collect::<Result<_>>()?;
        (load_as_it_is(&args.scene)?.1.splats, views)
    };
    let Chosen { mut rasterizer, .. } = choose(&splats, args.renderer, DetailKind::default())?;
    let sizes = if args.size.is_empty() { USUAL_SIZES.to_vec() } else { args.size.clone() };
    let mut rows = Vec::new();
    for size in sizes {
        let mut pixels = Vec::new();
        for view in &views {
            let mut images = [RgbdImage::default()];
            let view = camera::resized(view, size)?;
            rasterizer.render(&[], std::slice::from_ref(&view), &mut images)?;
            let [image] = images;
            pixels.push(Pixels::of(&image));
        }
        rows.extend(
            levels()
                .map(|(name, options)| row(&pixels, name, options))
                .collect::<Result<Vec<_>>>()?,
        );
    }
    if args.json {
        print_fmt!("{}", serde_json::to_string_pretty(&rows)?);
    } else {
        print(&rows);
    }
    Ok(())
}

/// Levels of the rate control that change only the encoding.
fn levels() -> impl Iterator<Item = (&'static str, EncodeOptions)> {
    let as_large = LEVELS.iter().filter(|level| level.keep_one_in == 1 && level.shrink == 1);
    as_large.map(|level| (level.name(), level.options(&EncodeOptions::default())))
}

struct Pixels {
    width: u32,
    height: u32,
    rgb: Vec<u8>,
    depth_mm: Vec<u16>,
}

impl Pixels {
    fn of(image: &RgbdImage) -> Self {
        let (mut rgb, mut depth_mm) = (Vec::new(), Vec::new());
        image.write_rgb8(&mut rgb);
        image.write_depth_mm(DepthKind::Median, &mut depth_mm);
        Self { width: image.width_px, height: image.height_px, rgb, depth_mm }
    }
}

fn row(images: &[Pixels], level: &'static str, options: EncodeOptions) -> Result<Row> {
    let (mut encoder, mut decoder) = (Encoder::new(options), Decoder::new());
    let (mut bytes, mut most, mut least_db) = (0, 0, f64::INFINITY);
    let mut payload = Vec::new();
    for image in images {
        let Pixels { width, height, rgb, depth_mm } = image;
        let view = RgbdView { width: *width, height: *height, rgb, depth_mm };
        encoder.encode(&view, &mut payload)?;
        bytes += payload.len();
        most = most.max(payload.len());
        let mut back = (vec![0; rgb.len()], vec![0; depth_mm.len()]);
        decoder.decode(&payload, &mut back.0, &mut back.1)?;
        least_db = least_db.min(psnr_db(rgb, &back.0));
    }
    let bytes = bytes as f64 / images.len() as f64;
    let mbit_s = |hz: f64| 8.0 * bytes * hz / 1e6;
    Ok(Row {
        width_px: images[0].width,
        height_px: images[0].height,
        level,
        bytes,
        bytes_most: most,
        psnr_db_least: least_db,
        mbit_s_at_30_hz: mbit_s(30.0),
        mbit_s_at_60_hz: mbit_s(60.0),
        mbit_s_at_100_hz: mbit_s(100.0),
        cameras_on_a_gigabit: (USABLE_MBIT_S / mbit_s(60.0)) as usize,
    })
}

fn psnr_db(a: &[u8], b: &[u8]) -> f64 {
    let squares: u64 = a.iter().zip(b).map(|(a, b)| u64::from(a.abs_diff(*b)).pow(2)).sum();
    10.0 * (255.0f64.powi(2) * a.len() as f64 / squares.max(1) as f64).log10()
}

fn print(rows: &[Row]) {
    print_fmt!(
        "                                                           kB            Mbit/s at     dB, on a gigabit"
    );
    print_fmt!(
        "size       level                                        mean  most    30    60   100 Hz least  at 60 Hz"
    );
    for row in rows {
        print_fmt!(
            "{:<10} {:<43} {:>5.0} {:>5.0} {:>5.0} {:>5.0} {:>5.0}    {:>5.1}  {:>4}",
            format!("{}x{}", row.width_px, row.height_px),
            row.level,
            row.bytes / 1e3,
            row.bytes_most as f64 / 1e3,
            row.mbit_s_at_30_hz,
            row.mbit_s_at_60_hz,
            row.mbit_s_at_100_hz,
            row.psnr_db_least,
            row.cameras_on_a_gigabit,
        );
    }
}

const USUAL_SIZES: [ImageSize; 3] = [
    ImageSize { width_px: 320, height_px: 240 },
    ImageSize { width_px: 640, height_px: 480 },
    ImageSize { width_px: 1280, height_px: 720 },
];
/// Capacity of a gigabit link for the bitstream, without the headers of QUIC, UDP, IP and Ethernet.
/// [Mbit/s]
const USABLE_MBIT_S: f64 = 900.0;
