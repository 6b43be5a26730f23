//! Error of a plugin's own estimate in a graded flight, compared with the true pose, as in `vizflyt
//! evaluate --align yaw --delta 1s`.

use vizflyt_protocol::messages::Odometry;
use vizflyt_studio::evaluate::{Alignment, Association, Delta, Evaluation, Stamped, associate};

use super::document::OdometryScore;

/// Maximum time between an estimate and a true pose. [s]
const MAX_DIFF_S: f64 = 0.01;
/// Interval of relative errors. [s]
const STEP_S: f64 = 1.0;

/// Returns the score of published estimates; `None` for an empty list. Both lists are sorted by
/// time.
pub(crate) fn odometry_score(truth: &[Stamped], published: &[Odometry]) -> Option<OdometryScore> {
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
    Some(OdometryScore {
        poses: figures.pairs,
        ate_rmse_m: figures.ate_rmse_m,
        ate_max_m: figures.ate_max_m,
        rpe_trans_rmse_m: figures.rpe_trans_rmse_m,
        rpe_rot_rmse_deg: figures.rpe_rot_rmse_deg,
    })
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::time::HostTime;

    use super::*;

    fn truth() -> Vec<Stamped> {
        let at = |n: u32| {
            let at_s = f64::from(n) * 0.005;
            let position_m = DVec3::new(at_s.cos(), at_s.sin(), 0.1 * at_s);
            Stamped { at_s, position_m, rotation: DQuat::from_rotation_z(at_s) }
        };
        (0..2000).map(at).collect()
    }

    #[test]
    fn ignores_origin_and_heading_and_measures_drift() {
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
        let exact = odometry_score(&truth, &estimate(0.0)).unwrap();
        assert_eq!(exact.poses, 286);
        assert!(exact.ate_rmse_m < 1e-6 && exact.rpe_trans_rmse_m.unwrap() < 1e-6, "{exact:?}");
        // A drift of 2 cm/s over 10 s: uniform within 10 cm of the mean.
        let drifted = odometry_score(&truth, &estimate(0.02)).unwrap();
        assert!((drifted.ate_rmse_m - 0.2 / 12f64.sqrt()).abs() < 1e-3, "{drifted:?}");
        assert!((drifted.rpe_trans_rmse_m.unwrap() - 0.02).abs() < 1e-3, "{drifted:?}");
        assert_eq!(odometry_score(&truth, &[]), None);
        assert_eq!(odometry_score(&[], &estimate(0.0)), None);
    }
}
