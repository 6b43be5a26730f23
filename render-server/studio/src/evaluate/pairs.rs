//! Association of estimated with true poses.
//!
//! Same method as `evo`: for each pose of the trajectory with fewer poses, the other one must have a pose within
//! `max_diff_s`. The other one is then interpolated, or its nearest pose is used.

use super::trajectory::Stamped;

/// Association of poses, applied to the trajectory with more poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Association {
    /// Interpolate between two poses: positions linearly, rotations on the arc
    Interpolate,
    /// Use the pose nearest in time
    Nearest,
}

/// A true and an estimated pose of the same instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    pub truth: Stamped,
    pub estimate: Stamped,
}

/// Returns the pairs in order of time. Both trajectories must be in order of time.
pub fn associate(
    truth: &[Stamped],
    estimate: &[Stamped],
    how: Association,
    max_diff_s: f64,
) -> Vec<Pair> {
    let truth_is_sparser = estimate.len() > truth.len();
    let (sparse, dense) = if truth_is_sparser { (truth, estimate) } else { (estimate, truth) };
    let pair = |&at: &Stamped| {
        let nearest = nearest(dense, at.at_s)?;
        if (nearest.at_s - at.at_s).abs() > max_diff_s {
            return None;
        }
        let other = match how {
            Association::Nearest => nearest,
            Association::Interpolate => interpolated(dense, at.at_s),
        };
        Some(if truth_is_sparser {
            Pair { truth: at, estimate: other }
        } else {
            Pair { truth: other, estimate: at }
        })
    };
    sparse.iter().filter_map(pair).collect()
}

/// Returns the index of the first pose at or after `at_s`; at least 1, so that there is a pose before it.
fn after(poses: &[Stamped], at_s: f64) -> usize {
    poses.partition_point(|pose| pose.at_s < at_s).clamp(1, poses.len().max(2) - 1)
}

fn nearest(poses: &[Stamped], at_s: f64) -> Option<Stamped> {
    let [only] = poses else {
        let next = after(poses, at_s);
        let (before, next) = (*poses.get(next - 1)?, *poses.get(next)?);
        return Some(if at_s - before.at_s <= next.at_s - at_s { before } else { next });
    };
    Some(*only)
}

/// Returns the pose at an instant; before the first or after the last pose, that pose.
pub fn interpolated(poses: &[Stamped], at_s: f64) -> Stamped {
    let [only] = poses else {
        let next = after(poses, at_s);
        let (a, b) = (poses[next - 1], poses[next]);
        let share = ((at_s - a.at_s) / (b.at_s - a.at_s)).clamp(0.0, 1.0);
        return Stamped {
            at_s,
            position_m: a.position_m.lerp(b.position_m, share),
            rotation: a.rotation.slerp(b.rotation, share),
        };
    };
    *only
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    fn line(stamps_s: impl IntoIterator<Item = f64>) -> Vec<Stamped> {
        let at = |at_s| Stamped {
            at_s,
            position_m: DVec3::X * at_s,
            rotation: DQuat::from_rotation_z(0.1 * at_s),
        };
        stamps_s.into_iter().map(at).collect()
    }

    #[test]
    fn interpolates_between_two_poses() {
        let truth = line((0..100).map(|k| f64::from(k) * 0.01));
        let estimate = line([-1.0, 0.004, 0.5049, 0.993, 2.0]);
        let pairs = associate(&truth, &estimate, Association::Interpolate, 0.01);
        assert_eq!(pairs.len(), 3);
        for pair in &pairs[..2] {
            assert!((pair.truth.position_m - pair.estimate.position_m).length() < 1e-12);
            assert!(pair.truth.rotation.angle_between(pair.estimate.rotation) < 1e-7);
        }
        // Beyond the end, the last pose is used.
        assert!((pairs[2].truth.position_m.x - 0.99).abs() < 1e-12);
        let nearest = associate(&truth, &estimate, Association::Nearest, 0.01);
        assert!((nearest[1].truth.position_m.x - 0.5).abs() < 1e-12);
    }

    #[test]
    fn handles_a_single_pose_and_no_poses() {
        let one = line([0.5]);
        assert_eq!(associate(&one, &line([0.501]), Association::Interpolate, 0.01).len(), 1);
        assert_eq!(associate(&one, &[], Association::Interpolate, 0.01), []);
        assert_eq!(associate(&[], &one, Association::Nearest, 0.01), []);
    }
}
