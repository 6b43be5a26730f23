//! `vizflyt bench sensors`: cost of LiDARs, range finders, sonars and radars in a scene, and a
//! sheet of samples.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use glam::{DQuat, DVec3};
use image::{Rgb, RgbImage};
use serde::Serialize;
use vizflyt_process::print_fmt;
use vizflyt_protocol::geometry::{Pose, Sensor, World, body_from_forward_cam};
use vizflyt_server::scene::load_as_it_is;
use vizflyt_splat::sensor::presets::{self, PRESETS, Preset};
use vizflyt_splat::sensor::{
    Beams, Lidar, LidarPoint, Radar, RangeFinder, SensorMotion, SensorScene, Sonar,
};
use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, RgbdImage, Scene};
use vizflyt_studio::scene::camera;

use super::sheet::{Sheet, coarse, depth_color};

/// Measure the time of simulated LiDARs, range finders, sonars and radars
///
/// Compares each sensor with an image from the same place.
#[derive(Args, Debug)]
#[command(
    after_help = "The sensor has the pose of the camera and looks along its axis. It flies forward at 2 m/s and
turns left at 90 degrees a second. Times are for all cores. If other programs run, use the
minimum; with RAYON_NUM_THREADS=1 it is close to the processor time.

The sheet has one picture per sensor, in the order of the list. Spinning LiDARs, range finders,
sonars and radars are drawn from above, sensor in the centre, forward up, one ring per metre;
other LiDARs as the image of their beams. Grey: scan of a LiDAR without noise. LiDAR points are
blue below the sensor and red above it. A cone ends at its reading. Radar detections are red if
they approach, blue if they recede.

Examples:
  vizflyt bench sensors forest/arena.toml --camera cam.json
  vizflyt bench sensors forest/arena.toml --camera cam.json --sensor vlp-16 --sheet sensors.png"
)]
pub(super) struct SensorsArgs {
    /// Scene file of any format, or an arena.toml (then its scene)
    scene: PathBuf,
    /// Camera file with the pose of the sensors, as for `vizflyt scene render`
    #[arg(long, value_name = "CAM.json")]
    camera: PathBuf,
    /// Sensor to measure [default: all]; can be repeated
    #[arg(long, value_name = "NAME", value_parser = known)]
    sensor: Vec<String>,
    /// Measured records of each sensor
    #[arg(long, value_name = "N", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    count: u32,
    /// File for one PNG with sample records of all sensors, side by side
    #[arg(long, value_name = "FILE.png")]
    sheet: Option<PathBuf>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

fn known(name: &str) -> Result<String, String> {
    match presets::preset(name) {
        Some(_) => Ok(name.to_owned()),
        None => Err(format!("known sensors: {}", presets::names())),
    }
}

/// Output of `--json`.
#[derive(Debug, Serialize)]
struct Figures {
    scene: String,
    splats: usize,
    packed_ms: f64,
    kinds: Vec<Subject>,
}

#[derive(Debug, Serialize)]
struct Subject {
    name: String,
    least_ms: f64,
    median_ms: f64,
    /// Records of the last measurement, without gaps.
    records: usize,
}

/// Runs `vizflyt bench sensors`.
pub(super) fn run(args: &SensorsArgs) -> Result<()> {
    let camera = camera::read(&args.camera)?;
    let (scene, loaded) = load_as_it_is(&args.scene)?;
    let start = Instant::now();
    let packed = SensorScene::new(&loaded.splats);
    let packed_ms = start.elapsed().as_secs_f64() * 1e3;
    let motion = motion_from(&camera);
    // Many more beams than any sensor has; used only for pictures.
    let seen = if args.sheet.is_some() { surroundings(&packed, &motion)? } else { Vec::new() };
    let around = TopView::new(&seen);
    let mut kinds = vec![image(Scene::from(&loaded.splats), &camera, args.count)?];
    let mut sheet = Sheet::new(TILE_PX, TILE_PX);
    for (name, _, preset) in PRESETS {
        if args.sensor.is_empty() || args.sensor.iter().any(|asked| asked == name) {
            let mut top = around.clone();
            let (kind, tile) = measure(name, preset(), &packed, &motion, (args.count, &mut top))?;
            kinds.push(kind);
            sheet.add(tile.unwrap_or(top.picture));
        }
    }
    let scene = scene.display().to_string();
    let figures = Figures { scene, splats: loaded.splats.len(), packed_ms, kinds };
    if args.json {
        print_fmt!("{}", serde_json::to_string_pretty(&figures)?);
    } else {
        print(&figures);
    }
    // Written last, so that a write error does not lose the results.
    args.sheet.as_ref().map_or(Ok(()), |file| sheet.save(file))
}

fn print(figures: &Figures) {
    let Figures { scene, splats, packed_ms, kinds } = figures;
    print_fmt!("scene       {scene}, {splats} splats, packed in {packed_ms:.1} ms");
    print_fmt!("{:<16} {:>9} {:>9} {:>8}", "ms", "least", "median", "records");
    for Subject { name, least_ms, median_ms, records } in kinds {
        print_fmt!("{name:<16} {least_ms:>9.3} {median_ms:>9.3} {records:>8}");
    }
}

/// Returns the sensor's motion from the camera's pose within 0.1 s.
fn motion_from(camera: &Camera) -> SensorMotion<'static> {
    let body = camera.world_from_cam * body_from_forward_cam(DVec3::ZERO, 0.0).inverse();
    let begin: Pose<World, Sensor> = Pose::new(body.translation_m, body.rotation);
    let flown: Pose<Sensor, Sensor> =
        Pose::new(DVec3::X * 0.2, DQuat::from_rotation_z(9f64.to_radians()));
    SensorMotion { world_from_sensor: [begin, begin * flown], objects: &[], duration_s: 0.1 }
}

/// Scans all around the start pose with a LiDAR without noise.
fn surroundings(scene: &SensorScene, motion: &SensorMotion<'_>) -> Result<Vec<LidarPoint>> {
    let mut model = presets::os1(64);
    let elevations_rad = (0..64).map(|n| (60.0 - 1.9 * n as f32).to_radians()).collect();
    model.beams = Beams::Spinning { elevations_rad, columns: 2048 };
    (model.sigma_m, model.sigma_per_m, model.min_range_m) = (0.0, 0.0, 0.05);
    let mut points = Vec::new();
    let standing = SensorMotion::standing(motion.world_from_sensor[0]);
    Lidar::new(model)?.scan(scene, &standing, 1, 0, &mut points)?;
    Ok(points)
}

fn image(scene: Scene<'_>, camera: &Camera, count: u32) -> Result<Subject> {
    let mut renderer = CpuRenderer::new(scene);
    let mut images = [RgbdImage::default()];
    let (width, height) = (camera.intrinsics.width_px, camera.intrinsics.height_px);
    timed(&format!("image {width}x{height}"), count, |_| {
        renderer.render(&[], std::slice::from_ref(camera), &mut images)?;
        Ok(images[0].alpha.len())
    })
}

/// Measures a sensor. Draws its last record into the top view, or, for a LiDAR with a grid of
/// beams, returns it as a picture.
fn measure(
    name: &str,
    preset: Preset,
    scene: &SensorScene,
    motion: &SensorMotion<'_>,
    (count, top): (u32, &mut TopView),
) -> Result<(Subject, Option<RgbImage>)> {
    let (mut tile, has_range) = (None, |range_m: f32| usize::from(range_m > 0.0));
    let kind = match preset {
        Preset::Lidar(model) => {
            let (lidar, mut points) = (Lidar::new(model)?, Vec::new());
            let kind = timed(name, count, |seq| {
                lidar.scan(scene, motion, 1, seq, &mut points)?;
                Ok(points.iter().filter(|point| point.range_m > 0.0).count())
            })?;
            match &lidar.model().beams {
                Beams::Raster { rows, columns, .. } | Beams::Flash { rows, columns, .. } => {
                    tile = Some(raster(&points, *rows, *columns));
                }
                Beams::Spinning { .. } | Beams::Rosette { .. } => top.add_points(&points),
            }
            kind
        }
        Preset::Range(model) => {
            let (finder, mut range_m) = (RangeFinder::new(model)?, 0.0);
            let kind = timed(name, count, |seq| {
                range_m = finder.measure(scene, motion, 1, seq)?.range_m;
                Ok(has_range(range_m))
            })?;
            top.add_cone(finder.model().fov_rad / 2.0, range_m);
            kind
        }
        Preset::Sonar(model) => {
            let (sonar, mut range_m) = (Sonar::new(model)?, 0.0);
            let kind = timed(name, count, |seq| {
                range_m = sonar.measure(scene, motion, 1, seq)?.range_m;
                Ok(has_range(range_m))
            })?;
            top.add_cone(sonar.model().beam_rad / 2.0, range_m);
            kind
        }
        Preset::Radar(model) => {
            let (mut radar, mut found) = (Radar::new(model)?, Vec::new());
            let kind = timed(name, count, |seq| {
                radar.measure(scene, motion, 1, seq, &mut found)?;
                Ok(found.len())
            })?;
            for it in &found {
                let (sin, cos) = it.azimuth_rad.sin_cos();
                let away = (it.speed_mps / 2.0).clamp(-1.0, 1.0);
                let color = coarse([0.5 - 0.5 * away, 0.1, 0.5 + 0.5 * away]);
                top.dot([it.range_m * cos, it.range_m * sin], 2, color);
            }
            kind
        }
    };
    Ok((kind, tile))
}

fn timed(name: &str, count: u32, mut measure: impl FnMut(u64) -> Result<usize>) -> Result<Subject> {
    let (mut times, mut records) = (Vec::new(), 0);
    for seq in 0..count.into() {
        let start = Instant::now();
        records = measure(seq)?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_unstable_by(f64::total_cmp);
    let (least_ms, median_ms) = (times[0], times[times.len() / 2]);
    Ok(Subject { name: name.to_owned(), least_ms, median_ms, records })
}

/// Draws the beams in their grid, coloured by range.
fn raster(points: &[LidarPoint], rows: u32, columns: u32) -> RgbImage {
    // Beams are square; the longer side fills the picture.
    let scale = TILE_PX as f32 / rows.max(columns) as f32;
    let (width, height) = (columns as f32 * scale, rows as f32 * scale);
    let (left, above) = ((TILE_PX as f32 - width) / 2.0, (TILE_PX as f32 - height) / 2.0);
    RgbImage::from_fn(TILE_PX, TILE_PX, |x, y| {
        let (column, row) = ((x as f32 - left) / scale, (y as f32 - above) / scale);
        if column < 0.0 || row < 0.0 || column >= columns as f32 || row >= rows as f32 {
            return BACKGROUND;
        }
        let beam = row as usize * columns as usize + column as usize;
        depth_color(points[beam].range_m, 1.0)
    })
}

/// Top view of the sensor's surroundings, x up and y to the left.
#[derive(Clone)]
struct TopView {
    picture: RgbImage,
    px_per_m: f32,
}

impl TopView {
    /// Chooses a scale that shows most of the surroundings, 2 to 8 m.
    fn new(seen: &[LidarPoint]) -> Self {
        let mut aside_m: Vec<f32> = seen
            .iter()
            .filter(|point| point.range_m > 0.0)
            .map(|point| point.p_sensor_m[0].hypot(point.p_sensor_m[1]))
            .collect();
        aside_m.sort_unstable_by(f32::total_cmp);
        let most_m = aside_m.get(aside_m.len() * 9 / 10).map_or(8.0, |most_m| most_m * 1.2);
        let picture = RgbImage::from_pixel(TILE_PX, TILE_PX, BACKGROUND);
        let px_per_m = TILE_PX as f32 / 2.0 / most_m.clamp(2.0, 8.0);
        let mut view = Self { picture, px_per_m };
        for point in seen.iter().filter(|point| point.range_m > 0.0 && point.p_sensor_m[2] < 1.0) {
            view.dot([point.p_sensor_m[0], point.p_sensor_m[1]], 0, Rgb([208; 3]));
        }
        for ring_m in 1..12u8 {
            view.arc(f32::from(ring_m), std::f32::consts::PI, Rgb([232, 220, 200]));
        }
        view.dot([0.0; 2], 2, Rgb([0; 3]));
        view
    }

    fn add_points(&mut self, points: &[LidarPoint]) {
        for point in points.iter().filter(|point| point.range_m > 0.0) {
            let [x, y, z] = point.p_sensor_m;
            let above = (z / 3.0).clamp(-0.5, 0.5);
            self.dot([x, y], 0, coarse([0.5 + above, 0.15, 0.5 - above]));
        }
    }

    fn add_cone(&mut self, half_rad: f32, range_m: f32) {
        let ends_m = if range_m > 0.0 { range_m } else { 12.0 };
        let color = Rgb([40, 80, 200]);
        for n in 0..(ends_m * self.px_per_m) as u32 {
            let at_m = n as f32 / self.px_per_m;
            for side in [-half_rad, half_rad] {
                self.dot([at_m * side.cos(), at_m * side.sin()], 0, color);
            }
        }
        if range_m > 0.0 {
            for wider_px in 0..3u8 {
                self.arc(
                    range_m + f32::from(wider_px) / self.px_per_m,
                    half_rad,
                    Rgb([200, 40, 40]),
                );
            }
        }
    }

    /// Draws an arc across the sensor's axis, from one side to the other.
    fn arc(&mut self, range_m: f32, half_rad: f32, color: Rgb<u8>) {
        let steps = (2.0 * half_rad * range_m * self.px_per_m).ceil().max(1.0);
        for n in 0..=steps as u32 {
            let angle = half_rad * (2.0 * n as f32 / steps - 1.0);
            self.dot([range_m * angle.cos(), range_m * angle.sin()], 0, color);
        }
    }

    /// Draws a square, `wider_px` to each side of its pixel. [m, sensor]
    fn dot(&mut self, [x_m, y_m]: [f32; 2], wider_px: i32, color: Rgb<u8>) {
        let middle = TILE_PX as f32 / 2.0;
        let (column, row) = (middle - y_m * self.px_per_m, middle - x_m * self.px_per_m);
        for x in column as i32 - wider_px..=column as i32 + wider_px {
            for y in row as i32 - wider_px..=row as i32 + wider_px {
                if let (Ok(x), Ok(y)) = (u32::try_from(x), u32::try_from(y))
                    && let Some(pixel) = self.picture.get_pixel_mut_checked(x, y)
                {
                    *pixel = color;
                }
            }
        }
    }
}

const TILE_PX: u32 = 240;
const BACKGROUND: Rgb<u8> = Rgb([248; 3]);
