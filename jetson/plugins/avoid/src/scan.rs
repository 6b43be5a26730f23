//! Converts a depth image to obstacle points at the vehicle's flight height.
//!
//! The image is divided into [`COLUMNS`] vertical strips. Each strip gives at most one point: the nearest surface
//! between the floor and a little above the vehicle. Heights are computed in the world frame with the camera's full
//! attitude, so that neither the floor nor a pitched nose during acceleration makes a false obstacle. About 20 000
//! pixels are read for any image size: 0.2 ms.

use vizflyt_sdk::glam::{DVec3, Vec3};
use vizflyt_sdk::{Cam, Intrinsics, Pose, World};

/// A depth image and the pose of its camera.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// Camera-z depth, row-major H x W; 0 means no return. [mm, cam]
    pub depth_mm: &'a [u16],
    /// Size, focal lengths, principal point. [px]
    pub intrinsics: Intrinsics,
    /// Pose of the camera at the time of the image. [m, world]
    pub world_from_cam: Pose<World, Cam>,
}

impl View<'_> {
    /// Returns the depth at a column and row; `None` outside the image or without a return. [m, cam]
    fn depth_m(&self, x: f64, y: f64) -> Option<f64> {
        let (width, height) = (self.intrinsics.width_px, self.intrinsics.height_px);
        if !(x >= 0.0 && y >= 0.0 && x < f64::from(width) && y < f64::from(height)) {
            return None;
        }
        let index = y as usize * width as usize + x as usize;
        let depth_mm = *self.depth_mm.get(index)?;
        (depth_mm > 0).then(|| f64::from(depth_mm) * 1e-3)
    }

    /// Returns whether the image shows a surface well behind `p_world_m`, so that the point is free. Pixels without a
    /// return do not count, because they do not prove free space.
    pub fn sees_through(&self, p_world_m: DVec3) -> bool {
        let p_cam_m = self.world_from_cam.inverse().transform_point(p_world_m);
        let Some(pixel) = self.intrinsics.project(p_cam_m) else {
            return false;
        };
        let behind_m = p_cam_m.z * (1.0 + SEE_THROUGH_RATIO) + SEE_THROUGH_M;
        // Check the point and four neighbours, because one pixel next to a trunk's edge proves nothing.
        [(0.0, 0.0), (-2.0, 0.0), (2.0, 0.0), (0.0, -2.0), (0.0, 2.0)].iter().all(|(dx, dy)| {
            self.depth_m(pixel.x + dx, pixel.y + dy).is_some_and(|depth_m| depth_m > behind_m)
        })
    }
}

/// Result of scanning one image.
#[derive(Clone, Debug, Default)]
pub struct Scan {
    /// Obstacle points, at most one per strip. [m, world]
    pub points_m: Vec<DVec3>,
    /// Fraction of the read pixels with a return, 0 to 1.
    pub valid_fraction: f64,
}

impl Scan {
    /// Replaces the scan by the scan of a new image, for a vehicle at height `flight_z_m` [m, world].
    pub fn update(&mut self, view: &View<'_>, flight_z_m: f64) {
        self.points_m.clear();
        self.valid_fraction = 0.0;
        let k = &view.intrinsics;
        let (width, height) = (k.width_px as usize, k.height_px as usize);
        if width * height == 0 || view.depth_mm.len() < width * height {
            return;
        }

        // A pixel (x, y) at depth d lies at origin + d * (forward + right * a(x) + down * b(y)).
        let origin = view.world_from_cam.translation_m.as_vec3();
        let [right, down, forward] =
            [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| view.world_from_cam.rotate(axis).as_vec3());
        let (stride_x, stride_y) = ((width / 160).max(1), (height / 120).max(1));
        let columns = COLUMNS.min(width);
        let (mut looked_at, mut valid) = (0_u32, 0_u32);

        for column in 0..columns {
            let mut bins = [Bin::default(); BINS];
            let (first, end) = (column * width / columns, (column + 1) * width / columns);
            for y in (0..height).step_by(stride_y) {
                let b = (y as f64 + 0.5 - k.cy_px) / k.fy_px;
                let row_ray = forward + down * b as f32;
                for x in (first..end).step_by(stride_x) {
                    looked_at += 1;
                    let depth_mm = view.depth_mm[y * width + x];
                    if depth_mm == 0 {
                        continue;
                    }
                    valid += 1;
                    let a = (x as f64 + 0.5 - k.cx_px) / k.fx_px;
                    let offset = (row_ray + right * a as f32) * (f32::from(depth_mm) * 1e-3);
                    let range_m = offset.truncate().length();
                    let z_m = f64::from(origin.z + offset.z);
                    let floor_m = FLOOR_M + FLOOR_RATIO * f64::from(range_m);
                    if range_m < FAR_M && z_m > floor_m && (z_m - flight_z_m).abs() < HALF_BAND_M {
                        let bin = &mut bins[bin_of(range_m)];
                        bin.count += 1;
                        bin.sum += offset;
                    }
                }
            }
            // Add two neighbouring bins, because a surface may lie on their border.
            let pair = bins.windows(2).find(|pair| pair[0].count + pair[1].count >= SUPPORT);
            if let Some([near, next]) = pair {
                let found = if near.count >= SUPPORT { *near } else { near.merged(next) };
                self.points_m.push((origin + found.sum / found.count as f32).as_dvec3());
            }
        }
        self.valid_fraction = f64::from(valid) / f64::from(looked_at.max(1));
    }

    /// Returns whether the image has too few returns to fly by.
    pub fn is_blind(&self) -> bool {
        !(self.valid_fraction >= BLIND_FRACTION)
    }
}

/// Pixels of a strip at about the same range.
#[derive(Clone, Copy, Default)]
struct Bin {
    count: u32,
    sum: Vec3,
}

impl Bin {
    fn merged(self, other: &Self) -> Self {
        Self { count: self.count + other.count, sum: self.sum + other.sum }
    }
}

fn bin_of(range_m: f32) -> usize {
    let octaves = (range_m.max(NEAR_M) / NEAR_M).log2();
    ((octaves * BINS_PER_OCTAVE) as usize).min(BINS - 1)
}

/// Number of strips: 4 pixels of 320, so that a trunk of 0.12 m radius fills a strip at 9 m (0.24 m / 9 m * 160 px =
/// 4.3 px).
pub const COLUMNS: usize = 80;
/// Maximum range of obstacles, because the field extends 8 m. At 3.6 m/s that is 2 s. [m]
pub const FAR_M: f32 = 9.0;
/// All nearer surfaces are in the first bin. [m]
const NEAR_M: f32 = 0.1;
/// With nine bins per octave, each is 8 % of the range: wider than the noise of a surface, narrower than the distance
/// between two trunks.
const BINS_PER_OCTAVE: f32 = 9.0;
/// log2(9 m / 0.1 m) * 9 = 58.4.
const BINS: usize = 60;
/// Minimum number of pixels on a surface; fewer are speckle or the blur along an edge.
const SUPPORT: u32 = 3;
/// Surfaces within this distance above and below the flight height are obstacles: body radius 0.12 m, height error 0.1
/// m, and the rest for hanging branches. [m]
const HALF_BAND_M: f64 = 0.45;
/// Lower surfaces are floor or undergrowth, which the vehicle flies over. [m, world]
const FLOOR_M: f64 = 0.3;
/// Increases that limit with range: an attitude error of 0.03 rad lifts the floor by 3 cm per metre.
const FLOOR_RATIO: f64 = 0.03;
/// A point is removed if the image shows more depth by at least this distance plus this fraction. Wider than the blur
/// of a splat's surface, narrower than a trunk. [m]
const SEE_THROUGH_M: f64 = 0.25;
const SEE_THROUGH_RATIO: f64 = 0.05;
/// With a smaller fraction of returns, the camera is covered or broken. The emptiest real image, sky over a strip of
/// floor, has more.
const BLIND_FRACTION: f64 = 0.05;

#[cfg(test)]
mod tests;
