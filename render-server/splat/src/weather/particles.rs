//! Single drops and flakes: their positions, and the streaks that they leave during the exposure.
//!
//! Particles of one kind (size and direction) move together, and so does the lattice of cells that
//! they are generated in. The index of a cell seeds its particles, so the density is correct
//! everywhere, no state is stored, and each particle moves by its velocity times the time.
//! Particles of a kind are drawn up to the distance at which they change an image by [`LEAST`];
//! farther ones are part of the air's extinction.

use glam::{DMat3, DVec3, Mat3, Vec2, Vec3};
use rayon::prelude::*;

use super::random::Random;
use super::rays::Rays;
use crate::Camera;

/// Particles of one size and direction.
#[derive(Clone, Copy, Debug)]
pub(super) struct ParticleKind {
    /// Diameter. [m]
    pub(super) diameter_m: f64,
    /// Number density. [1/m³]
    pub(super) per_m3: f64,
    /// Velocity. [m/s, world]
    pub(super) v_world_mps: DVec3,
}

/// Streak of one particle in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Streak {
    /// Position at the start of the exposure. [px]
    pub(super) from_px: Vec2,
    /// Position at the end of the exposure. [px]
    pub(super) to_px: Vec2,
    /// Diameter of the particle. [px]
    pub(super) width_px: f32,
    /// Depth. [m, cam]
    pub(super) z_m: f32,
    /// Colour, as display values.
    pub(super) color: [f32; 3],
}

/// Minimum opacity of a drawn streak. In front of a dark wall, a fainter streak changes an 8-bit pixel by
/// less than half a step.
const LEAST: f32 = 0.006;
/// Minimum distance of a drawn particle. Nearer ones are out of focus for any lens. [m]
const NEAR_M: f32 = 0.12;
/// Maximum distance of a drawn particle. [m]
const FARTHEST_M: f64 = 12.0;
/// Maximum particles in view. If there are more, the farthest are left to the air's extinction.
const MOST: f64 = 8_000.0;
/// Approximate number of particles per cell.
const PER_CELL: f64 = 4.0;
/// Parts into which a kind is divided, for parallel processing.
const PARTS: usize = 4;

/// Particles in front of one camera, at one instant.
#[derive(Debug, Default)]
pub(super) struct ParticlePass {
    kinds: Vec<(u32, ParticleKind)>,
    /// Streaks of the parts, [`PARTS`] for each kind.
    parts: Vec<Vec<Streak>>,
}

/// Camera among particles.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scene<'a> {
    pub(super) camera: &'a Camera,
    pub(super) rays: &'a Rays,
    /// Velocity of the camera. [m/s, world]
    pub(super) v_world_mps: DVec3,
    pub(super) exposure_s: f64,
    pub(super) at_s: f64,
    pub(super) seed: u64,
}

impl ParticlePass {
    /// Removes all kinds and streaks.
    pub(super) fn clear(&mut self) {
        self.kinds.clear();
        self.parts.iter_mut().for_each(Vec::clear);
    }

    /// Adds kinds. `group` separates the random numbers of rain and snow.
    pub(super) fn add(&mut self, group: u32, kinds: impl Iterator<Item = ParticleKind>) {
        self.kinds.extend(kinds.map(|kind| (group, kind)));
    }

    /// Computes the streaks. `color` returns the colour of a particle, given its group and position
    /// [m, cam].
    pub(super) fn fall(&mut self, scene: &Scene<'_>, color: impl Fn(u32, Vec3) -> [f32; 3] + Sync) {
        let parts = self.kinds.len() * PARTS;
        self.parts.resize_with(parts.max(self.parts.len()), Vec::new);
        let in_view = |shrunk: f64| -> f64 {
            let volume = |kind: &ParticleKind| view_m3(scene, shrunk * reach_m(kind, scene));
            self.kinds.iter().map(|(_, kind)| kind.per_m3 * volume(kind)).sum()
        };
        let shrunk = (MOST / in_view(1.0).max(MOST)).cbrt();
        let kinds = &self.kinds;
        self.parts[..parts].par_iter_mut().enumerate().for_each(|(index, streaks)| {
            let (group, kind) = &kinds[index / PARTS];
            let numbers =
                [i64::from(*group) << 32 | (index / PARTS) as i64, (index % PARTS) as i64];
            let reach_m = shrunk * reach_m(kind, scene);
            Cells::of(kind, scene, reach_m).draw(
                numbers,
                |p_cam_m| color(*group, p_cam_m),
                streaks,
            );
        });
    }

    /// Returns all streaks in a fixed order.
    pub(super) fn streaks(&self) -> impl Iterator<Item = &Streak> {
        self.parts.iter().flatten()
    }
}

/// Returns the opacity of a particle's streak at a depth. [m, cam]
fn opacity_at(kind: &ParticleKind, scene: &Scene<'_>, z_m: f64) -> f32 {
    let px = scene.camera.intrinsics.fx_px / z_m;
    let way_m = (kind.v_world_mps - scene.v_world_mps).length() * scene.exposure_s;
    opacity((kind.diameter_m * px) as f32, (way_m * px) as f32)
}

/// Returns the opacity of a streak. Summed over the streak's area, which is at least a pixel wide,
/// it equals the area of the particle's disc. [px]
fn opacity(width_px: f32, length_px: f32) -> f32 {
    let half = 0.5 * width_px.max(1.0);
    // Area of a round end with a linear border of one pixel.
    let ends = std::f32::consts::PI * (half * half + 1.0 / 12.0);
    std::f32::consts::FRAC_PI_4 * width_px * width_px / (2.0 * half * length_px + ends)
}

/// Returns the distance up to which a kind is drawn. [m]
fn reach_m(kind: &ParticleKind, scene: &Scene<'_>) -> f64 {
    let mut reach_m = FARTHEST_M;
    while opacity_at(kind, scene, reach_m) < LEAST && reach_m > f64::from(NEAR_M) {
        reach_m *= 0.9;
    }
    reach_m
}

/// Returns the volume of a camera's view up to a distance. [m³]
fn view_m3(scene: &Scene<'_>, reach_m: f64) -> f64 {
    let slopes = (scene.rays.high - scene.rays.low).min(Vec2::splat(4.0)).as_dvec2();
    slopes.x * slopes.y * reach_m.powi(3) / 3.0
}

/// Cells of one kind in front of a camera.
struct Cells<'a> {
    kind: &'a ParticleKind,
    scene: &'a Scene<'a>,
    reach_m: f32,
    side_m: f64,
    /// Displacement of the lattice. [m, world]
    moved_m: DVec3,
    from: [i64; 3],
    to: [i64; 3],
    cam_from_world: Mat3,
    /// Displacement of a particle during the exposure. [m, cam]
    way_cam_m: Vec3,
}

impl<'a> Cells<'a> {
    fn of(kind: &'a ParticleKind, scene: &'a Scene<'a>, reach_m: f64) -> Self {
        let side_m = (PER_CELL / kind.per_m3).cbrt().clamp(0.08, 2.0);
        let moved_m = kind.v_world_mps * scene.at_s;
        let Camera { world_from_cam, .. } = scene.camera;
        let turn = DMat3::from_quat(world_from_cam.rotation);
        let (mut low, mut high) = (DVec3::ZERO, DVec3::ZERO);
        let (least, most) = (scene.rays.low.as_dvec2(), scene.rays.high.as_dvec2());
        for x in [least.x, 0.5 * (least.x + most.x), most.x] {
            for y in [least.y, 0.5 * (least.y + most.y), most.y] {
                let end_m = turn * DVec3::new(x, y, 1.0).normalize() * (1.1 * reach_m);
                (low, high) = (low.min(end_m), high.max(end_m));
            }
        }
        let camera_m = world_from_cam.translation_m - moved_m;
        let cell = |at_m: DVec3| (at_m / side_m).floor().to_array().map(|at| at as i64);
        let v_mps = kind.v_world_mps - scene.v_world_mps;
        Self {
            kind,
            scene,
            reach_m: reach_m as f32,
            side_m,
            moved_m,
            from: cell(camera_m + low),
            to: cell(camera_m + high),
            cam_from_world: turn.transpose().as_mat3(),
            way_cam_m: (turn.transpose() * v_mps * scene.exposure_s).as_vec3(),
        }
    }

    /// Computes the streaks of one part. `numbers` are kind and part; the kind is included in the
    /// random seed.
    fn draw(&self, numbers: [i64; 2], color: impl Fn(Vec3) -> [f32; 3], streaks: &mut Vec<Streak>) {
        streaks.clear();
        let [kind, part] = numbers;
        let (from, to) = (self.from, self.to);
        let camera_m = self.scene.camera.world_from_cam.translation_m;
        let side_m = self.side_m as f32;
        // Radius of a sphere around the centre of a cell.
        let radius_m = 0.87 * side_m + self.way_cam_m.length();
        let expected = self.kind.per_m3 * self.side_m.powi(3);
        for x in (from[0]..=to[0]).filter(|x| x.rem_euclid(PARTS as i64) == part) {
            for y in from[1]..=to[1] {
                for z in from[2]..=to[2] {
                    let corner = DVec3::new(x as f64, y as f64, z as f64) * self.side_m;
                    let offset_m = (corner + self.moved_m - camera_m).as_vec3();
                    let corner_m = self.cam_from_world * offset_m;
                    let middle_m = self.cam_from_world * (offset_m + Vec3::splat(0.5 * side_m));
                    if !self.may_be_seen(middle_m, radius_m) {
                        continue;
                    }
                    let mut random = Random::of(self.scene.seed, [kind, x, y, z]);
                    let count = (expected + f64::from(random.unit())) as u32;
                    for _ in 0..count {
                        let within = Vec3::new(random.unit(), random.unit(), random.unit());
                        let p_cam_m = corner_m + self.cam_from_world * (within * side_m);
                        streaks.extend(self.streak(p_cam_m, &color));
                    }
                }
            }
        }
    }

    fn may_be_seen(&self, middle_m: Vec3, radius_m: f32) -> bool {
        let (low, high) = (self.scene.rays.low, self.scene.rays.high);
        let beyond = |offset: f32, slope: f32| offset > radius_m * (1.0 + slope * slope).sqrt();
        let z_m = middle_m.z;
        z_m > -radius_m
            && middle_m.length() < self.reach_m + radius_m
            && !beyond(middle_m.x - high.x * z_m, high.x)
            && !beyond(low.x * z_m - middle_m.x, low.x)
            && !beyond(middle_m.y - high.y * z_m, high.y)
            && !beyond(low.y * z_m - middle_m.y, low.y)
    }

    fn streak(&self, p_cam_m: Vec3, color: &impl Fn(Vec3) -> [f32; 3]) -> Option<Streak> {
        let (low, high) = (self.scene.rays.low, self.scene.rays.high);
        let (from_m, to_m) = (p_cam_m - 0.5 * self.way_cam_m, p_cam_m + 0.5 * self.way_cam_m);
        let is_near_enough = from_m.z.min(to_m.z) >= NEAR_M && p_cam_m.length() <= self.reach_m;
        let seen =
            |from: f32, to: f32, low: f32, high: f32| from.max(to) >= low && from.min(to) <= high;
        let (from, to) = (from_m.truncate() / from_m.z, to_m.truncate() / to_m.z);
        let in_view = seen(from.x, to.x, low.x, high.x) && seen(from.y, to.y, low.y, high.y);
        if !(is_near_enough && in_view) {
            return None;
        }
        let k = &self.scene.camera.intrinsics;
        let width_px = (self.kind.diameter_m * k.fx_px) as f32 / p_cam_m.z;
        let [from_px, to_px] = [from_m, to_m].map(|p_m| k.project(p_m.as_dvec3()));
        let (from_px, to_px) = (from_px?.as_vec2(), to_px?.as_vec2());
        Some(Streak { from_px, to_px, width_px, z_m: p_cam_m.z, color: color(p_cam_m) })
    }
}

impl Streak {
    /// Calls `pixel` with column, row and opacity of every pixel in rows `rows` that the streak
    /// touches. The sum of all opacities is the area of the particle's disc, so light is conserved
    /// for any length of the streak.
    pub(super) fn draw(&self, columns: i32, rows: [i32; 2], mut pixel: impl FnMut(i32, i32, f32)) {
        let half = 0.5 * self.width_px.max(1.0);
        let border = half + 0.5;
        let (low, high) =
            (self.from_px.min(self.to_px) - border, self.from_px.max(self.to_px) + border);
        let clip = |low: f32, high: f32, [from, to]: [i32; 2]| {
            ((low.floor() as i32).max(from), (high.ceil() as i32).min(to))
        };
        let (top, bottom) = clip(low.y, high.y, rows);
        if top >= bottom || !(high.x > 0.0 && low.x < columns as f32) {
            return;
        }
        let way = self.to_px - self.from_px;
        let length = way.length();
        let opacity = opacity(self.width_px, length);
        let along = if length > 1e-3 { way / length } else { Vec2::Y };
        let middle = 0.5 * (self.from_px + self.to_px);
        // Shift of the streak's centre from row to row.
        let slant = along.x / along.y.abs().max(0.05) * along.y.signum();
        for y in top..bottom {
            let down = y as f32 + 0.5 - middle.y;
            let [left, right] = if along.y.abs() > 0.5 {
                let center = middle.x + slant * down;
                let wide = (half + 0.5) / along.y.abs() + 1.0;
                [center - wide, center + wide]
            } else {
                [low.x, high.x]
            };
            let (left, right) = clip(left.max(low.x), right.min(high.x), [0, columns]);
            for x in left..right {
                let offset = Vec2::new(x as f32 + 0.5 - middle.x, down);
                let ahead = (offset.dot(along).abs() - 0.5 * length).max(0.0);
                let aside = offset.perp_dot(along);
                let covered = half + 0.5 - (ahead * ahead + aside * aside).sqrt();
                if covered > 0.0 {
                    pixel(x, y, (opacity * covered.min(1.0)).min(1.0));
                }
            }
        }
    }
}
