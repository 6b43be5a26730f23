//! Absolute and relative errors of an estimated trajectory.
//!
//! ```text
//! pairs -> alignment of the estimate -> absolute errors, for each pose
//!                                    -> relative errors, over a distance or a time
//! ```
//! Method: J. Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012. The numbers match those
//! of the Python package `evo` (`evo_ape`, `evo_rpe`), as `tests/pose` checks.

use anyhow::{Context, Result};
use glam::{DQuat, DVec3};
use vizflyt_twin::align::{Similarity, points};

use super::pairs::Pair;

/// Unknown part of the estimate's frame, found by least squares.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Alignment {
    /// Nothing: both trajectories are in the same frame
    None,
    /// Origin and heading: unobservable for a camera with an IMU
    Yaw,
    /// Origin and rotation
    Se3,
    /// Origin, rotation and scale: unobservable for a single camera
    Sim3,
}

/// Finds the similarity from the estimate's frame to the truth's.
///
/// # Errors
/// The positions do not determine it: fewer than three, or all on one line.
pub(crate) fn align(pairs: &[Pair], alignment: Alignment) -> Result<Similarity> {
    let still = Similarity { scale: 1.0, rotation: DQuat::IDENTITY, translation_m: DVec3::ZERO };
    let count = pairs.len() as f64;
    let mean = |of: fn(&Pair) -> DVec3| pairs.iter().map(of).sum::<DVec3>() / count;
    let (from, to) = (mean(|pair| pair.estimate.position_m), mean(|pair| pair.truth.position_m));
    let rigid =
        |rotation: DQuat| Similarity { rotation, translation_m: to - rotation * from, ..still };
    let whole = || {
        let pair = |pair: &Pair| points::Pair {
            scene: pair.estimate.position_m,
            world_m: pair.truth.position_m,
        };
        let positions: Vec<points::Pair> = pairs.iter().map(pair).collect();
        points::closest(&positions).context("the estimate cannot be aligned")
    };
    Ok(match alignment {
        Alignment::None => still,
        Alignment::Yaw => {
            let (mut sin, mut cos) = (0.0, 0.0);
            for pair in pairs {
                let (x, y) = (
                    (pair.estimate.position_m - from).truncate(),
                    (pair.truth.position_m - to).truncate(),
                );
                sin += x.perp_dot(y);
                cos += x.dot(y);
            }
            rigid(DQuat::from_rotation_z(sin.atan2(cos)))
        }
        Alignment::Se3 => rigid(whole()?.rotation),
        Alignment::Sim3 => whole()?,
    })
}

/// Returns the pairs with the estimate in the truth's frame.
pub(crate) fn aligned(pairs: &[Pair], truth_from_estimate: &Similarity) -> Vec<Pair> {
    let mut pairs = pairs.to_vec();
    for Pair { estimate, .. } in &mut pairs {
        estimate.position_m = truth_from_estimate.transform_point(estimate.position_m);
        estimate.rotation = truth_from_estimate.rotation * estimate.rotation;
    }
    pairs
}

/// Error of a pose: position and attitude.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Error {
    /// [m]
    pub place_m: f64,
    /// [rad]
    pub turn_rad: f64,
}

/// Returns the error of each pose.
pub(crate) fn absolute(pairs: &[Pair]) -> Vec<Error> {
    let error = |pair: &Pair| Error {
        place_m: pair.truth.position_m.distance(pair.estimate.position_m),
        turn_rad: angle(pair.truth.rotation.inverse() * pair.estimate.rotation),
    };
    pairs.iter().map(error).collect()
}

/// Interval of a relative error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Delta {
    /// Path length of the estimate. [m]
    Metres(f64),
    /// [s]
    Seconds(f64),
}

/// Returns the steps of relative errors as indices (from, to); each step begins where the previous one ends.
pub(crate) fn steps(pairs: &[Pair], delta: Delta) -> Vec<(usize, usize)> {
    let mut steps = Vec::new();
    let (mut from, mut way_m) = (0, 0.0);
    for (k, two) in pairs.windows(2).enumerate() {
        let to = k + 1;
        way_m += two[0].estimate.position_m.distance(two[1].estimate.position_m);
        let is_far = match delta {
            Delta::Metres(metres) => way_m >= metres,
            // Tolerance for the rounding of decimal stamps.
            Delta::Seconds(seconds) => {
                pairs[to].estimate.at_s - pairs[from].estimate.at_s >= seconds - 5e-7
            }
        };
        if is_far {
            steps.push((from, to));
            (from, way_m) = (to, 0.0);
        }
    }
    steps
}

/// Returns the error of each step: the difference between estimated and true motion.
pub(crate) fn relative(pairs: &[Pair], steps: &[(usize, usize)]) -> Vec<Error> {
    let error = |&(from, to): &(usize, usize)| {
        let motion = |of: fn(&Pair) -> (DVec3, DQuat)| {
            let ((p, q), (p_next, q_next)) = (of(&pairs[from]), of(&pairs[to]));
            (q.inverse() * (p_next - p), q.inverse() * q_next)
        };
        let (p, q) = motion(|pair| (pair.truth.position_m, pair.truth.rotation));
        let (p_estimate, q_estimate) =
            motion(|pair| (pair.estimate.position_m, pair.estimate.rotation));
        Error { place_m: p.distance(p_estimate), turn_rad: angle(q.inverse() * q_estimate) }
    };
    steps.iter().map(error).collect()
}

/// Returns the angle of a rotation. [rad] Also exact for small angles, unlike the arc cosine of `w`.
fn angle(turn: DQuat) -> f64 {
    2.0 * turn.xyz().length().atan2(turn.w.abs())
}

/// Statistics of errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Statistics {
    pub rmse: f64,
    pub mean: f64,
    pub median: f64,
    pub max: f64,
}

impl Statistics {
    /// Returns the statistics, or `None` if there are no values.
    pub(crate) fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        let mut values: Vec<f64> = values.collect();
        let count = values.len();
        values.sort_by(f64::total_cmp);
        let middle = 0.5 * (values.get(count.checked_sub(1)? / 2)? + values[count / 2]);
        let mean = |of: fn(f64) -> f64| values.iter().copied().map(of).sum::<f64>() / count as f64;
        Some(Self {
            rmse: mean(|value| value * value).sqrt(),
            mean: mean(|value| value),
            median: middle,
            max: values[count - 1],
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::evaluate::trajectory::Stamped;

    fn spiral(count: usize) -> Vec<Stamped> {
        let at = |k: usize| {
            let t = k as f64 * 0.05;
            Stamped {
                at_s: t,
                position_m: DVec3::new(t.cos() * t, t.sin() * 2.0, 0.3 * t),
                rotation: DQuat::from_rotation_z(0.4 * t) * DQuat::from_rotation_x(0.1 * t.sin()),
            }
        };
        (0..count).map(at).collect()
    }

    /// Returns the truth as estimated in another frame and scale.
    fn moved(truth: &[Stamped], place: &Similarity) -> Vec<Pair> {
        let back = place.rotation.inverse();
        let pair = |&truth: &Stamped| Pair {
            truth,
            estimate: Stamped {
                position_m: back * (truth.position_m - place.translation_m) / place.scale,
                rotation: back * truth.rotation,
                ..truth
            },
        };
        truth.iter().map(pair).collect()
    }

    proptest! {
        #[test]
        fn alignment_removes_rotation_shift_and_scale(
            turn in prop::array::uniform3(-1.0..1.0f64), shift in prop::array::uniform3(-9.0..9.0f64), scale in 0.2..5.0f64,
        ) {
            let truth = spiral(120);
            let (rotation, translation_m) = (DQuat::from_scaled_axis(turn.into()), DVec3::from(shift));
            let upright = DQuat::from_rotation_z(turn[2]);
            for (alignment, place) in [
                (Alignment::Sim3, Similarity { scale, rotation, translation_m }),
                (Alignment::Se3, Similarity { scale: 1.0, rotation, translation_m }),
                (Alignment::Yaw, Similarity { scale: 1.0, rotation: upright, translation_m }),
            ] {
                let pairs = moved(&truth, &place);
                let pairs = aligned(&pairs, &align(&pairs, alignment).unwrap());
                for error in absolute(&pairs) {
                    prop_assert!(error.place_m < 1e-8 && error.turn_rad < 1e-7, "{alignment:?} {error:?}");
                }
                for error in relative(&pairs, &steps(&pairs, Delta::Metres(1.0))) {
                    prop_assert!(error.place_m < 1e-8 && error.turn_rad < 1e-7, "{alignment:?} {error:?}");
                }
            }
        }

        #[test]
        fn yaw_alignment_minimizes_the_position_error(turn in -3.0..3.0f64, off in -0.2..0.2f64, seed in 0.1..9.0f64) {
            let truth = spiral(60);
            let place =
                Similarity { scale: 1.0, rotation: DQuat::from_rotation_z(turn), translation_m: DVec3::ONE };
            let mut pairs = moved(&truth, &place);
            for (k, pair) in pairs.iter_mut().enumerate() {
                pair.estimate.position_m += DVec3::splat((k as f64 * seed).sin() * 0.3);
            }
            let squares = |place: &Similarity| {
                absolute(&aligned(&pairs, place)).iter().map(|error| error.place_m.powi(2)).sum::<f64>()
            };
            let found = align(&pairs, Alignment::Yaw).unwrap();
            let other = Similarity { rotation: DQuat::from_rotation_z(off) * found.rotation, ..found };
            prop_assert!(squares(&found) <= squares(&other) + 1e-9);
        }
    }

    #[test]
    fn measures_a_drift_per_metre_and_per_second() {
        // 1 m/s along x. The estimate is 2 % too short, and its heading drifts by 1 deg/s.
        let pair = |k: u32| {
            let t = f64::from(k) * 0.01;
            let truth = Stamped { at_s: t, position_m: DVec3::X * t, rotation: DQuat::IDENTITY };
            let estimate = Stamped {
                position_m: DVec3::X * t * 0.98,
                rotation: DQuat::from_rotation_z(t.to_radians()),
                ..truth
            };
            Pair { truth, estimate }
        };
        let pairs: Vec<Pair> = (0..1001).map(pair).collect();
        let seconds = steps(&pairs, Delta::Seconds(1.0));
        assert_eq!(seconds, (0..10).map(|k| (k * 100, (k + 1) * 100)).collect::<Vec<_>>());
        for error in relative(&pairs, &seconds) {
            assert!((error.turn_rad.to_degrees() - 1.0).abs() < 1e-9, "{error:?}");
        }
        assert_eq!(steps(&pairs, Delta::Metres(2.0)).len(), 4);
        assert_eq!(steps(&pairs, Delta::Metres(100.0)), []);
        let statistics =
            Statistics::of(absolute(&pairs).iter().map(|error| error.place_m)).unwrap();
        assert!(
            (statistics.max - 0.2).abs() < 1e-12 && (statistics.median - 0.1).abs() < 1e-12,
            "{statistics:?}"
        );
        assert_eq!(Statistics::of(std::iter::empty()), None);
    }

    #[test]
    fn rejects_alignment_of_a_straight_line() {
        let truth: Vec<Stamped> = (0..9)
            .map(|k| Stamped { position_m: DVec3::X * f64::from(k), ..spiral(1)[0] })
            .collect();
        let still =
            Similarity { scale: 1.0, rotation: DQuat::IDENTITY, translation_m: DVec3::ZERO };
        assert!(align(&moved(&truth, &still), Alignment::Se3).is_err());
        assert!(align(&moved(&truth, &still), Alignment::None).is_ok());
    }
}
