//! Track of a vehicle, for the page.

use glam::Vec3;
use vizflyt_protocol::messages::PoseSample;

/// Path of the vehicle since the flight began, thinned to a bounded size.
#[derive(Debug)]
pub struct Track {
    /// (x, y, z [m, world], speed [m/s]), oldest first.
    pub points: Vec<[f32; 4]>,
    spacing_m: f32,
}

impl Default for Track {
    fn default() -> Self {
        Self { points: Vec::new(), spacing_m: MIN_SPACING_M }
    }
}

impl Track {
    /// Adds a pose, if the vehicle has moved enough.
    pub fn add(&mut self, sample: &PoseSample) {
        let p = sample.world_from_body.translation_m.as_vec3();
        let far = self
            .points
            .last()
            .is_none_or(|&[x, y, z, _]| p.distance(Vec3::new(x, y, z)) >= self.spacing_m);
        if !far {
            return;
        }
        if self.points.len() >= MAX_POINTS {
            let mut keep = false;
            self.points.retain(|_| {
                keep = !keep;
                keep
            });
            self.spacing_m *= 2.0;
        }
        self.points.push([p.x, p.y, p.z, sample.twist.linear_mps.length() as f32]);
    }

    /// Clears the track.
    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }
}

/// Minimum spacing: about the vehicle's radius. [m]
const MIN_SPACING_M: f32 = 0.05;
/// Maximum points: 32 KB; 100 m of path at the finest spacing.
const MAX_POINTS: usize = 2048;

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::time::ServerTime;

    use super::*;

    #[test]
    fn track_keeps_its_ends_and_stays_small() {
        let mut track = Track::default();
        for k in 0..20_000 {
            let along = Pose::new(DVec3::X * 0.02 * f64::from(k), DQuat::IDENTITY);
            track.add(&PoseSample::still(ServerTime::ZERO, along));
        }
        assert!(track.points.len() <= MAX_POINTS);
        assert_eq!(track.points[0][0], 0.0);
        assert!(track.points.last().unwrap()[0] > 398.0);
        assert!(track.points.is_sorted_by(|a, b| a[0] < b[0]));
    }
}
