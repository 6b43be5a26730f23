//! Obstacle points of the last seconds, in the world frame.
//!
//! The camera has a field of view of 90 degrees, but obstacles outside the image still exist. A point is kept until it
//! is old, far away, or the camera sees through its position.

use vizflyt_sdk::glam::DVec3;

use crate::scan::View;

/// A bounded set of obstacle points.
#[derive(Clone, Debug, Default)]
pub struct Memory {
    points: Vec<Remembered>,
}

#[derive(Clone, Copy, Debug)]
struct Remembered {
    p_m: DVec3,
    /// Distance at the sighting that placed the point; nearer sightings are more exact. [m]
    range_m: f64,
    /// Time of the last sighting. [s]
    seen_s: f64,
}

impl Memory {
    /// Removes points that are old, far away or seen through, then adds the points of the newest image (`points_m` [m,
    /// world]). `now_s` is the time on any steady clock.
    pub fn update(&mut self, now_s: f64, view: &View<'_>, points_m: &[DVec3]) {
        let camera_m = view.world_from_cam.translation_m;
        self.points.retain(|point| {
            let age_s = now_s - point.seen_s;
            (0.0..KEEP_S).contains(&age_s)
                && point.p_m.distance(camera_m) < KEEP_M
                && !view.sees_through(point.p_m)
        });
        for &p_m in points_m {
            let sighting = Remembered { p_m, range_m: p_m.distance(camera_m), seen_s: now_s };
            let same = |point: &Remembered| {
                point.p_m.truncate().distance_squared(p_m.truncate()) < MERGE_M * MERGE_M
            };
            match self.points.iter().position(same) {
                Some(at) if sighting.range_m < self.points[at].range_m => {
                    self.points[at] = sighting;
                }
                Some(at) => self.points[at].seen_s = now_s,
                None if self.points.len() < MAX_POINTS => self.points.push(sighting),
                None => self.replace_oldest(sighting),
            }
        }
    }

    /// Returns the points. [m, world]
    pub fn points_m(&self) -> impl Iterator<Item = DVec3> {
        self.points.iter().map(|point| point.p_m)
    }

    fn replace_oldest(&mut self, sighting: Remembered) {
        if let Some(oldest) = self.points.iter_mut().min_by(|a, b| a.seen_s.total_cmp(&b.seen_s)) {
            *oldest = sighting;
        }
    }
}

/// Long enough to find the way out of a dead end as deep as the camera's range (10 m in and out at 1.5 m/s). Points on
/// moving objects disappear earlier, because the camera sees through them. [s]
const KEEP_S: f64 = 15.0;
/// The field extends 8 m in each direction and does not use points further away. [m]
const KEEP_M: f64 = 9.0;
/// Sightings within this distance are the same point: half of a thin trunk, and finer than the minimum clearance of 0.3
/// m. [m]
const MERGE_M: f64 = 0.15;
/// Enough for a wall around the complete field: 4 * 16 m / 0.15 m = 427 points.
const MAX_POINTS: usize = 512;

#[cfg(test)]
mod tests;
