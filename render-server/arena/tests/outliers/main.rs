//! The filter rejects outliers of any size and pattern, accepts lasting jumps, follows manoeuvres, and gives
//! correct reasons. Seeds are fixed, because the results depend on chance.

mod scenario;

use glam::{DQuat, DVec3};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use scenario::{Flight, JUMP_AT, POSES, Scenario};
use vizflyt_arena::pose::{Measured, PoseChange, PoseConfig, PoseFilter, Rejected};
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::time::ServerTime;

fn scenario() -> impl Strategy<Value = Scenario> {
    let rates = prop_oneof![
        Just(10.0),
        Just(20.0),
        Just(30.0),
        Just(60.0),
        Just(100.0),
        Just(200.0),
        10.0..200.0f64
    ];
    let noise = prop_oneof![Just(0.001), Just(0.005)];
    let flight = prop_oneof![Just(Flight::Hover), Just(Flight::Eight)];
    let yes_no = any::<(bool, bool, bool)>();
    (any::<u64>(), rates, noise, 1usize..3, flight, yes_no).prop_map(
        |(seed, rate_hz, noise_m, burst, flight, (sent, agree, imu))| Scenario {
            seed,
            rate_hz,
            noise_m,
            sent,
            burst,
            agree,
            flight,
            imu,
        },
    )
}

fn jump() -> impl Strategy<Value = DVec3> {
    (0.3..5.0f64, prop::array::uniform3(-1.0..1.0f64))
        .prop_map(|(size_m, way)| DVec3::from(way).normalize_or(DVec3::X) * size_m)
}

impl Scenario {
    /// Raises the rate until outliers of 5 cm can be distinguished from this flight. With 5 mm of noise at 10
    /// Hz, even with the right process noise, poses deviate by 11 mm per axis from the expectation, so that 4.5
    /// standard deviations equal the smallest outliers. An IMU halves that, unless the sigma must be learnt as
    /// well.
    fn decidable(self) -> Self {
        let least_hz = match (self.imu, self.sent) {
            _ if self.noise_m < 0.005 => 10.0,
            (true, true) => 10.0,
            (false, false) => 30.0,
            _ => 20.0,
        };
        Self { rate_hz: self.rate_hz.max(least_hz), ..self }
    }

    /// Largest outlier that can pass as noise if outliers are so frequent that the source counts as noisy. [m]
    fn explained_m(&self) -> f64 {
        if self.noise_m > 0.001 { 0.1 } else { 0.0 }
    }
}

proptest! {
    // For other seeds, fewer than one flight in 150 at these rates has a reset; with 5 mm of noise, one outlier
    // in 500 is accepted.
    #![proptest_config(ProptestConfig { rng_seed: RngSeed::Fixed(1), ..ProptestConfig::with_cases(600) })]

    #[test]
    fn rejects_isolated_outliers(scenario in scenario()) {
        let scenario = Scenario { burst: 1, ..scenario }.decidable();
        let clean = scenario.run(0.0, DVec3::ZERO);
        let outcome = scenario.run(0.05, DVec3::ZERO);
        prop_assert_eq!((outcome.resets(), outcome.lost(), clean.lost()), (0, 0, 0));
        prop_assert!(outcome.outliers() > 0);
        let worst_m = outcome.accepted_outliers().fold(0.0, f64::max);
        prop_assert!(worst_m <= scenario.explained_m(), "{}", worst_m);
        prop_assert!(outcome.ate_m() <= 1.3 * clean.ate_m(), "{} {}", outcome.ate_m(), clean.ate_m());
        // True poses inside the gate are accepted regardless of earlier ones.
        prop_assert!(outcome.left_out().max(clean.left_out()) * 100 <= POSES, "{}", outcome.left_out());
    }

    /// Two outliers in a row, at one false position or two: the third pose is true again.
    #[test]
    fn two_outliers_in_a_row_are_not_a_jump(scenario in scenario()) {
        let least_hz = if scenario.noise_m > 0.001 { 60.0 } else { 20.0 };
        let scenario = Scenario { burst: 2, rate_hz: scenario.rate_hz.max(least_hz), ..scenario };
        let outcome = scenario.run(0.025, DVec3::ZERO);
        prop_assert_eq!(outcome.resets(), 0);
        let worst_m = outcome.accepted_outliers().fold(0.0, f64::max);
        prop_assert!(worst_m <= scenario.explained_m(), "{}", worst_m);
    }

    #[test]
    fn accepts_a_moved_origin_within_five_poses(scenario in scenario(), jump_m in jump()) {
        let outcome = scenario.run(0.0, jump_m);
        let after = &outcome.taken[JUMP_AT..];
        prop_assert_eq!(outcome.resets(), 1, "{:?}", &after[..8]);
        let taken = after.iter().position(|taken| taken.result.is_ok());
        prop_assert!(taken.is_some_and(|taken| taken < 5), "{:?} {:?}", taken, &after[..8]);
        // The reported distance is as accurate as noise and flight allow.
        let said = outcome.changes.iter().find_map(|change| match change {
            PoseChange::Jumped(distance_m, _) => Some(*distance_m),
            _ => None,
        });
        let off_m = (said.unwrap_or(0.0) - jump_m.length()).abs();
        prop_assert!(off_m < 0.15 * jump_m.length() + 0.1, "{:?} {}", said, jump_m.length());
    }

    #[test]
    fn reasons_for_rejection_are_right(scenario in scenario(), jump_m in jump(), flips in any::<bool>()) {
        let outcome = scenario.run(0.05, if flips { DVec3::ZERO } else { jump_m });
        let gate = PoseConfig::default().gate_sigmas;
        let mut newest_s = 0.0;
        let mut before_m = None;
        for taken in &outcome.taken {
            let Err(reason) = taken.result else {
                (newest_s, before_m) = (taken.t, None);
                continue;
            };
            let words = reason.to_string();
            match reason {
                // The printed value must not look like a good pose.
                Rejected::Outlier(sigmas) => {
                    prop_assert!(sigmas > gate, "{}", words);
                    before_m = Some(f64::INFINITY);
                }
                Rejected::Jump { distance_m, speed_mps } => {
                    // By the printed numbers: faster than vehicles fly, or at the same position as the last
                    // rejected pose.
                    let dt_s = taken.t - newest_s;
                    prop_assert!((speed_mps - distance_m / dt_s).abs() < 0.01 * speed_mps, "{}", words);
                    prop_assert!(speed_mps > 15.0 || before_m.is_some(), "{}", words);
                    prop_assert!(distance_m > 0.03, "{}", words);
                    before_m = Some(distance_m);
                }
                Rejected::Flip(angle_rad) => prop_assert!(angle_rad > 0.2, "{}", words),
                _ => prop_assert!(false, "unexpected reason: {}", words),
            }
        }
    }
}

/// With an IMU, no manoeuvre is rejected; without one, only its start, because it looks like an outlier. Neither
/// jumps nor losses occur.
#[test]
fn follows_hard_manoeuvres() {
    for (rate_hz, imu) in [10.0, 15.0, 20.0, 30.0, 60.0, 100.0, 200.0]
        .into_iter()
        .flat_map(|rate_hz| [(rate_hz, true), (rate_hz, false)])
        .filter(|(rate_hz, imu)| *imu || *rate_hz >= 20.0)
    {
        for (seed, noise_m, sent) in
            (0..12).map(|seed| (seed, [0.001, 0.005][seed as usize % 2], seed % 4 < 2))
        {
            let flight = Flight::Dashes;
            let scenario =
                Scenario { seed, rate_hz, noise_m, sent, burst: 1, agree: true, flight, imu };
            let outcome = scenario.run(0.0, DVec3::ZERO);
            assert_eq!((outcome.resets(), outcome.lost()), (0, 0), "{scenario:?}");
            let most = if imu { POSES / 200 } else { POSES / 40 };
            assert!(outcome.left_out() <= most, "{scenario:?}: {} rejected", outcome.left_out());
        }
    }
}

/// Hover with 1 mm of noise and three outliers.
#[test]
fn accepts_the_truth_right_after_an_outlier() {
    let at = |seconds: f64| ServerTime::from_ns(1_000_000_000).plus_seconds(seconds);
    for (rate_hz, size_m) in [(30.0, 0.5), (30.0, 0.9), (60.0, 0.3), (100.0, 0.25), (10.0, 0.5)] {
        let mut filter = PoseFilter::default();
        let mut noise = scenario::Noise(7);
        for i in 0..200 {
            let t = f64::from(i) / rate_hz;
            let is_outlier = [60, 100, 140].contains(&i);
            let off = if is_outlier { DVec3::X * size_m } else { DVec3::ZERO };
            let p = DVec3::Z + off + noise.normal3() * 1e-3;
            filter.handle_timeout(at(t));
            assert_eq!(filter.poll_change(), None, "{rate_hz} Hz, pose {i}");
            let result = filter.handle_pose(&Measured::new(at(t), Pose::new(p, DQuat::IDENTITY)));
            assert_eq!(result.is_err(), is_outlier, "{rate_hz} Hz, pose {i}: {result:?}");
        }
        assert_eq!(filter.newest().unwrap().resets, 0);
    }
}
