use glam::DQuat;
use proptest::prelude::*;

use super::*;

fn at(seconds: f64) -> ServerTime {
    ServerTime::from_ns(1_000_000_000).plus_seconds(seconds)
}

fn pose(p: DVec3) -> Pose<World, Body> {
    Pose::new(p, DQuat::IDENTITY)
}

fn measured(t: f64, p: DVec3) -> Measured {
    Measured::new(at(t), pose(p))
}

/// Returns a filter after one second of straight flight, measured at 200 Hz.
fn flying(speed_mps: f64) -> PoseFilter {
    let mut filter = PoseFilter::default();
    for i in 0..=200 {
        let t = 0.005 * f64::from(i);
        filter.handle_pose(&measured(t, DVec3::X * speed_mps * t)).unwrap();
    }
    filter
}

proptest! {
    #[test]
    fn estimates_a_constant_twist(v in prop::array::uniform3(-8.0..8.0f64), w in prop::array::uniform3(-3.0..3.0f64), hz in 30.0..500.0f64) {
        let (v, w) = (DVec3::from(v), DVec3::from(w));
        let mut filter = PoseFilter::default();
        for i in 0..150 {
            let t = f64::from(i) / hz;
            let truth = Pose::new(v * t, DQuat::from_scaled_axis(w * t));
            filter.handle_pose(&Measured::new(at(t), truth)).unwrap();
        }
        let twist = filter.newest().unwrap().twist;
        prop_assert!((twist.linear_mps - v).length() < 1e-2, "{:?}", twist);
        prop_assert!((twist.angular_radps - w).length() < 1e-2, "{:?}", twist);
        let ahead = filter.predict(at(149.0 / hz + 0.03)).unwrap();
        prop_assert!((ahead.translation_m - v * (149.0 / hz + 0.03)).length() < 1e-3);
    }

    /// Any input in any order gives finite output.
    #[test]
    fn output_is_finite_for_any_input(
        steps in prop::collection::vec((0u8..4, -0.3..0.5f64, prop::array::uniform3(-20.0..20.0f64), prop::array::uniform3(-9.0..9.0f64), -1e-3..0.5f64), 1..120)
    ) {
        let mut filter = PoseFilter::default();
        let mut t = 1.0;
        for (kind, dt, a, b, sigma) in steps {
            t += dt;
            let (a, b) = (DVec3::from(a), DVec3::from(b));
            if kind == 3 {
                let reading = ImuReading { stamp: at(t), accel_mps2: a * 10.0, gyro_radps: b };
                filter.handle_imu(&reading);
            } else {
                let sigma = PoseSigma { position_m: DVec3::splat(sigma), rotation_rad: b };
                let measured = Measured {
                    source: kind,
                    sigma: (kind > 0).then_some(sigma),
                    ..Measured::new(at(t), Pose::new(a, DQuat::from_scaled_axis(b)))
                };
                let _ = filter.handle_pose(&measured);
            }
            if let Some(sample) = filter.newest() {
                prop_assert!(sample.is_valid(), "{:?}", sample);
                prop_assert!(filter.predict(at(t + 0.03)).unwrap().is_valid());
                let quality = filter.quality(at(t));
                prop_assert!(quality.position_sigma_mm.is_finite() && quality.rate_hz.is_finite());
            }
        }
    }
}

#[test]
fn rejects_invalid_and_old_poses() {
    let mut filter = PoseFilter::default();
    let nan = measured(0.0, DVec3::new(f64::NAN, 0.0, 0.0));
    assert_eq!(filter.handle_pose(&nan), Err(Rejected::Invalid));
    filter.handle_pose(&measured(1.0, DVec3::ZERO)).unwrap();
    assert_eq!(filter.handle_pose(&measured(1.0, DVec3::ZERO)), Err(Rejected::Stale));
    assert_eq!(filter.handle_pose(&measured(0.5, DVec3::ZERO)), Err(Rejected::Stale));
    assert_eq!((filter.rejected().stale, filter.rejected().invalid), (2, 1));
}

#[test]
fn jump_is_rejected_until_it_lasts() {
    let mut filter = PoseFilter::default();
    filter.handle_pose(&measured(0.0, DVec3::ZERO)).unwrap();
    let far = DVec3::new(5.0, 0.0, 0.0);
    // One outlier from swapped markers. The motion is hardly known yet.
    for i in 1..=20 {
        filter.handle_pose(&measured(0.005 * f64::from(i), DVec3::ZERO)).unwrap();
    }
    let jumped = filter.handle_pose(&measured(0.105, far));
    assert!(
        matches!(jumped, Err(Rejected::Jump { distance_m, .. }) if (distance_m - 5.0).abs() < 0.01),
        "{jumped:?}"
    );
    assert_eq!(filter.handle_pose(&measured(0.110, DVec3::ZERO)).unwrap().resets, 0);
    // A moved origin stays.
    let mut accepted = None;
    for i in 1..=20 {
        if let Ok(sample) = filter.handle_pose(&measured(0.110 + 0.005 * f64::from(i), far)) {
            accepted = Some((i, sample));
            break;
        }
    }
    let (count, sample) = accepted.expect("a lasting jump is accepted");
    assert_eq!(count, 5);
    assert_eq!((sample.resets, sample.twist.linear_mps), (1, DVec3::ZERO));
}

#[test]
fn packets_bunched_after_a_pause_do_not_give_a_high_speed() {
    let mut filter = PoseFilter::default();
    // 2 m/s: 0.2 s of packets read in time, then 0.1 s of packets read at once.
    let place = |i| DVec3::X * 2.0 * 0.005 * f64::from(i);
    for i in 0..40 {
        filter.handle_pose(&measured(0.005 * f64::from(i), place(i))).unwrap();
    }
    for i in 40..60 {
        // Packets at a jump's speed are rejected; the others do not give a high speed.
        let _ = filter.handle_pose(&measured(0.3 + 1e-4 * f64::from(i - 40), place(i)));
        let speed_mps = filter.newest().unwrap().twist.linear_mps.length();
        assert!(speed_mps < 3.0, "{speed_mps} m/s after packet {i}");
    }
}

#[test]
fn reports_loss_and_return_of_poses_once() {
    let mut filter = PoseFilter::default();
    assert_eq!(filter.poll_timeout(), None);
    filter.handle_pose(&measured(0.0, DVec3::ZERO)).unwrap();
    filter.handle_timeout(at(0.1));
    assert_eq!(filter.poll_change(), None);
    let due = filter.poll_timeout().unwrap();
    filter.handle_timeout(due);
    assert!(matches!(filter.poll_change(), Some(PoseChange::Lost(age_s, None)) if age_s > 0.14));
    filter.handle_timeout(at(1.0));
    assert_eq!((filter.poll_change(), filter.poll_timeout()), (None, None));
    filter.handle_pose(&measured(2.0, DVec3::ZERO)).unwrap();
    assert_eq!(filter.poll_change(), Some(PoseChange::Regained));
}

#[test]
fn rejects_a_single_outlier_and_follows_a_bump() {
    let mut filter = flying(2.0);
    let off = filter.handle_pose(&measured(1.005, DVec3::new(2.01, 0.03, 0.0)));
    assert!(matches!(off, Err(Rejected::Outlier(sigmas)) if sigmas > 6.0), "{off:?}");
    let back = filter.handle_pose(&measured(1.010, DVec3::X * 2.02)).unwrap();
    assert!(back.world_from_body.translation_m.y.abs() < 1e-3);
    // Bounces off a post at 5 m/s.
    let mut last = Err(Rejected::Stale);
    for i in 1..=20 {
        let t = 0.005 * f64::from(i);
        last = filter.handle_pose(&measured(1.010 + t, DVec3::X * (2.02 - 5.0 * t)));
    }
    let sample = last.unwrap();
    assert!((sample.twist.linear_mps.x + 5.0).abs() < 0.3 && sample.resets == 0, "{sample:?}");
    assert_eq!(filter.rejected().outlier, 2);
}

#[test]
fn rejects_flips_by_swapped_markers_in_flight() {
    let mut filter = flying(1.0);
    let flipped = |t: f64| {
        Measured::new(at(t), Pose::new(DVec3::X * t, DQuat::from_rotation_z(120f64.to_radians())))
    };
    let mut accepted_after_s = None;
    for i in 1..400 {
        let t = 1.0 + 0.005 * f64::from(i);
        match filter.handle_pose(&flipped(t)) {
            Err(Rejected::Flip(angle_rad)) => assert!((angle_rad.to_degrees() - 120.0).abs() < 1.0),
            Err(other) => panic!("{other}"),
            Ok(sample) => {
                assert_eq!(sample.resets, 1);
                accepted_after_s = Some(t - 1.0);
                break;
            }
        }
        filter.handle_timeout(at(t));
    }
    // The vehicle has been ordered to hold and to land before.
    assert!(accepted_after_s.is_some_and(|s| s > 0.9), "{accepted_after_s:?}");
    // The loss was overwritten by the end of the flip.
    assert_eq!(filter.poll_change(), Some(PoseChange::Regained));
}

#[test]
fn loss_of_poses_names_the_reason() {
    let mut filter = flying(1.0);
    for i in 1..40 {
        let t = 1.0 + 0.005 * f64::from(i);
        let _ = filter.handle_pose(&measured(t, DVec3::X));
        filter.handle_timeout(at(t));
    }
    let Some(PoseChange::Lost(_, Some(why))) = filter.poll_change() else { panic!("not lost") };
    assert!(why.to_string().contains("the stream is frozen"), "{why}");
    // Repeated poses of a vehicle at rest are valid.
    let mut filter = flying(0.0);
    for i in 1..1000 {
        filter.handle_pose(&measured(1.0 + 0.005 * f64::from(i), DVec3::ZERO)).unwrap();
    }
}

/// Part of a stream in flight.
#[derive(Clone, Copy, Debug)]
enum Part {
    /// Measurements with noise.
    Noisy,
    /// The last pose, with new stamps.
    Last,
    /// An earlier pose, with new stamps.
    Cached,
    /// The origin.
    Origin,
    Silent,
}

proptest! {
    /// In flight, poses that repeat for more than 0.15 s are rejected and never used, at any rate, between noise and
    /// restarts. Poses with noise are never rejected as repeated.
    #[test]
    fn repeated_poses_in_flight_are_missing(
        hz in 10.0..500.0f64,
        noise_m in 1e-6..2e-3f64,
        parts in prop::collection::vec((0u8..5, 0.02..1.5f64), 1..12),
        seed in any::<u32>(),
    ) {
        let mut filter = PoseFilter::default();
        let mut random = seed;
        let mut noise = move || {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(random) / f64::from(u32::MAX) - 0.5
        };
        let mut t = 0.0;
        let cached = DVec3::new(2.0, -1.0, 1.0);
        let hover = DVec3::new(1.0, 0.5, 1.0);
        let mut last = hover;
        let kinds = [Part::Noisy, Part::Last, Part::Cached, Part::Origin, Part::Silent];
        let parts = parts.into_iter().map(|(kind, s)| (kinds[usize::from(kind)], s));
        for (part, lasts_s) in std::iter::once((Part::Noisy, 1.0)).chain(parts) {
            filter.set_in_flight(true);
            let (mut since, former) = (None, last);
            for _ in 0..(lasts_s * hz) as u32 {
                t += 1.0 / hz;
                let p = match part {
                    Part::Noisy => hover + DVec3::new(noise(), noise(), noise()) * noise_m,
                    Part::Last => former,
                    Part::Cached => cached,
                    Part::Origin => DVec3::ZERO,
                    Part::Silent => continue,
                };
                let sigma = PoseSigma { position_m: DVec3::splat(2e-3), rotation_rad: DVec3::splat(0.01) };
                let sent = filter.handle_pose(&Measured { sigma: Some(sigma), ..measured(t, p) });
                filter.handle_timeout(at(t));
                let newest = filter.newest().unwrap();
                if matches!(part, Part::Noisy) {
                    let refused = matches!(sent, Err(Rejected::Repeated(_) | Rejected::NotVisible | Rejected::Frozen(_)));
                    prop_assert!(!refused, "{sent:?} at {t}");
                } else {
                    let repeated = since.is_some_and(|since| t - since > 0.151);
                    prop_assert!(!repeated || sent.is_err(), "{part:?} at {t}");
                    prop_assert!(newest.stamp <= at(since.unwrap_or(t) + 1e-6), "{part:?} at {t}");
                    since.get_or_insert(t);
                }
                last = p;
            }
        }
    }

    /// Poses of a vehicle at rest on the ground are measurements, with and without noise.
    #[test]
    fn still_poses_on_the_ground_are_accepted(hz in 10.0..500.0f64, p in prop::array::uniform3(-2.0..2.0f64), rounded in any::<bool>()) {
        let mut filter = PoseFilter::default();
        for i in 0..(3.0 * hz) as u32 {
            let noise_m = if rounded { 0.0 } else { 1e-4 * f64::from(i % 3) };
            let t = f64::from(i) / hz;
            prop_assert!(filter.handle_pose(&measured(t, DVec3::from(p) + noise_m)).is_ok());
            filter.handle_timeout(at(t));
            prop_assert_eq!(filter.poll_change(), None);
        }
    }
}

#[test]
fn repeats_are_compared_within_the_resolution_of_the_source() {
    for (resolution_m, is_missing) in [(0.0, false), (1e-3, true)] {
        let mut filter = flying(0.0);
        filter.set_in_flight(true);
        let resolution = Resolution { position_m: resolution_m, rotation_rad: 0.0 };
        let mut last = Err(Rejected::Stale);
        for i in 1..100 {
            let p = DVec3::X * 2e-4 * f64::from(i % 3);
            let t = 1.0 + 0.005 * f64::from(i);
            last = filter.handle_pose(&Measured { resolution, is_origin: false, ..measured(t, p) });
        }
        assert_eq!(matches!(last, Err(Rejected::Repeated(_))), is_missing, "{last:?}");
    }
}

/// At 10 Hz, two equal poses are 0.1 s apart: only the third one shows that the object is not seen.
#[test]
fn two_equal_poses_at_10_hz_are_not_missing() {
    let mut filter = PoseFilter::default();
    filter.set_in_flight(true);
    for i in 0..30 {
        filter
            .handle_pose(&measured(0.1 * f64::from(i), DVec3::new(1.0, 0.0, 1e-4 * f64::from(i))))
            .unwrap();
    }
    let last = DVec3::new(1.0, 0.0, 1e-4 * 29.0);
    assert!(filter.handle_pose(&measured(3.0, last)).is_ok());
    let third = filter.handle_pose(&measured(3.1, last));
    assert!(matches!(third, Err(Rejected::Repeated(s)) if (s - 0.2).abs() < 1e-6), "{third:?}");
}

/// A late or slow source is not lost; it is lost as long after its next pose was due as a fast source.
#[test]
fn allows_for_delay_and_rate_of_a_source() {
    for (rate_hz, delay_s, allowed_s) in [
        (100.0, 0.0, 0.0..0.001),
        (100.0, 0.1, 0.099..0.101),
        (30.0, 0.1, 0.099..0.101),
        // 2.5 intervals are 0.25 s, and some intervals are double.
        (10.0, 0.0, 0.099..0.16),
        (10.0, 0.1, 0.199..0.26),
        // Limited: older poses are useless for flight.
        (10.0, 0.45, 0.299..0.301),
    ] {
        let mut filter = PoseFilter::default();
        let mut newest = at(0.0);
        for i in 0..60 {
            let t = f64::from(i) / rate_hz;
            filter.handle_timeout(at(t + delay_s));
            // Every seventh pose is missing.
            if i % 7 == 5 {
                continue;
            }
            let late = Measured { arrival: at(t + delay_s), ..measured(t, DVec3::Z) };
            filter.handle_pose(&late).unwrap();
            newest = at(t);
            let is_lost = matches!(filter.poll_change(), Some(PoseChange::Lost(..)));
            assert!(!is_lost, "{rate_hz} Hz, {delay_s} s late, pose {i}");
        }
        let allowance_s = f64::from(filter.newest().unwrap().allowance_s);
        assert!(allowed_s.contains(&allowance_s), "{rate_hz} Hz, {delay_s} s: {allowance_s}");
        let lost_s = PoseConfig::default().hold_after_s + allowance_s;
        filter.handle_timeout(newest.plus_seconds(lost_s - 1e-3));
        assert_eq!(filter.poll_change(), None);
        filter.handle_timeout(newest.plus_seconds(lost_s + 1e-3));
        assert!(matches!(filter.poll_change(), Some(PoseChange::Lost(..))));
    }
}

#[test]
fn detects_a_stream_frozen_at_rest_by_the_gyroscope() {
    let mut filter = flying(0.0);
    let mut frozen = 0;
    for i in 1..100 {
        let t = 1.0 + 0.01 * f64::from(i);
        let gyro_radps = DVec3::Z * 0.5;
        let accel_mps2 = DVec3::Z * 9.81;
        filter.handle_imu(&ImuReading { stamp: at(t), accel_mps2, gyro_radps });
        let result = filter.handle_pose(&measured(t, DVec3::ZERO));
        frozen += u32::from(matches!(result, Err(Rejected::Frozen(_))));
    }
    assert!(frozen > 50, "{frozen}");
}

#[test]
fn rejects_poses_after_a_clock_jump() {
    let mut filter = flying(1.0);
    let late = Measured { arrival: at(3.2), ..measured(1.005, DVec3::X) };
    assert!(matches!(filter.handle_pose(&late), Err(Rejected::Clock(s)) if s > 2.0));
    let early = Measured { arrival: at(1.005), ..measured(1.3, DVec3::X) };
    assert!(matches!(filter.handle_pose(&early), Err(Rejected::Clock(s)) if s < 0.0));
    let back = Measured { arrival: at(1.005), ..measured(0.5, DVec3::X) };
    assert!(matches!(filter.handle_pose(&back), Err(Rejected::ClockJump(s)) if s > 0.4));
    assert_eq!(filter.rejected().clock, 3);
    filter.handle_pose(&measured(1.01, DVec3::X * 1.01)).unwrap();
}

#[test]
fn rejects_one_of_two_sources_that_disagree() {
    let mut filter = flying(1.0);
    for i in 1..100 {
        let t = 1.0 + 0.01 * f64::from(i);
        filter.handle_pose(&measured(t, DVec3::X * t)).unwrap();
        let other = Measured { source: 1, ..measured(t, DVec3::new(t, 0.4, 0.0)) };
        let result = filter.handle_pose(&other);
        let Err(Rejected::Disagree { other: 0, distance_m, .. }) = result else {
            panic!("{result:?}")
        };
        assert!((distance_m - 0.4).abs() < 0.01);
    }
    let quality = filter.quality(at(2.0));
    assert_eq!(quality.sources[1].rejected.disagree, 99);
    assert!((quality.rate_hz - 100.0).abs() < 20.0, "{}", quality.rate_hz);
}

#[test]
fn late_measurements_are_inserted_in_order() {
    // The same readings in order, and with one source 40 ms late, give the same result.
    let truth = |t: f64| Pose::new(DVec3::new((2.0 * t).sin(), t, 1.0), DQuat::from_rotation_z(t));
    let prompt = |t: f64| Measured::new(at(t), truth(t));
    let slow = |t: f64| Measured { source: 1, arrival: at(t + 0.04), ..prompt(t) };
    let (mut ordered, mut delayed) = (PoseFilter::default(), PoseFilter::default());
    for i in 0..200 {
        let t = 0.01 * f64::from(i);
        ordered.handle_pose(&prompt(t)).unwrap();
        delayed.handle_pose(&prompt(t)).unwrap();
        ordered.handle_pose(&slow(t + 0.003)).unwrap();
        if i >= 4 {
            let former = delayed.newest().unwrap().stamp;
            let sample = delayed.handle_pose(&slow(t - 0.037)).unwrap();
            assert_eq!(sample.stamp, former);
        }
    }
    for i in 197..=200 {
        delayed.handle_pose(&slow(0.01 * f64::from(i) - 0.007)).unwrap();
    }
    let (a, b) = (ordered.newest().unwrap(), delayed.newest().unwrap());
    assert_eq!(a.stamp, b.stamp);
    let off_m = (a.world_from_body.translation_m - b.world_from_body.translation_m).length();
    assert!(off_m < 1e-6, "{off_m}");
}

#[test]
fn excludes_an_imu_that_contradicts_the_poses() {
    let mut filter = PoseFilter::default();
    let mut left_out = false;
    for i in 0..1000 {
        let t = 0.005 * f64::from(i);
        let turned = Pose::new(DVec3::ZERO, DQuat::from_rotation_z(2.0 * t));
        let _ = filter.handle_pose(&Measured::new(at(t), turned));
        // The IMU's z axis is configured as another axis.
        let (accel_mps2, gyro_radps) = (DVec3::X * 9.81, DVec3::X * 2.0);
        filter.handle_imu(&ImuReading { stamp: at(t + 0.001), accel_mps2, gyro_radps });
        left_out |= filter.poll_change() == Some(PoseChange::ImuLeftOut);
    }
    assert!(left_out && !filter.quality(at(5.0)).imu);
    let twist = filter.newest().unwrap().twist;
    assert!((twist.angular_radps - DVec3::Z * 2.0).length() < 0.01, "{twist:?}");
}

#[test]
fn error_matches_the_estimated_sigma() {
    // 2 mm and 0.2 degrees of noise by a fixed generator.
    let mut seed = 1u64;
    let mut noise = move || {
        let mut sum = 0.0;
        for _ in 0..12 {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            sum += (seed >> 33) as f64 / f64::from(1u32 << 31);
        }
        sum - 6.0
    };
    let mut filter = PoseFilter::default();
    let (mut within, mut count) = (0, 0);
    for i in 0..2000 {
        let t = 0.01 * f64::from(i);
        let truth = DVec3::new((0.8 * t).sin(), (0.5 * t).cos(), 1.0);
        let p = truth + DVec3::new(noise(), noise(), noise()) * 2e-3;
        let sigma = PoseSigma { position_m: DVec3::splat(2e-3), rotation_rad: DVec3::splat(3e-3) };
        let turned = DQuat::from_scaled_axis(DVec3::new(noise(), noise(), noise()) * 3e-3);
        let measured =
            Measured { sigma: Some(sigma), ..Measured::new(at(t), Pose::new(p, turned)) };
        let sample = filter.handle_pose(&measured).unwrap();
        let sigma_m = filter.quality(at(t)).position_sigma_mm / 1e3;
        let off = sample.world_from_body.translation_m - truth;
        count += 3;
        within += [off.x, off.y, off.z].iter().filter(|off| off.abs() < 2.0 * sigma_m).count();
    }
    let share = within as f64 / f64::from(count);
    assert!((0.93..=1.0).contains(&share), "{share}");
    let quality = filter.quality(at(20.0));
    assert!(quality.position_sigma_mm < 2.0 && quality.innovation_sigmas < 3.0, "{quality:?}");
}

#[test]
fn inflates_the_covariance_of_an_overconfident_source() {
    // Ten times the stated noise.
    let mut seed = 5u64;
    let mut noise = move || {
        let mut sum = 0.0;
        for _ in 0..12 {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            sum += (seed >> 33) as f64 / f64::from(1u32 << 31);
        }
        sum - 6.0
    };
    let mut filter = PoseFilter::default();
    let mut late = 0;
    for i in 0..2000 {
        let t = 0.01 * f64::from(i);
        let truth = DVec3::new((0.8 * t).sin(), (0.5 * t).cos(), 1.0);
        let p = truth + DVec3::new(noise(), noise(), noise()) * 6e-3;
        let turned = DQuat::from_scaled_axis(DVec3::new(noise(), noise(), noise()) * 0.026);
        let result = filter.handle_pose(&Measured::new(at(t), Pose::new(p, turned)));
        late += u32::from(i >= 1000 && result.is_err());
    }
    assert!(late < 10, "{late} of the last 1000 were rejected");
    let quality = filter.quality(at(20.0));
    assert!(quality.position_sigma_mm > 1.0, "{quality:?}");
}

#[test]
fn settings_in_the_guide_are_the_defaults() {
    #[derive(serde::Deserialize)]
    struct File {
        pose: PoseConfig,
    }
    let guide = include_str!("../../../../docs/guides/pose.md");
    let (_, block) = guide.split_once("```toml\n").unwrap();
    let (block, _) = block.split_once("```").unwrap();
    let file: File = toml::from_str(block).unwrap();
    assert_eq!(file.pose, PoseConfig::default());
}

#[test]
fn rejects_invalid_settings_by_key() {
    let refused = |config: PoseConfig, key: &str| {
        let error = config.check().unwrap_err().to_string();
        assert!(error.starts_with(&format!("pose.{key} = ")), "{error}");
    };
    let usual = PoseConfig::default();
    usual.check().unwrap();
    refused(PoseConfig { hold_after_s: f64::NAN, ..usual }, "hold_after_s");
    refused(PoseConfig { hold_after_s: 0.6, ..usual }, "land_after_s");
    refused(PoseConfig { gate_sigmas: 1.0, ..usual }, "gate_sigmas");
    refused(PoseConfig { position_sigma_m: 0.0, ..usual }, "position_sigma_m");
}
