//! Outliers of any size and pattern are left out, true jumps are found.

use proptest::test_runner::RngSeed;

use super::*;

/// What a simulated source sends.
#[derive(Clone, Copy, Debug)]
struct Scenario {
    seed: u64,
    rate_hz: f64,
    /// Of the positions; attitudes have 0.5 degrees for 5 mm. [m]
    noise_m: f64,
    /// Whether the sigma is sent along.
    sent: bool,
    /// How many outliers follow each other.
    burst: usize,
    /// Whether those of a burst show the same false place.
    agree: bool,
    /// Flies a figure of eight at up to 1.5 m/s; else hovers.
    flies: bool,
}

/// How a scenario ended.
#[derive(Debug, Default)]
struct Outcome {
    outliers: usize,
    resets: u8,
    lost: u32,
    /// The largest outlier that was accepted. [m]
    worst_m: f64,
    /// Root mean square error of the fused positions. [m]
    ate_m: f64,
}

struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }

    fn normal3(&mut self) -> DVec3 {
        DVec3::new(self.normal(), self.normal(), self.normal())
    }

    /// 0.05 to 5 m in any direction, each decade as often.
    fn outlier(&mut self) -> DVec3 {
        self.normal3().normalize_or(DVec3::X) * 0.05 * 100f64.powf(self.uniform())
    }
}

impl Scenario {
    fn truth(&self, t: f64) -> Pose<World, Body> {
        if !self.flies {
            return pose(DVec3::Z);
        }
        let p = DVec3::new((0.9 * t).sin(), 0.5 * (1.8 * t).sin(), 1.0 + 0.2 * (0.7 * t).cos());
        Pose::new(p, DQuat::from_rotation_z(0.6 * (0.5 * t).sin()))
    }

    /// The largest outlier that may be taken for noise or motion. [m]
    fn explained_m(&self) -> f64 {
        if self.noise_m > 0.001 { 0.11 } else { 0.0 }
    }

    /// Runs 400 poses, of which `share` begin a burst of outliers; `jump_m` moves the origin after the 200th.
    fn run(&self, share: f64, jump_m: DVec3) -> (Outcome, Vec<Result<PoseSample, Rejected>>) {
        let mut noise = Noise(self.seed);
        let mut faults = Noise(self.seed ^ 0x9e37_79b9_7f4a_7c15);
        let mut filter = PoseFilter::default();
        let mut outcome = Outcome::default();
        let mut results = Vec::new();
        let (mut left, mut pause, mut off) = (0, 0u32, DVec3::ZERO);
        let (mut sum, mut count) = (0.0, 0);
        for i in 0..POSES {
            let t = i as f64 / self.rate_hz;
            let truth = self.truth(t);
            let rotation_rad = self.noise_m * 1.75;
            let turned = DQuat::from_scaled_axis(noise.normal3() * rotation_rad);
            let p = truth.translation_m + noise.normal3() * self.noise_m;
            // Once the filter has settled.
            if left == 0 && pause == 0 && i >= SETTLED && faults.uniform() < share {
                (left, pause, off) = (self.burst, 3, faults.outlier());
            }
            let false_m = if left > 0 { off } else { DVec3::ZERO };
            if left > 0 {
                left -= 1;
                off = if self.agree { off } else { faults.outlier() };
            } else {
                pause = pause.saturating_sub(1);
            }
            let moved = if i >= JUMP_AT { jump_m } else { DVec3::ZERO };
            let sigma = PoseSigma {
                position_m: DVec3::splat(self.noise_m),
                rotation_rad: DVec3::splat(rotation_rad),
            };
            let sent = Pose::new(p + false_m + moved, truth.rotation * turned);
            let measured =
                Measured { sigma: self.sent.then_some(sigma), ..Measured::new(at(t), sent) };
            filter.handle_timeout(at(t));
            let result = filter.handle_pose(&measured);
            while let Some(change) = filter.poll_change() {
                outcome.lost += u32::from(matches!(change, PoseChange::Lost(..)));
            }
            let is_outlier = false_m != DVec3::ZERO;
            outcome.outliers += usize::from(is_outlier);
            if let Ok(sample) = &result {
                outcome.resets = sample.resets;
                let error = sample.world_from_body.translation_m - truth.translation_m - moved;
                if is_outlier {
                    outcome.worst_m = outcome.worst_m.max(false_m.length());
                }
                if i >= SETTLED {
                    (sum, count) = (sum + error.length_squared(), count + 1);
                }
            }
            results.push(result);
        }
        outcome.ate_m = (sum / f64::from(count.max(1))).sqrt();
        (outcome, results)
    }
}

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
    (any::<u64>(), rates, noise, any::<bool>(), 1usize..3, any::<bool>(), any::<bool>()).prop_map(
        |(seed, rate_hz, noise_m, sent, burst, agree, flies)| Scenario {
            seed,
            rate_hz,
            noise_m,
            sent,
            burst,
            agree,
            flies,
        },
    )
}

proptest! {
    // Fixed, as chance is part of the question: of the outliers one in a thousand is within what 5 mm of noise
    // explain at 30 Hz, one in thirty at 15 Hz; at 10 Hz a turn explains one in three thousand at 1 mm.
    #![proptest_config(ProptestConfig { rng_seed: RngSeed::Fixed(1), ..ProptestConfig::with_cases(400) })]

    #[test]
    fn isolated_outliers_are_left_out_one_by_one(scenario in scenario()) {
        let least_hz = if scenario.noise_m > 0.001 { 60.0 } else { 15.0 };
        let scenario = Scenario { burst: 1, rate_hz: scenario.rate_hz.max(least_hz), ..scenario };
        let (clean, _) = scenario.run(0.0, DVec3::ZERO);
        let (outcome, _) = scenario.run(0.05, DVec3::ZERO);
        prop_assert_eq!((outcome.resets, outcome.lost, clean.lost), (0, 0, 0), "{:?} {:?}", outcome, clean);
        prop_assert!(outcome.worst_m <= scenario.explained_m(), "{:?}", outcome);
        prop_assert!(outcome.ate_m <= 1.3 * clean.ate_m, "{:?} {:?}", outcome, clean);
    }

    /// Two in a row, at one false place or at two: whether they agree or not, the third is the truth again.
    #[test]
    fn two_outliers_in_a_row_are_no_jump(scenario in scenario()) {
        let least_hz = if scenario.noise_m > 0.001 { 60.0 } else { 20.0 };
        let scenario = Scenario { burst: 2, rate_hz: scenario.rate_hz.max(least_hz), ..scenario };
        let (outcome, _) = scenario.run(0.025, DVec3::ZERO);
        prop_assert_eq!(outcome.resets, 0, "{:?}", outcome);
        prop_assert!(outcome.worst_m <= scenario.explained_m(), "{:?}", outcome);
    }

    #[test]
    fn a_moved_origin_is_found_within_five_poses(scenario in scenario(), size_m in 0.3..5.0f64, way in prop::array::uniform3(-1.0..1.0f64)) {
        let jump_m = DVec3::from(way).normalize_or(DVec3::X) * size_m;
        let (outcome, results) = scenario.run(0.0, jump_m);
        let after = &results[JUMP_AT..];
        prop_assert_eq!(outcome.resets, 1, "{:?} {:?}", outcome, &after[..8]);
        let taken = after.iter().position(Result::is_ok);
        prop_assert!(taken.is_some_and(|taken| taken < 5), "{:?} {:?}", taken, &after[..8]);
    }
}

/// The flights of the finding: hover with 1 mm of noise, three outliers.
#[test]
fn the_truth_is_taken_right_after_an_outlier() {
    for (rate_hz, size_m) in [(30.0, 0.5), (30.0, 0.9), (60.0, 0.3), (100.0, 0.25), (10.0, 0.5)] {
        let mut filter = PoseFilter::default();
        let mut noise = Noise(7);
        for i in 0..200 {
            let t = f64::from(i) / rate_hz;
            let is_outlier = [60, 100, 140].contains(&i);
            let off = if is_outlier { DVec3::X * size_m } else { DVec3::ZERO };
            let measured = measured(t, DVec3::Z + off + noise.normal3() * 1e-3);
            filter.handle_timeout(at(t));
            assert_eq!(filter.poll_change(), None, "{rate_hz} Hz, pose {i}");
            let result = filter.handle_pose(&measured);
            assert_eq!(result.is_err(), is_outlier, "{rate_hz} Hz, pose {i}: {result:?}");
        }
        assert_eq!(filter.newest().unwrap().resets, 0);
    }
}

/// Poses of a run: two seconds at 200 Hz.
const POSES: usize = 400;
/// Poses after which outliers begin.
const SETTLED: usize = 40;
/// Where the origin moves.
const JUMP_AT: usize = 200;
