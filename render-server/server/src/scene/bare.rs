//! A captured scene without an `arena.toml`: finds its floor, its size, and a place to start.
//!
//! A capture has its own axes, unit and origin. What is assumed, and can be overruled on the
//! command line:
//! - up is scene -y (`--up`): structure from motion starts from an upright camera, y down;
//! - the scene is [`CAPTURED_HEIGHT_M`] high between its 2nd and 98th percentile (`--scale`): a room
//!   or a garden as far as a hand-held camera sees it. The unit itself cannot be known;
//! - the start is where the twin looks best (see `best_view`);
//! - the floor is the 2nd percentile of height; it becomes the world's z = 0, and the middle of the
//!   scene the origin.
//!
//! Percentiles over splats of opacity 0.5 or more: floaters and sky would ruin minimum and maximum.

use std::path::Path;

use glam::{DQuat, DVec3, Vec3};
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::{
    CameraConfig, EnvironmentConfig, Geofence, Occupancy, RulesConfig, Spawn,
};
use vizflyt_arena::pose::PoseConfig;
use vizflyt_protocol::geometry::{Body, Intrinsics, Pose, World, body_from_forward_cam};
use vizflyt_protocol::messages::Limits;
use vizflyt_splat::{Atmosphere, Camera, CpuRenderer, Rasterizer, RgbdImage, Splats};

use super::orient::{Up, WorldFromScene};

/// Returns the similarity that puts a captured scene upright, to size, onto z = 0, its middle at
/// the origin. `scale` is world metres per scene unit; `None` estimates it.
pub fn align(splats: &Splats, up: Up, scale: Option<f64>) -> WorldFromScene {
    let rotation = up.world_from_scene();
    let turn = rotation.as_quat();
    let bounds = Bounds::of(splats, |mean| turn * mean);
    let height = bounds.max.z - bounds.min.z;
    let scale = scale.unwrap_or(if height > 0.0 { CAPTURED_HEIGHT_M / height } else { 1.0 });
    let middle = (bounds.min + bounds.max) / 2.0;
    let base = DVec3::new(middle.x, middle.y, bounds.min.z);
    WorldFromScene { scale, rotation, translation_m: -base * scale }
}

/// Returns an arena for a scene that already lies in the world (z up, metres): the fence around its
/// robust bounds, the start on the floor where there is room and the view is best, one camera of
/// 320x240, no goal.
///
/// `scene` is the value of the arena's `scene` key.
pub fn default_arena(splats: &Splats, scene: &Path) -> ArenaConfig {
    let bounds = Bounds::of(splats, |mean| mean);
    let (spawn, yaw_rad) = best_view(splats, &Plan::of(splats, &bounds).places());
    let name = scene.file_stem().map_or("scene".into(), |stem| stem.to_string_lossy());
    // Something to fly in, however small the scene.
    let least = DVec3::new(1.0, 1.0, 0.0);
    let margin = OUTSIDE_M / 2.0;
    let min_m = (bounds.min - margin).min(spawn - least);
    let max_m = (bounds.max + margin).max(spawn + least);
    ArenaConfig {
        name: name.chars().filter(char::is_ascii_graphic).take(32).collect(),
        scene: scene.to_string_lossy().into_owned(),
        body_radius_m: BODY_RADIUS_M,
        takeoff_height_m: TAKEOFF_HEIGHT_M,
        time_limit_s: 0.0,
        ground_truth: true,
        attitude_rate: false,
        spawn: Spawn { position_m: spawn, yaw_deg: yaw_rad.to_degrees().round() },
        goal: None,
        geofence: Geofence {
            min_m: DVec3::new(min_m.x, min_m.y, -0.5),
            max_m: DVec3::new(max_m.x, max_m.y, max_m.z.max(TAKEOFF_HEIGHT_M + 1.0)),
        },
        limits: Limits::new(2.0, 4.0),
        body: Vec::new(),
        no_fly: Vec::new(),
        occupancy: Occupancy::default(),
        environment: EnvironmentConfig::default(),
        pose: PoseConfig::default(),
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
    }
}

/// Returns the place [m, world] and heading [rad] from which, at the height of the flight, the
/// twin looks best: most detail, least right before the lens.
///
/// A capture is sharp only near where its photographs were taken, and those places are not in the
/// file. But seen from elsewhere it is blur and void, and that a picture shows: so small pictures
/// are rendered from everywhere and compared.
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

/// Returns how much there is to see: the sum of steps in brightness, each counted up to a tenth,
/// times the share of the picture, squared, that shows something not too close. Where a capture
/// ends, stray splats make sharp spikes before a void; the share keeps those from winning.
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

/// Robust corners of a scene.
struct Bounds {
    min: DVec3,
    max: DVec3,
}

impl Bounds {
    fn of(splats: &Splats, place: impl Fn(Vec3) -> Vec3) -> Self {
        let solid = |least: f32| -> Vec<Vec3> {
            let means = splats.means_m.iter().zip(&splats.opacities);
            means.filter(|(_, opacity)| **opacity >= least).map(|(mean, _)| place(*mean)).collect()
        };
        let mut points = solid(SOLID_OPACITY);
        if points.is_empty() {
            points = solid(0.0);
        }
        let mut corners = [[0.0f64; 3]; 2];
        if !points.is_empty() {
            for axis in 0..3 {
                points.sort_unstable_by(|a, b| a[axis].total_cmp(&b[axis]));
                for (corner, share) in corners.iter_mut().zip([EDGE, 1.0 - EDGE]) {
                    let index = (share * (points.len() - 1) as f64).round() as usize;
                    corner[axis] = f64::from(points[index][axis]);
                }
            }
        }
        Self { min: corners[0].into(), max: corners[1].into() }
    }
}

/// How full each column of air is between the floor and above the flight.
struct Plan {
    min: DVec3,
    cells: [usize; 2],
    filled: Vec<u32>,
}

impl Plan {
    fn of(splats: &Splats, bounds: &Bounds) -> Self {
        let span = (bounds.max - bounds.min) / CELL_M;
        let cells = [span.x, span.y].map(|cells| (cells.ceil() as usize).clamp(1, MAX_CELLS));
        let mut plan = Self { min: bounds.min, cells, filled: vec![0; cells[0] * cells[1]] };
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

    /// Returns the column and row of a point, which may lie outside the plan.
    fn column_and_row(&self, p: DVec3) -> [i64; 2] {
        let at = (p - self.min) / CELL_M;
        [at.x.floor() as i64, at.y.floor() as i64]
    }

    fn index(&self, [x, y]: [i64; 2]) -> Option<usize> {
        let inside = |value: i64, count| usize::try_from(value).ok().filter(|&v| v < count);
        Some(inside(y, self.cells[1])? * self.cells[0] + inside(x, self.cells[0])?)
    }

    /// Returns places to stand on, free of splats as far as there are such. [m, world]
    fn places(&self) -> Vec<DVec3> {
        let extent = DVec3::new(self.cells[0] as f64, self.cells[1] as f64, 0.0) * CELL_M;
        let low = DVec3::new(self.min.x, self.min.y, 0.0) - OUTSIDE_M;
        let span = extent + 2.0 * OUTSIDE_M;
        let step = (span.x.max(span.y) / PLACES_PER_SIDE).max(0.3);
        let mut places = Vec::new();
        for x in 0..=(span.x / step) as u32 {
            for y in 0..=(span.y / step) as u32 {
                let p = low + DVec3::new(f64::from(x), f64::from(y), 0.0) * step;
                places.push((self.crowd(p), DVec3::new(p.x, p.y, 0.0)));
            }
        }
        let least = places.iter().map(|place| place.0).min().unwrap_or(0);
        places.retain(|place| place.0 <= least + FEW_SPLATS);
        places.into_iter().map(|place| place.1).collect()
    }

    /// Returns the number of splats within a body's reach of the column at `p`.
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

/// A storey. [m]
const CAPTURED_HEIGHT_M: f64 = 3.0;
/// Share of splats left out at either end.
const EDGE: f64 = 0.02;
/// Below it a splat is haze.
const SOLID_OPACITY: f32 = 0.5;
/// A palm-sized quadrotor of the course. [m]
const BODY_RADIUS_M: f64 = 0.12;
const TAKEOFF_HEIGHT_M: f64 = 1.2;
const FOV_DEG: f64 = 90.0;
/// Places are tried this far outside the scene's bounds: whoever photographs a corner of a room
/// stands away from it. [m]
const OUTSIDE_M: DVec3 = DVec3::new(1.0, 1.0, 0.0);
/// At most 81 places, 8 pictures each: half a second.
const PLACES_PER_SIDE: f64 = 8.0;
const HEADINGS: usize = 8;
/// Single splats are no obstacle to taking off.
const FEW_SPLATS: u32 = 3;
/// Nearer than this a thing hides the rest. [m]
const CLOSE_M: f32 = 0.7;
/// A body's radius, and as much room again twice over: 0.45 m.
const REACH_CELLS: i64 = 4;
/// Fine against that reach. [m]
const CELL_M: f64 = 0.1;
/// 40 m; larger captures are planned over their first corner only.
const MAX_CELLS: usize = 400;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    /// A hollow box of points in scene units, y down, four times as large as life, with a post in
    /// its middle and haze above.
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

    #[test]
    fn a_capture_is_put_upright_and_to_size() {
        let mut splats = captured();
        let similarity = align(&splats, Up::NegY, None);
        assert!((similarity.scale - 0.25).abs() < 0.01, "{similarity:?}");
        similarity.apply(&mut splats);
        let bounds = Bounds::of(&splats, |mean| mean);
        assert!((bounds.max.z - 3.0).abs() < 0.01 && bounds.min.z.abs() < 0.01);
        // Depth of the scene along x (its z, 16 units), width along y.
        assert!((bounds.max.x - 2.0).abs() < 0.1 && (bounds.max.y - 3.0).abs() < 0.2);
        assert_eq!(align(&captured(), Up::NegY, Some(0.5)).scale, 0.5);
    }

    #[test]
    fn the_start_is_clear_of_the_post_and_the_arena_is_valid() {
        let mut splats = captured();
        align(&splats, Up::NegY, None).apply(&mut splats);
        let arena = default_arena(&splats, Path::new("rooms/kitchen.ply"));
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
            let splats = Splats {
                means_m: vec![Vec3::ZERO; count],
                scales_m: vec![Vec3::splat(0.1); count],
                rotations: vec![Quat::IDENTITY; count],
                opacities: vec![0.9; count],
                sh_degree: 0,
                sh: vec![0.0; count * 3],
                antialiased: false,
            };
            assert_eq!(align(&splats, Up::Z, None).scale, 1.0);
            let arena = default_arena(&splats, Path::new("dot.ply"));
            assert!(ArenaConfig::parse(&arena.to_toml().unwrap()).is_ok());
        }
    }
}
