use super::*;
use proptest::prelude::*;
use vizflyt_protocol::random::SplitMix64;

/// Parameters of a motion by hand and its measurement.
#[derive(Clone, Copy, Debug)]
struct Lab {
    latency_s: f64,
    pose_hz: f64,
    gyro_hz: f64,
    /// Noise of the attitudes. [rad]
    pose_sigma_rad: f64,
    /// Noise of the gyroscope. [rad/s]
    gyro_sigma_radps: f64,
    /// Duration of a motion. [s]
    motion_s: f64,
    seed: u64,
}

const LAB: Lab = Lab {
    latency_s: 0.1,
    pose_hz: 100.0,
    gyro_hz: 100.0,
    pose_sigma_rad: 0.002,
    gyro_sigma_radps: 0.01,
    motion_s: 1.3,
    seed: 1,
};

/// Noise with a standard deviation of about one.
struct Noise(SplitMix64);

impl Noise {
    fn next(&mut self) -> f64 {
        let mut sum = -6.0;
        for _ in 0..12 {
            sum += self.0.unit();
        }
        sum
    }

    fn vector(&mut self) -> DVec3 {
        DVec3::new(self.next(), self.next(), self.next())
    }
}

/// Motion of the check: rest, a quarter turn left, nose raised, with rests in between.
fn attitude(at_s: f64, motion_s: f64) -> DQuat {
    let eased = |from_s: f64| {
        let share = ((at_s - from_s) / motion_s).clamp(0.0, 1.0);
        share * share * (3.0 - 2.0 * share)
    };
    DQuat::from_rotation_z(0.3 + 1.5 * eased(6.0))
        * DQuat::from_rotation_y(-0.55 * eased(7.5 + motion_s))
        * DQuat::from_rotation_x(0.06 * eased(2.0) - 0.05 * eased(4.0))
}

fn measure(lab: &Lab) -> Result<Delay, NoDelay> {
    let mut noise = Noise(SplitMix64::new(lab.seed));
    let mut meter = DelayMeter::default();
    let end_s = 9.5 + 2.0 * lab.motion_s;
    let bias = noise.vector() * 0.005;
    // The two streams do not start at the same instant.
    for step in 0..(end_s * lab.gyro_hz) as u32 {
        let at_s = (f64::from(step) + 0.37) / lab.gyro_hz;
        let (a, b) = (attitude(at_s - 5e-4, lab.motion_s), attitude(at_s + 5e-4, lab.motion_s));
        let rate = (a.conjugate() * b).to_scaled_axis() / 1e-3;
        meter.add_gyro(100.0 + at_s, rate + bias + noise.vector() * lab.gyro_sigma_radps);
    }
    // A rotated world frame, and another body frame of the stream.
    let (laid, body) = (DQuat::from_rotation_x(1.1), DQuat::from_rotation_y(-0.8));
    for step in 0..(end_s * lab.pose_hz) as u32 {
        let at_s = f64::from(step) / lab.pose_hz;
        let shake = DQuat::from_scaled_axis(noise.vector() * lab.pose_sigma_rad);
        let rotation = laid * attitude(at_s - lab.latency_s, lab.motion_s) * shake * body;
        meter.add_pose(100.0 + at_s, rotation);
    }
    meter.delay()
}

#[test]
fn measures_a_delay() {
    let found = measure(&LAB).unwrap();
    assert!((found.ms - 100.0).abs() < 3.0, "{found:?}");
    assert!(found.uncertain_ms < 6.0, "{found:?}");
    // The configured delay is too large.
    let found = measure(&Lab { latency_s: -0.05, ..LAB }).unwrap();
    assert!((found.ms + 50.0).abs() < 3.0, "{found:?}");
}

#[test]
fn rejects_motions_that_are_too_gentle() {
    assert_eq!(measure(&Lab { motion_s: 12.0, ..LAB }), Err(NoDelay::Gentle));
    let noisy = Lab { pose_sigma_rad: 0.3, ..LAB };
    assert!(measure(&noisy).is_err());
    assert_eq!(DelayMeter::default().delay(), Err(NoDelay::Silent));
}

#[test]
fn rejects_another_vehicles_gyroscope() {
    let mut meter = DelayMeter::default();
    let mut noise = Noise(SplitMix64::new(7));
    for step in 0..1200u32 {
        let at_s = f64::from(step) * 0.01;
        meter.add_gyro(at_s, noise.vector() * 0.01);
        meter.add_pose(at_s, attitude(at_s, 1.3));
    }
    assert_eq!(meter.delay(), Err(NoDelay::Unlike));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    /// At any rates, the error of the delay is within its stated uncertainty, and that is small.
    #[test]
    fn delays_are_found_at_any_rate(
        latency_s in 0.0..0.3f64, pose_hz in 10.0..200.0f64, gyro_hz in 10.0..200.0f64,
        pose_sigma_rad in 0.0005..0.01f64, motion_s in 0.8..1.6f64, seed: u64,
    ) {
        let lab = Lab { latency_s, pose_hz, gyro_hz, pose_sigma_rad, motion_s, seed, ..LAB };
        let found = measure(&lab);
        let off_ms = found.map(|found| (found.ms - latency_s * 1e3).abs());
        // For a noisy slow source there may be no result, but never a wrong one.
        if let (Ok(found), Ok(off_ms)) = (found, off_ms) {
            prop_assert!(off_ms < 10.0_f64.max(found.uncertain_ms), "{lab:?}: {found:?}");
        } else {
            prop_assert!(pose_sigma_rad > 0.004 && pose_hz < 50.0, "{lab:?}: {found:?}");
        }
    }
}
