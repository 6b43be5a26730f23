//! Default arena for a captured scene without an `arena.toml`: floor, size, and start.
//!
//! A capture has its own axes, unit and origin. The following is assumed, and can be overridden on the command
//! line:
//! - up is scene -y (`--up`): structure from motion starts from an upright camera, y down;
//! - the scene's core is [`CAPTURED_HEIGHT_M`] high between its 2nd and 98th percentile (`--scale`): a room or
//!   a garden as seen by a hand-held camera. The unit itself cannot be determined;
//! - the start is where there is a floor and the twin looks best (see `best_view`);
//! - the floor is the core's 2nd percentile of height; it becomes the world's z = 0, and the middle of the core
//!   the origin.
//!
//! The result is an [`ArenaConfig`] that could have been written by hand; `vizflyt arena new` writes it.

use std::path::Path;

use anyhow::{Context, Result, bail};
use clap::Args;
use glam::{DQuat, DVec3};
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::{
    CameraConfig, EnvironmentConfig, Geofence, METRES_PER_UNIT, Occupancy, RulesConfig,
    SceneConfig, Spawn, Up,
};
use vizflyt_arena::pose::PoseConfig;
use vizflyt_protocol::geometry::{Body, Intrinsics, Pose, World, body_from_forward_cam};
use vizflyt_protocol::messages::Limits;
use vizflyt_splat::{Atmosphere, Camera, CpuRenderer, Rasterizer, RgbdImage, Splats};

use super::core::{SOLID_OPACITY, bounds, core};
use super::fit::LEAST_FLOOR;
use super::floor::floor_share;

/// Command-line options for a scene without an arena.
#[derive(Args, Clone, Copy, Debug, Default, PartialEq)]
pub struct BareArgs {
    /// Axis of the file that points up, for a scene without an arena.toml [default: -y]
    ///
    /// x, -x, y, -y, z or -z.
    #[arg(long, help_heading = "Scene", value_name = "AXIS", allow_hyphen_values = true)]
    pub up: Option<Up>,

    /// Metres per unit of the file, for a scene without an arena.toml
    ///
    /// By default, the core of the scene is assumed to be 3 m high.
    #[arg(long, help_heading = "Scene", value_name = "METRES", value_parser = parse_scale)]
    pub scale: Option<f64>,
}

impl BareArgs {
    /// Rejects the options if an `arena.toml` places the scene.
    ///
    /// # Errors
    /// Names the option, and the alternative.
    pub fn check_unused(&self, arena_toml: &Path) -> Result<()> {
        let flags = match (self.up, self.scale) {
            (None, None) => return Ok(()),
            (Some(_), None) => "--up is",
            (None, Some(_)) => "--scale is",
            (Some(_), Some(_)) => "--up and --scale are",
        };
        bail!(
            "{flags} for a scene without an arena, and {} places its scene itself: set `up` and \
             `metres_per_unit` under [scene] there",
            arena_toml.display()
        );
    }

    /// Returns a description of the guessed parts of the placement; `None` if all was given.
    pub(super) fn guessed(&self, scene: &SceneConfig) -> Option<String> {
        let up = scene.up.unwrap_or(Up::Z);
        let unit =
            format!("{} m per unit, for a height of {CAPTURED_HEIGHT_M} m", scene.metres_per_unit);
        match (self.up, self.scale) {
            (None, None) => Some(format!("{up} is up, and {unit}; correct it by --up and --scale")),
            (None, Some(_)) => Some(format!("{up} is up; correct it by --up")),
            (Some(_), None) => Some(format!("{unit}; correct it by --scale")),
            (Some(_), Some(_)) => None,
        }
    }
}

/// Parses metres per unit of a scene.
///
/// # Errors
/// Text that is not a number, or a scale out of range.
pub fn parse_scale(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| format!("'{text}' is not a number"))?;
    if METRES_PER_UNIT.contains(&value) {
        return Ok(value);
    }
    let (least, most) = METRES_PER_UNIT.into_inner();
    Err(format!("{value} is outside {least} to {most}"))
}

/// Returns the placement that puts a captured scene upright, to scale, onto z = 0, with its middle at the
/// origin. Values missing in `args` are guessed.
pub fn place(splats: &Splats, file: &str, args: &BareArgs) -> SceneConfig {
    let up = args.up.unwrap_or_default();
    let rotation = up.world_from_scene();
    let turn = rotation.as_quat();
    let [min, max] = bounds(core(splats, |mean| turn * mean));
    let height = max.z - min.z;
    let guess = if height > 0.0 { CAPTURED_HEIGHT_M / height } else { 1.0 };
    let (least, most) = METRES_PER_UNIT.into_inner();
    let metres_per_unit = args.scale.unwrap_or_else(|| to_digits(guess).clamp(least, most));
    let middle = (min + max) / 2.0;
    let base = DVec3::new(middle.x, middle.y, min.z);
    // Rounded to millimetres, because it is written into arena.toml.
    let origin_m = (-base * metres_per_unit * 1e3).round() / 1e3;
    SceneConfig { up: Some(up), metres_per_unit, origin_m, ..SceneConfig::in_world(file) }
}

/// Rounds a positive number to three digits, the precision of a guess.
fn to_digits(value: f64) -> f64 {
    format!("{value:.2e}").parse().unwrap_or(value)
}

/// Returns an arena for a scene that is already in the world frame (z up, metres), as placed by `scene`: the
/// fence around its core, the start on the floor where there is room and the view is best, one camera of
/// 320x240, no goal.
///
/// # Errors
/// A scene too large to bake.
pub fn default_arena(splats: &Splats, scene: impl Into<SceneConfig>) -> Result<ArenaConfig> {
    let scene = scene.into();
    let [min, max] = bounds(core(splats, |mean| mean));
    let voxel_m = voxel_m(max - min)?;
    let plan = Plan::of(splats, min - OUTSIDE_M, max + OUTSIDE_M);
    let (spawn, yaw_rad) =
        best_view(splats, &with_room(with_floor(plan.places(), splats, (min, max))));
    let name = Path::new(&scene.file).file_stem();
    let name = name.map_or("scene".into(), |stem| stem.to_string_lossy());
    let name: String = name.chars().filter(char::is_ascii_graphic).take(32).collect();
    // Minimum space to fly, even for a small scene.
    let least = DVec3::new(1.0, 1.0, 0.0);
    let margin = OUTSIDE_M / 2.0;
    let min_m = (min - margin).min(spawn - least);
    let max_m = (max + margin).max(spawn + least);
    let arena = ArenaConfig {
        name: if name.is_empty() { "scene".into() } else { name },
        scene,
        body_radius_m: BODY_RADIUS_M,
        takeoff_height_m: TAKEOFF_HEIGHT_M,
        time_limit_s: 0.0,
        ground_truth: true,
        attitude_rate: false,
        spawn: Spawn { position_m: spawn, yaw_deg: yaw_rad.to_degrees().round() },
        goal: None,
        geofence: Geofence {
            min_m: to_cm(DVec3::new(min_m.x, min_m.y, -0.5)),
            max_m: to_cm(DVec3::new(max_m.x, max_m.y, max_m.z.max(TAKEOFF_HEIGHT_M + 1.0))),
        },
        limits: Limits::new(2.0, 4.0),
        body: Vec::new(),
        no_fly: Vec::new(),
        occupancy: Occupancy { voxel_m, ..Occupancy::default() },
        environment: EnvironmentConfig::default(),
        pose: PoseConfig::default(),
        sensors: Vec::new(),
        vehicles: Vec::new(),
        localization: Vec::new(),
        cameras: vec![CameraConfig::ahead(
            "front",
            [320, 240],
            FOV_DEG,
            DVec3::new(0.06, 0.0, 0.02),
        )],
        stages: Vec::new(),
        objects: Vec::new(),
        rules: RulesConfig::default(),
    };
    arena.validate().context("cannot create an arena for this scene")?;
    Ok(arena)
}

/// Returns the voxel size for a scene of this size: as fine as the memory allows.
///
/// # Errors
/// A scene that is too large for the coarsest size.
fn voxel_m(size_m: DVec3) -> Result<f64> {
    let usual_m = Occupancy::default().voxel_m;
    let volume_m3 = (size_m + 2.0 * OUTSIDE_M).max(DVec3::ONE).element_product();
    let fitting_m = (volume_m3 / VOXELS).cbrt();
    // Rounded up to the next centimetre.
    let voxel_m = if fitting_m <= usual_m { usual_m } else { (fitting_m * 100.0).ceil() / 100.0 };
    if voxel_m <= COARSEST_M {
        return Ok(voxel_m);
    }
    let voxels = volume_m3 / COARSEST_M.powi(3);
    bail!(
        "the scene would be {:.0} x {:.0} x {:.0} m: its obstacles are {voxels:.1e} voxels of \
         {COARSEST_M} m, {:.1e} GB, and {VOXELS:.0e} are the most; give a smaller --scale",
        size_m.x,
        size_m.y,
        size_m.z,
        voxels / 1e9
    );
}

fn to_cm(p_m: DVec3) -> DVec3 {
    (p_m * 100.0).round() / 100.0
}

/// Returns the places within the core that have a floor, or all places if none has one. Outside the core, a few
/// huge splats may look like a floor, but the view is empty.
fn with_floor(
    places: Vec<(u32, DVec3)>,
    splats: &Splats,
    (min, max): (DVec3, DVec3),
) -> Vec<(u32, DVec3)> {
    let min_opacity = Occupancy::default().min_opacity as f32;
    let has_floor = |&(_, p_m): &(u32, DVec3)| {
        let [p, low, high] = [p_m, min, max].map(DVec3::truncate);
        let inside = p.cmpge(low).all() && p.cmple(high).all();
        inside && floor_share(splats, p_m, min_opacity) >= LEAST_FLOOR
    };
    let standing: Vec<_> = places.iter().copied().filter(has_floor).collect();
    if standing.is_empty() { places } else { standing }
}

/// Returns the quarter of the places with the fewest splats in the way, and all places that are as good as the
/// best. [m, world]
fn with_room(mut places: Vec<(u32, DVec3)>) -> Vec<DVec3> {
    places.sort_by_key(|place| place.0);
    let quarter = places.len().div_ceil(4);
    let least = places.first().map_or(0, |place| place.0);
    let free = places.into_iter().enumerate();
    let free = free.filter(|(rank, place)| *rank < quarter || place.0 <= least + FEW_SPLATS);
    free.map(|(_, place)| place.1).collect()
}

/// Returns the place [m, world] and heading [rad] from which, at flight height, the twin looks best: most
/// detail, least directly in front of the lens.
///
/// A capture is sharp only near the positions of its photos, which are not in the file. From elsewhere it is
/// blurred or empty, which is visible in an image. So small images are rendered from all places and compared.
fn best_view(splats: &Splats, places: &[DVec3]) -> (DVec3, f64) {
    let mut renderer = CpuRenderer::new(splats);
    let mut images = vec![RgbdImage::default(); HEADINGS];
    let mut found = (f32::NEG_INFINITY, DVec3::ZERO, 0.0);
    for &place in places {
        let heading_rad = |k: usize| std::f64::consts::TAU * k as f64 / HEADINGS as f64;
        let cameras: Vec<Camera> = (0..HEADINGS)
            .map(|k| {
                let p_world = place + DVec3::Z * TAKEOFF_HEIGHT_M;
                let world_from_body: Pose<World, Body> =
                    Pose::new(p_world, DQuat::from_rotation_z(heading_rad(k)));
                Camera {
                    intrinsics: Intrinsics::from_horizontal_fov(48, 36, FOV_DEG.to_radians()),
                    world_from_cam: world_from_body * body_from_forward_cam(DVec3::ZERO, 0.0),
                    near_m: 0.05,
                    background: [0.0; 3],
                    atmosphere: Atmosphere::CLEAR,
                }
            })
            .collect();
        if renderer.render(&[], &cameras, &mut images).is_err() {
            continue;
        }
        for (k, image) in images.iter().enumerate() {
            let score = detail(image);
            if score > found.0 {
                found = (score, place, heading_rad(k));
            }
        }
    }
    ((found.1 * 100.0).round() / 100.0, found.2)
}

/// Returns the amount of detail: the sum of steps in brightness, each at most a tenth, times the squared share
/// of the image that is not too close. At the edge of a capture, stray splats make sharp spikes before empty
/// space; the share prevents them from winning.
fn detail(image: &RgbdImage) -> f32 {
    let width = image.width_px as usize;
    let grey: Vec<f32> = image.rgb.chunks_exact(3).map(|c| (c[0] + c[1] + c[2]) / 3.0).collect();
    let step = |a: f32, b: f32| (a - b).abs().min(0.1);
    let across: f32 = grey.windows(2).map(|pair| step(pair[0], pair[1])).sum();
    let down: f32 = grey.iter().zip(grey.iter().skip(width)).map(|(a, b)| step(*a, *b)).sum();
    let clear = image.depth_median_m.iter().filter(|&&depth_m| depth_m > CLOSE_M).count();
    let share = clear as f32 / grey.len() as f32;
    (across + down) * share.powi(2)
}

/// Number of splats in each column of air between the floor and the flight height.
struct Plan {
    min: DVec3,
    cells: [usize; 2],
    filled: Vec<u32>,
}

impl Plan {
    fn of(splats: &Splats, min: DVec3, max: DVec3) -> Self {
        let span = (max - min) / CELL_M;
        let cells = [span.x, span.y].map(|cells| (cells.ceil() as usize).clamp(1, MAX_CELLS));
        let mut plan = Self { min, cells, filled: vec![0; cells[0] * cells[1]] };
        for (mean, opacity) in splats.means_m.iter().zip(&splats.opacities) {
            let flown = (0.3..TAKEOFF_HEIGHT_M as f32 + 0.5).contains(&mean.z);
            if flown
                && *opacity >= SOLID_OPACITY
                && let Some(cell) = plan.index(plan.column_and_row(mean.as_dvec3()))
            {
                plan.filled[cell] += 1;
            }
        }
        plan
    }

    /// Returns the column and row of a point, which may be outside the plan.
    fn column_and_row(&self, p: DVec3) -> [i64; 2] {
        let at = (p - self.min) / CELL_M;
        [at.x.floor() as i64, at.y.floor() as i64]
    }

    fn index(&self, [x, y]: [i64; 2]) -> Option<usize> {
        let inside = |value: i64, count| usize::try_from(value).ok().filter(|&v| v < count);
        Some(inside(y, self.cells[1])? * self.cells[0] + inside(x, self.cells[0])?)
    }

    /// Returns places on a grid over the plan, each with the number of splats in its way. [m, world]
    fn places(&self) -> Vec<(u32, DVec3)> {
        let span = DVec3::new(self.cells[0] as f64, self.cells[1] as f64, 0.0) * CELL_M;
        let low = DVec3::new(self.min.x, self.min.y, 0.0);
        let step = (span.x.max(span.y) / PLACES_PER_SIDE).max(0.3);
        let mut places = Vec::new();
        for x in 0..=(span.x / step) as u32 {
            for y in 0..=(span.y / step) as u32 {
                let p = low + DVec3::new(f64::from(x), f64::from(y), 0.0) * step;
                places.push((self.crowd(p), DVec3::new(p.x, p.y, 0.0)));
            }
        }
        places
    }

    /// Returns the number of splats within the body's reach of the column at `p`.
    fn crowd(&self, p: DVec3) -> u32 {
        let [x, y] = self.column_and_row(p);
        let mut sum = 0;
        for row in y - REACH_CELLS..=y + REACH_CELLS {
            for column in x - REACH_CELLS..=x + REACH_CELLS {
                sum += self.index([column, row]).map_or(0, |cell| self.filled[cell]);
            }
        }
        sum
    }
}

/// Assumed height of a capture: a storey. [m]
const CAPTURED_HEIGHT_M: f64 = 3.0;
/// Maximum number of voxels of a default arena: 100 MB.
const VOXELS: f64 = 1e8;
/// Maximum voxel size; coarser voxels leave no room to fly. [m]
const COARSEST_M: f64 = 0.5;
/// Radius of a palm-sized quadrotor of the course. [m]
const BODY_RADIUS_M: f64 = 0.12;
const TAKEOFF_HEIGHT_M: f64 = 1.2;
const FOV_DEG: f64 = 90.0;
/// Places are tried up to this distance outside the scene's bounds: the photographer of a corner stands away
/// from it. [m]
const OUTSIDE_M: DVec3 = DVec3::new(1.0, 1.0, 0.0);
/// At most 81 places with 8 images each: half a second.
const PLACES_PER_SIDE: f64 = 8.0;
const HEADINGS: usize = 8;
/// Number of splats that does not obstruct a take-off.
const FEW_SPLATS: u32 = 3;
/// Objects nearer than this hide the rest. [m]
const CLOSE_M: f32 = 0.7;
/// A body's radius, plus twice as much free space: 0.45 m.
const REACH_CELLS: i64 = 4;
/// Cell size: fine compared with that reach. [m]
const CELL_M: f64 = 0.1;
/// Maximum cells per side: 40 m. Of larger captures only the first corner is used.
const MAX_CELLS: usize = 400;

#[cfg(test)]
mod tests {
    use super::super::Placement;
    use super::*;
    use glam::{Quat, Vec3};

    /// A hollow box of points in scene units, y down, at four times the real scale, with a post in its middle
    /// and haze above.
    fn captured() -> Splats {
        let mut means = Vec::new();
        for i in 0..=40 {
            for j in 0..=40 {
                let (u, v) = (i as f32 / 40.0, j as f32 / 40.0);
                // 24 x 16 units of floor (y = 6) and ceiling (y = -6), and the two long walls.
                means.push(Vec3::new(24.0 * u, 6.0, 16.0 * v));
                means.push(Vec3::new(24.0 * u, -6.0, 16.0 * v));
                means.push(Vec3::new(24.0 * u, 12.0 * v - 6.0, 0.0));
                means.push(Vec3::new(24.0 * u, 12.0 * v - 6.0, 16.0));
            }
        }
        for k in 0..200 {
            means.push(Vec3::new(12.0, 6.0 - 0.06 * k as f32, 8.0));
        }
        let solid = means.len();
        means.extend((0..50).map(|k| Vec3::new(k as f32, -500.0, 900.0)));
        let count = means.len();
        Splats {
            means_m: means,
            scales_m: vec![Vec3::splat(0.1); count],
            rotations: vec![Quat::IDENTITY; count],
            opacities: (0..count).map(|k| if k < solid { 0.9 } else { 0.1 }).collect(),
            sh_degree: 0,
            sh: vec![0.0; count * 3],
            antialiased: false,
        }
    }

    /// Places the scene with these options, and returns the placement.
    fn put(splats: &mut Splats, args: BareArgs) -> SceneConfig {
        let scene = place(splats, "rooms/kitchen.ply", &args);
        Placement::of(&scene).apply(splats);
        scene
    }

    #[test]
    fn places_a_capture_upright_and_to_scale() {
        let mut splats = captured();
        let scene = put(&mut splats, BareArgs::default());
        assert!((scene.metres_per_unit - 0.25).abs() < 0.01, "{scene:?}");
        let [min, max] = bounds(core(&splats, |mean| mean));
        assert!((max.z - 3.0).abs() < 0.01 && min.z.abs() < 0.01);
        // Depth of the scene along x (its z, 16 units), width along y.
        assert!((max.x - 2.0).abs() < 0.1 && (max.y - 3.0).abs() < 0.2);
        let half = BareArgs { scale: Some(0.5), ..BareArgs::default() };
        assert_eq!(put(&mut captured(), half).metres_per_unit, 0.5);
    }

    /// 4 % of opaque sky, 300 units away, must not determine the scene's height.
    #[test]
    fn ignores_sky_in_the_scenes_height() {
        let mut with_sky = captured();
        let sky = (0..280).map(|k| {
            let angle = k as f32 * 2.4;
            Vec3::new(angle.cos(), -0.5 - 0.001 * k as f32, angle.sin()).normalize() * 300.0
        });
        with_sky.means_m.extend(sky);
        let count = with_sky.means_m.len();
        with_sky.opacities.resize(count, 0.95);
        with_sky.scales_m.resize(count, Vec3::splat(5.0));
        with_sky.rotations.resize(count, Quat::IDENTITY);
        with_sky.sh.resize(count * 3, 0.0);
        let scene = put(&mut with_sky, BareArgs::default());
        assert!((scene.metres_per_unit - 0.25).abs() < 0.01, "{scene:?}");
        let arena = default_arena(&with_sky, scene).unwrap();
        assert!((arena.geofence.max_m - arena.geofence.min_m).max_element() < 9.0, "{arena:?}");
    }

    #[test]
    fn the_start_is_clear_of_the_post_and_the_arena_is_valid() {
        let mut splats = captured();
        let scene = put(&mut splats, BareArgs::default());
        let arena = default_arena(&splats, scene).unwrap();
        let spawn = arena.spawn.position_m;
        assert_eq!((arena.name.as_str(), spawn.z), ("kitchen", 0.0));
        let post = spawn.truncate().length();
        assert!(post > 0.3, "the post is {post} m away");
        // Inside the fence with room to spare.
        assert!(arena.geofence().signed_distance_m(spawn) < -0.4);
        let text = arena.to_toml().unwrap();
        assert_eq!(ArenaConfig::parse(&text).unwrap(), arena);
    }

    #[test]
    fn an_empty_or_flat_scene_still_has_an_arena() {
        for count in [0, 1, 5] {
            let mut splats = Splats {
                means_m: vec![Vec3::ZERO; count],
                scales_m: vec![Vec3::splat(0.1); count],
                rotations: vec![Quat::IDENTITY; count],
                opacities: vec![0.9; count],
                sh_degree: 0,
                sh: vec![0.0; count * 3],
                antialiased: false,
            };
            let scene = put(&mut splats, BareArgs { up: Some(Up::Z), scale: None });
            assert_eq!(scene.metres_per_unit, 1.0);
            let arena = default_arena(&splats, scene).unwrap();
            assert!(ArenaConfig::parse(&arena.to_toml().unwrap()).is_ok());
        }
    }

    /// The size is checked before memory is allocated.
    #[test]
    fn rejects_a_scene_too_large_to_bake_with_its_size() {
        let at = |scale: f64| {
            let mut splats = captured();
            let scene = put(&mut splats, BareArgs { up: None, scale: Some(scale) });
            default_arena(&splats, scene)
        };
        let error = format!("{:#}", at(100.0).unwrap_err());
        assert!(error.contains("1600 x 2400 x 1200 m") && error.contains("e10 voxels"), "{error}");
        assert!(error.contains("give a smaller --scale"), "{error}");
        // A campus gets coarser voxels.
        let coarse = at(10.0).unwrap().occupancy.voxel_m;
        assert!((0.3..0.5).contains(&coarse), "{coarse}");
        let fine = at(0.25).unwrap().occupancy.voxel_m;
        assert_eq!(fine, Occupancy::default().voxel_m);
    }
}
