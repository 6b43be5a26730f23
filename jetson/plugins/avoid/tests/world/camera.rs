//! A depth camera that casts one ray per pixel at solids.

use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::{Cam, Intrinsics, Pose, Volume, World};

use super::Random;

/// Side of the tiles in which solids are culled. [px]
const TILE_PX: u32 = 8;
/// Maximum range; everything beyond is sky. The plugin uses 10 m. [m]
const FAR_M: f64 = 15.0;

/// Faults of a depth image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Faults {
    /// Standard deviation of depth, as a fraction of depth.
    pub(crate) noise: f64,
    /// Fraction of pixels without a return.
    pub(crate) holes: f64,
    /// Mixes foreground and background along edges, as a blending renderer does.
    pub(crate) blurred_edges: bool,
    /// Value of a pixel of the sky. [mm]
    pub(crate) sky_mm: u16,
}

/// Fills a depth image, row-major. [mm]
pub(crate) fn render(
    volumes: &[Volume],
    k: &Intrinsics,
    world_from_cam: &Pose<World, Cam>,
    faults: Faults,
    random: &mut Random,
    depth_mm: &mut [u16],
) {
    let origin = world_from_cam.translation_m;
    let ray = |x: f64, y: f64| {
        world_from_cam.rotate(DVec3::new((x - k.cx_px) / k.fx_px, (y - k.cy_px) / k.fy_px, 1.0))
    };
    let forward = world_from_cam.rotate(DVec3::Z);
    let near: Vec<&Volume> = volumes
        .iter()
        .filter(|volume| volume.signed_distance_m(origin) < FAR_M)
        .filter(|volume| match **volume {
            Volume::Capsule { a_m, b_m, radius_m } => {
                (a_m - origin).dot(forward).max((b_m - origin).dot(forward)) + radius_m > 0.0
            }
            _ => true,
        })
        .collect();
    let mut ahead: Vec<&Volume> = Vec::new();
    for top in (0..k.height_px).step_by(TILE_PX as usize) {
        for left in (0..k.width_px).step_by(TILE_PX as usize) {
            let half = f64::from(TILE_PX) / 2.0;
            let (x, y) = (f64::from(left) + half, f64::from(top) + half);
            let axis = ray(x, y);
            let spread = (ray(x + half, y + half) - axis).length() / axis.length();
            let axis = axis.normalize();
            ahead.clear();
            ahead.extend(near.iter().filter(|volume| may_hit(volume, origin, axis, spread)));
            for row in top..(top + TILE_PX).min(k.height_px) {
                for column in left..(left + TILE_PX).min(k.width_px) {
                    let direction = ray(f64::from(column) + 0.5, f64::from(row) + 0.5);
                    let depth_m = ahead
                        .iter()
                        .filter_map(|volume| hit(volume, origin, direction))
                        .fold(f64::INFINITY, f64::min);
                    depth_mm[(row * k.width_px + column) as usize] =
                        if depth_m < FAR_M { (depth_m * 1000.0) as u16 } else { faults.sky_mm };
                }
            }
        }
    }
    spoil(k.width_px as usize, faults, random, depth_mm);
}

fn spoil(width: usize, faults: Faults, random: &mut Random, depth_mm: &mut [u16]) {
    if faults.blurred_edges {
        for row in depth_mm.chunks_exact_mut(width) {
            for x in 1..width {
                let (left, right) = (f64::from(row[x - 1]), f64::from(row[x]));
                if left > 0.0 && right > 0.0 && (left - right).abs() > 300.0 {
                    row[x] = (left + (right - left) * random.unit()) as u16;
                }
            }
        }
    }
    for depth_mm in depth_mm {
        if random.unit() < faults.holes {
            *depth_mm = 0;
        } else if *depth_mm > 0 {
            // Sum of three uniform numbers: nearly normal, with a deviation of 1/2.
            let normal = 2.0 * (random.unit() + random.unit() + random.unit() - 1.5);
            let noisy = f64::from(*depth_mm) * (1.0 + faults.noise * normal);
            *depth_mm = noisy.clamp(1.0, 65535.0) as u16;
        }
    }
}

/// Returns whether a cone of rays may touch a solid. False positives are possible.
fn may_hit(volume: &Volume, origin: DVec3, axis: DVec3, spread: f64) -> bool {
    let Volume::Capsule { a_m, b_m, radius_m } = *volume else { return true };
    let (on_ray_m, on_axis_m) = nearest_of_lines(origin, axis, a_m, b_m);
    let distance_m = on_ray_m.distance(on_axis_m);
    let ahead_m = (on_axis_m - origin).dot(axis) + radius_m;
    // Twice the cone's slope, because the cone's nearest point differs from the nearest point of its axis.
    ahead_m > 0.0 && distance_m < radius_m + 2.0 * spread * (ahead_m + radius_m) + 0.05
}

/// Returns the nearest points of a ray and a segment.
fn nearest_of_lines(origin: DVec3, axis: DVec3, a: DVec3, b: DVec3) -> (DVec3, DVec3) {
    let segment = b - a;
    let w = origin - a;
    let (d_s, s_s) = (axis.dot(segment), segment.length_squared());
    let divisor = s_s - d_s * d_s;
    let along = if divisor > 1e-9 { (w.dot(segment) - d_s * w.dot(axis)) / divisor } else { 0.5 };
    let on_segment = a + segment * along.clamp(0.0, 1.0);
    let on_ray = origin + axis * (on_segment - origin).dot(axis).max(0.0);
    (on_ray, on_segment)
}

/// Returns the first intersection of a ray with a solid, in lengths of `direction`.
fn hit(volume: &Volume, origin: DVec3, direction: DVec3) -> Option<f64> {
    match *volume {
        Volume::Sphere { center_m, radius_m } => hit_sphere(origin - center_m, direction, radius_m),
        Volume::Capsule { a_m, b_m, radius_m } => {
            let axis = b_m - a_m;
            let (w, axis_sq) = (origin - a_m, axis.length_squared());
            let (d_a, w_a) = (direction.dot(axis), w.dot(axis));
            let a = direction.length_squared() * axis_sq - d_a * d_a;
            let half_b = w.dot(direction) * axis_sq - w_a * d_a;
            let c = (w.length_squared() - radius_m * radius_m) * axis_sq - w_a * w_a;
            let root = half_b * half_b - a * c;
            if root < 0.0 {
                return None;
            }
            let t = (-half_b - root.sqrt()) / a;
            let along = w_a + t * d_a;
            if t > 0.0 && along > 0.0 && along < axis_sq {
                return Some(t);
            }
            let end_m = if along <= 0.0 { a_m } else { b_m };
            hit_sphere(origin - end_m, direction, radius_m)
        }
        Volume::Cuboid { center_m, half_m, rotation } => {
            let o = rotation.conjugate() * (origin - center_m);
            let d = rotation.conjugate() * direction;
            let (t1, t2) = ((-half_m - o) / d, (half_m - o) / d);
            let (enter, leave) = (t1.min(t2).max_element(), t1.max(t2).min_element());
            (enter < leave && enter > 0.0).then_some(enter)
        }
        Volume::HalfSpace { normal, offset_m } => {
            let t = (offset_m - normal.dot(origin)) / normal.dot(direction);
            (t > 0.0).then_some(t)
        }
    }
}

fn hit_sphere(from_center: DVec3, direction: DVec3, radius_m: f64) -> Option<f64> {
    let a = direction.length_squared();
    let half_b = from_center.dot(direction);
    let root = half_b * half_b - a * (from_center.length_squared() - radius_m * radius_m);
    let t = (-half_b - root.max(0.0).sqrt()) / a;
    (root >= 0.0 && t > 0.0).then_some(t)
}
