//! Obstacle points of the last seconds, in the world frame.
//!
//! The camera sees 90 degrees; what passes out of the image is still there. Points are kept until
//! they are old, far behind, or the camera sees through the place where they were.

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
    /// Distance at the sighting that placed it; nearer sightings are more exact. [m]
    range_m: f64,
    /// Last sighting. [s]
    seen_s: f64,
}

impl Memory {
    /// Forgets what is old, far away or seen through, then adds what the newest image shows
    /// (`points_m` [m, world]) at time `now_s` on any steady clock.
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

/// Long enough to find the way out of a dead end as deep as the camera sees (10 m in and out at
/// 1.5 m/s); points on moving things fade sooner, as they are seen through. [s]
const KEEP_S: f64 = 15.0;
/// The field reaches 8 m to each side; what lies behind its edge is not asked for. [m]
const KEEP_M: f64 = 9.0;
/// Sightings this near to a point are the same point: half a thin trunk, and finer than the
/// clearance of 0.3 m that is kept. [m]
const MERGE_M: f64 = 0.15;
/// A wall all around the field, 4 * 16 m / 0.15 m = 427 points, and then some.
const MAX_POINTS: usize = 512;

#[cfg(test)]
mod tests;
