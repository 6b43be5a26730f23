//! A captured scene without an `arena.toml`: finds its floor, its size, and a place to start.
//!
//! A capture has its own axes, unit and origin. What is assumed, and can be overruled on the
//! command line:
//! - up is scene -y (`--up`): structure from motion starts from an upright camera, y down;
//! - the scene is [`CAPTURED_HEIGHT_M`] high between its 2nd and 98th percentile (`--scale`): a room
//!   or a garden as far as a hand-held camera sees it. The unit itself cannot be known;
//! - the floor is the 2nd percentile of height; it becomes the world's z = 0, and the middle of the
//!   scene the origin.
//!
//! Percentiles over splats of opacity 0.5 or more: floaters and sky would ruin minimum and maximum.

use std::path::Path;

use glam::{DVec3, Vec3};
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::{CameraConfig, Geofence, Occupancy, Spawn};
use vizflyt_protocol::messages::Limits;
use vizflyt_splat::Splats;

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
/// robust bounds, the start on the floor where most room is nearest to the middle, nose toward the
/// longest free view, one camera of 320x240, no goal.
///
/// `scene` is what the arena's `scene` key shall say.
pub fn default_arena(splats: &Splats, scene: &Path) -> ArenaConfig {
    let bounds = Bounds::of(splats, |mean| mean);
    let room = Plan::of(splats, &bounds);
    let (spawn, yaw_rad) = room.start();
    let name = scene.file_stem().map_or("scene".into(), |stem| stem.to_string_lossy());
    // Something to fly in, however small the scene.
    let least = DVec3::new(1.0, 1.0, 0.0);
    let margin = DVec3::new(0.5, 0.5, 0.0);
    let min_m = (bounds.min - margin).min(spawn - least);
    let max_m = (bounds.max + margin).max(spawn + least);
    ArenaConfig {
        name: name.chars().filter(char::is_ascii_graphic).take(32).collect(),
        scene: scene.to_string_lossy().into_owned(),
        body_radius_m: BODY_RADIUS_M,
        takeoff_height_m: TAKEOFF_HEIGHT_M,
        time_limit_s: 0.0,
        spawn: Spawn { position_m: spawn, yaw_deg: yaw_rad.to_degrees().round() },
        goal: None,
        geofence: Geofence {
            min_m: DVec3::new(min_m.x, min_m.y, -0.5),
            max_m: DVec3::new(max_m.x, max_m.y, max_m.z.max(TAKEOFF_HEIGHT_M + 1.0)),
        },
        limits: Limits { max_speed_mps: 2.0, max_acceleration_mps2: 4.0 },
        occupancy: Occupancy::default(),
        cameras: vec![CameraConfig {
            name: "front".to_owned(),
            width_px: 320,
            height_px: 240,
            horizontal_fov_deg: 90.0,
            position_m: DVec3::new(0.06, 0.0, 0.02),
            tilt_deg: 0.0,
        }],
        stages: Vec::new(),
    }
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
        let cells = [span.x, span.y].map(|cells| (cells.ceil() as usize).clamp(1, MOST_CELLS));
        let mut plan = Self { min: bounds.min, cells, filled: vec![0; cells[0] * cells[1]] };
        for (mean, opacity) in splats.means_m.iter().zip(&splats.opacities) {
            let flown = (0.3..TAKEOFF_HEIGHT_M as f32 + 0.5).contains(&mean.z);
            if flown
                && *opacity >= SOLID_OPACITY
                && let Some(cell) = plan.cell(mean.as_dvec3())
            {
                plan.filled[cell] += 1;
            }
        }
        plan
    }

    fn cell(&self, p: DVec3) -> Option<usize> {
        let at = |value: f64, count: usize| {
            let cell = (value / CELL_M).floor();
            (cell >= 0.0 && cell < count as f64).then_some(cell as usize)
        };
        let x = at(p.x - self.min.x, self.cells[0])?;
        let y = at(p.y - self.min.y, self.cells[1])?;
        Some(y * self.cells[0] + x)
    }

    fn filled_at(&self, p: DVec3) -> Option<u32> {
        self.cell(p).map(|cell| self.filled[cell])
    }

    /// Returns where to stand [m, world] and where to look [rad].
    fn start(&self) -> (DVec3, f64) {
        let extent = DVec3::new(self.cells[0] as f64, self.cells[1] as f64, 0.0) * CELL_M;
        let middle = DVec3::new(self.min.x, self.min.y, 0.0) + extent / 2.0;
        let mut best = (f64::INFINITY, middle);
        for y in 0..self.cells[1] {
            for x in 0..self.cells[0] {
                let here = DVec3::new(x as f64 + 0.5, y as f64 + 0.5, 0.0) * CELL_M;
                let p = DVec3::new(self.min.x, self.min.y, 0.0) + here;
                // A splat in the way is worth a metre of walking toward the middle.
                let cost = f64::from(self.crowd(p)) + (p - middle).length();
                if cost < best.0 {
                    best = (cost, p);
                }
            }
        }
        let free_view = |step: usize| {
            let yaw_rad = step as f64 * std::f64::consts::TAU / 16.0;
            let nose = DVec3::new(yaw_rad.cos(), yaw_rad.sin(), 0.0);
            let mut cells = 1;
            while self.filled_at(best.1 + nose * CELL_M * f64::from(cells)).is_some_and(|n| n < 3) {
                cells += 1;
            }
            (cells, yaw_rad)
        };
        let longest = (0..16).map(free_view).fold((0, 0.0), |a, b| if b.0 > a.0 { b } else { a });
        ((best.1 * 100.0).round() / 100.0, longest.1)
    }

    /// Returns the number of splats within a body's reach of the column at `p`.
    fn crowd(&self, p: DVec3) -> u32 {
        let reach = 4;
        let mut sum = 0;
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let offset = DVec3::new(f64::from(dx), f64::from(dy), 0.0) * CELL_M;
                sum += self.filled_at(p + offset).unwrap_or(0);
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
/// Fine against the body's reach of 0.45 m. [m]
const CELL_M: f64 = 0.1;
/// 40 m; larger captures are planned over their first corner only.
const MOST_CELLS: usize = 400;

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
        assert!((0.4..1.2).contains(&post), "the post is {post} m away");
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
            };
            assert_eq!(align(&splats, Up::Z, None).scale, 1.0);
            let arena = default_arena(&splats, Path::new("dot.ply"));
            assert!(ArenaConfig::parse(&arena.to_toml().unwrap()).is_ok());
        }
    }
}
