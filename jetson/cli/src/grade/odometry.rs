//! How far off a plugin's own estimate was in a graded flight: as `vizflyt evaluate --align yaw --delta 1s` measures it,
//! against where the simulated vehicle truly was.

use serde::{Deserialize, Serialize};
use vizflyt_protocol::messages::Odometry;

use super::document::millionth;
use crate::evaluate::{Alignment, Association, Delta, Evaluation, Stamped, associate};

/// An estimate counts if the truth is known within so long of it. [s]
const MAX_DIFF_S: f64 = 0.01;
/// Relative errors are taken over so long. [s]
const STEP_S: f64 = 1.0;

/// How far off a flight's published estimate was; origin and heading are the plugin's choice, and found by least squares.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct OdometryScore {
    /// Estimates that were compared.
    pub poses: usize,
    /// Distance from the truth, root of the mean square. [m]
    pub ate_rmse_m: f64,
    /// The greatest. [m]
    pub ate_max_m: f64,
    /// How the way of each second differs, root of the mean square; absent if the estimates are of less. [m]
    pub rpe_trans_rmse_m: Option<f64>,
    /// And the turn. [deg]
    pub rpe_rot_rmse_deg: Option<f64>,
}

impl OdometryScore {
    /// Returns the score of what a plugin published; `None` if that was nothing. Both ascend in time.
    pub(crate) fn of(truth: &[Stamped], published: &[Odometry]) -> Option<Self> {
        let estimate: Vec<Stamped> = published
            .iter()
            .map(|Odometry { stamp, odom_from_body }| Stamped {
                at_s: stamp.as_ns() as f64 * 1e-9,
                position_m: odom_from_body.translation_m,
                rotation: odom_from_body.rotation.normalize(),
            })
            .collect();
        let pairs = associate(truth, &estimate, Association::Interpolate, MAX_DIFF_S);
        let figures = Evaluation::of(&pairs, Alignment::Yaw, Delta::Seconds(STEP_S)).ok()?.figures;
        Some(Self {
            poses: figures.pairs,
            ate_rmse_m: figures.ate_rmse_m,
            ate_max_m: figures.ate_max_m,
            rpe_trans_rmse_m: figures.rpe_trans_rmse_m,
            rpe_rot_rmse_deg: figures.rpe_rot_rmse_deg,
        })
    }

    /// Rounds figures to what a text of them holds.
    pub(crate) fn round(&mut self) {
        let optional = self.rpe_trans_rmse_m.iter_mut().chain(&mut self.rpe_rot_rmse_deg);
        for number in [&mut self.ate_rmse_m, &mut self.ate_max_m].into_iter().chain(optional) {
            *number = millionth(*number);
        }
    }

    /// Returns it in a sentence.
    pub(crate) fn text(&self) -> String {
        let relative = match (self.rpe_trans_rmse_m, self.rpe_rot_rmse_deg) {
            (Some(m), Some(deg)) => format!("; a second's motion is off by {m:.3} m, {deg:.2} deg"),
            _ => String::new(),
        };
        format!(
            "its odometry was off by {:.3} m (rmse of {} poses, {:.3} at most){relative}",
            self.ate_rmse_m, self.poses, self.ate_max_m
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::time::HostTime;

    fn truth() -> Vec<Stamped> {
        let at = |n: u32| {
            let at_s = f64::from(n) * 0.005;
            let position_m = DVec3::new(at_s.cos(), at_s.sin(), 0.1 * at_s);
            Stamped { at_s, position_m, rotation: DQuat::from_rotation_z(at_s) }
        };
        (0..2000).map(at).collect()
    }

    #[test]
    fn origin_and_heading_are_the_plugins_choice_and_drift_is_not() {
        let truth = truth();
        let other =
            Pose::<vizflyt_protocol::geometry::Odom, vizflyt_protocol::geometry::World>::new(
                DVec3::new(5.0, -2.0, 1.0),
                DQuat::from_rotation_z(2.0),
            );
        let estimate = |drift_mps: f64| -> Vec<Odometry> {
            let odometry = |pose: &Stamped| Odometry {
                stamp: HostTime::from_ns((pose.at_s * 1e9) as u64),
                odom_from_body: other
                    * Pose::new(pose.position_m + DVec3::Z * drift_mps * pose.at_s, pose.rotation),
            };
            truth.iter().step_by(7).map(odometry).collect()
        };
        let exact = OdometryScore::of(&truth, &estimate(0.0)).unwrap();
        assert_eq!(exact.poses, 286);
        assert!(exact.ate_rmse_m < 1e-6 && exact.rpe_trans_rmse_m.unwrap() < 1e-6, "{exact:?}");
        // A drift of 2 cm a second over 10 s: uniform within 10 cm of the mean.
        let drifted = OdometryScore::of(&truth, &estimate(0.02)).unwrap();
        assert!((drifted.ate_rmse_m - 0.2 / 12f64.sqrt()).abs() < 1e-3, "{drifted:?}");
        assert!((drifted.rpe_trans_rmse_m.unwrap() - 0.02).abs() < 1e-3, "{drifted:?}");
        assert_eq!(OdometryScore::of(&truth, &[]), None);
        assert_eq!(OdometryScore::of(&[], &estimate(0.0)), None);
    }
}
