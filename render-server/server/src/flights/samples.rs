//! Samples of one flight for its verdict, at most 50 per second.

use glam::EulerRot;
use vizflyt_arena::verdict::Sample;
use vizflyt_protocol::messages::PoseSample;

/// Samples of a flight, oldest first.
#[derive(Debug)]
pub struct Samples {
    kept: Vec<Sample>,
    apart_s: f64,
    least_clearance_m: f64,
}

impl Default for Samples {
    fn default() -> Self {
        Self { kept: Vec::new(), apart_s: MIN_APART_S, least_clearance_m: f64::INFINITY }
    }
}

impl Samples {
    /// Adds a pose unless the last one is too recent, with the clearance at the pose, and the least swept
    /// clearance of the flight so far. [m]
    pub fn add(&mut self, pose: &PoseSample, clearance_m: f64, least_clearance_m: f64) {
        let last = self.kept.last().map(|sample| sample.stamp);
        if last.is_some_and(|last| pose.stamp.seconds_since(last) < self.apart_s) {
            self.least_clearance_m = least_clearance_m;
            return;
        }
        self.end(pose, clearance_m, least_clearance_m);
    }

    /// Adds the pose at the end of the flight, even if the last one is recent.
    pub fn end(&mut self, pose: &PoseSample, clearance_m: f64, least_clearance_m: f64) {
        self.least_clearance_m = least_clearance_m;
        if self.kept.len() >= MAX_SAMPLES {
            // Halves the rate, so that an hour in the air keeps its shape.
            let mut keep = false;
            self.kept.retain(|_| {
                keep = !keep;
                keep
            });
            self.apart_s *= 2.0;
        }
        // Allocated at once: growing would copy megabytes between two poses. Unused pages take no memory.
        self.kept.reserve_exact(MAX_SAMPLES - self.kept.len());
        self.kept.push(Sample {
            stamp: pose.stamp,
            p_world_m: pose.world_from_body.translation_m,
            v_world_mps: pose.twist.linear_mps,
            yaw_rad: pose.world_from_body.rotation.to_euler(EulerRot::ZYX).0,
            clearance_m,
        });
    }

    pub fn kept(&self) -> &[Sample] {
        &self.kept
    }

    /// Returns the least clearance of the flight so far, swept between all poses; `None` before the first. [m]
    pub fn least_clearance_m(&self) -> Option<f64> {
        self.least_clearance_m.is_finite().then_some(self.least_clearance_m)
    }
}

/// Minimum time between samples: 50 Hz, 10 cm at 5 m/s.
const MIN_APART_S: f64 = 0.019;
/// Maximum samples: a quarter of an hour at 50 Hz, 4 MB.
const MAX_SAMPLES: usize = 45_000;

#[cfg(test)]
mod tests {
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::time::ServerTime;

    use super::*;

    #[test]
    fn memory_is_bounded_and_both_ends_are_kept() {
        let mut samples = Samples::default();
        let start = ServerTime::from_ns(1);
        for n in 0..200_000_u32 {
            let stamp = start.plus_seconds(f64::from(n) * 0.005);
            let at = Pose::new(glam::DVec3::X * f64::from(n), glam::DQuat::IDENTITY);
            samples.add(&PoseSample::still(stamp, at), 1.0, 0.5);
        }
        let kept = samples.kept();
        assert!((MAX_SAMPLES / 2..=MAX_SAMPLES).contains(&kept.len()), "{}", kept.len());
        assert!(kept.is_sorted_by(|a, b| a.stamp < b.stamp));
        assert!(kept[0].p_world_m.x < 100.0 && kept[kept.len() - 1].p_world_m.x > 199_900.0);
        assert_eq!(samples.least_clearance_m(), Some(0.5));
        // The last pose is added, although the one before is a millisecond older.
        let (count, last) = (kept.len(), kept[kept.len() - 1].stamp.plus_seconds(0.001));
        let end = PoseSample::still(last, Pose::new(glam::DVec3::X, glam::DQuat::IDENTITY));
        samples.add(&end, -0.01, -0.01);
        assert_eq!(samples.kept().len(), count);
        samples.end(&end, -0.01, -0.01);
        assert_eq!(samples.kept().last().map(|sample| sample.clearance_m), Some(-0.01));
    }
}
