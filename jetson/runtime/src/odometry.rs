//! Checks the odometry that a plugin publishes, before it is logged. It is not used for flying.

use vizflyt_protocol::messages::Odometry;
use vizflyt_protocol::time::HostTime;

/// Maximum age of an estimate on arrival; a plugin that closes loops needs time. [s]
const OLDEST_S: f64 = 10.0;
/// Maximum time of a stamp in the future: images show the predicted position of the vehicle. [s]
const AHEAD_S: f64 = 1.0;

/// Accepts poses that are valid, recent, and in the order of their stamps.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct OdometryGate {
    newest: Option<HostTime>,
    refused: u64,
}

impl OdometryGate {
    /// Returns whether the estimate that arrived at `now` is accepted.
    pub(crate) fn takes(&mut self, now: HostTime, odometry: &Odometry) -> bool {
        let age_s = now.seconds_since(odometry.stamp);
        let is_next = self.newest.is_none_or(|newest| odometry.stamp > newest);
        if !(odometry.is_valid() && is_next && (-AHEAD_S..=OLDEST_S).contains(&age_s)) {
            self.refused += 1;
            // Log at 1, 2, 4, 8 ... rejections, so that the log is not flooded.
            if self.refused.is_power_of_two() {
                tracing::warn!(
                    "odometry dropped: an estimate is not a valid pose, not newer than the one before, or not \
                     of the last {OLDEST_S} s ({} dropped)",
                    self.refused
                );
            }
            return false;
        }
        self.newest = Some(odometry.stamp);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};
    use vizflyt_protocol::geometry::Pose;

    #[test]
    fn accepts_recent_poses_in_the_order_of_their_stamps() {
        let mut gate = OdometryGate::default();
        let now = HostTime::from_ns(100_000_000_000);
        let mut takes = |ms: i64, x_m: f64| {
            let stamp = now.plus_ns(ms * 1_000_000);
            let odom_from_body = Pose::new(DVec3::X * x_m, DQuat::IDENTITY);
            gate.takes(now, &Odometry { stamp, odom_from_body })
        };
        assert!(!takes(-10_001, 0.0), "too old");
        assert!(takes(-30, 0.0));
        assert!(!takes(-30, 0.0), "the same instant again");
        assert!(!takes(-20, f64::NAN));
        assert!(!takes(-20, 1e6), "nowhere");
        assert!(takes(-20, 1.0));
        assert!(!takes(-25, 1.0), "before the last");
        assert!(!takes(1001, 1.0), "far ahead");
        assert!(takes(48, 1.0));
    }
}
