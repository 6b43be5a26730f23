use super::*;
use crate::noise::Noise;
use proptest::prelude::*;

const DT_S: f64 = 0.0025;

fn standing() -> SensorSample {
    SensorSample { accel_body_mps2: DVec3::Z * GRAVITY_MPS2, ..Default::default() }
}

fn vision_at(p: DVec3, yaw_rad: f64) -> VisionMeasurement {
    VisionMeasurement {
        world_from_body: Pose::new(p, DQuat::from_rotation_z(yaw_rad)),
        usec: 0,
        reset_counter: 0,
        sigma_m: 0.1,
        sigma_rad: 0.1,
        latency_s: 0.0,
    }
}

/// Drives an estimator on a virtual clock.
struct Bench {
    estimator: Estimator,
    ticks: u64,
}

impl Bench {
    fn new() -> Self {
        Self { estimator: Estimator::default(), ticks: 0 }
    }

    fn now(&self) -> AutopilotTime {
        AutopilotTime::from_ns(self.ticks * 2_500_000)
    }

    /// Stands for `seconds`; `vision` is fused at 50 Hz.
    fn stand(&mut self, seconds: f64, vision: Option<VisionMeasurement>) {
        for _ in 0..(seconds / DT_S) as u64 {
            self.ticks += 1;
            let now = self.now();
            self.estimator.handle_sensors(now, &standing(), DT_S, true);
            if let (Some(vision), true) = (&vision, self.ticks.is_multiple_of(8)) {
                self.estimator.handle_vision(now, vision);
            }
        }
    }
}

#[test]
fn position_needs_alignment_origin_and_a_second_of_vision() {
    let mut bench = Bench::new();
    assert!(!bench.estimator.set_origin(), "not before the start");
    let vision = vision_at(DVec3::new(3.0, -2.0, 0.5), 2.0);
    bench.stand(2.1, None);
    let health = bench.estimator.health(bench.now());
    assert!(health.attitude && !health.vision && !health.position);
    bench.stand(3.0, Some(vision));
    assert!(bench.estimator.health(bench.now()).vision);
    assert!(!bench.estimator.health(bench.now()).position, "no origin");
    let yaw_rad = yaw_of(bench.estimator.estimate().world_from_body);
    assert!((yaw_rad - 2.0).abs() < 1e-3, "heading needs no origin: {yaw_rad}");
    assert!(bench.estimator.set_origin() && !bench.estimator.set_origin());
    bench.stand(0.9, Some(vision));
    assert!(!bench.estimator.health(bench.now()).position);
    bench.stand(0.3, Some(vision));
    assert!(bench.estimator.health(bench.now()).position);
    let p = bench.estimator.estimate().p_world_m;
    assert!((p - DVec3::new(3.0, -2.0, 0.5)).length() < 0.01, "{p:?}");
}

#[test]
fn estimates_the_gyro_bias_while_standing() {
    let mut bench = Bench::new();
    let bias = DVec3::new(0.01, -0.02, 0.015);
    let mut sample = standing();
    sample.gyro_body_radps = bias;
    let mut noise = Noise::new(9, 9);
    for _ in 0..8000 {
        bench.ticks += 1;
        let now = bench.now();
        let shaken = SensorSample {
            accel_body_mps2: sample.accel_body_mps2 + noise.gaussian3() * 0.2,
            ..sample
        };
        bench.estimator.handle_sensors(now, &shaken, DT_S, true);
    }
    assert!(bench.estimator.estimate().omega_body_radps.length() < 2e-3);
    let up = bench.estimator.estimate().world_from_body * DVec3::Z;
    assert!(up.angle_between(DVec3::Z) < 0.01);
}

#[test]
fn rejects_an_outlier_and_follows_an_announced_jump() {
    let mut bench = Bench::new();
    let here = vision_at(DVec3::ZERO, 0.0);
    bench.stand(2.1, None);
    bench.estimator.set_origin();
    bench.stand(3.0, Some(here));
    let far = DVec3::new(4.0, 0.0, 0.0);
    let now = bench.now();
    bench.stand(0.1, None);
    bench.estimator.handle_vision(now.plus_seconds(0.1), &vision_at(far, 0.0));
    assert!(bench.estimator.estimate().p_world_m.length() < 0.05, "outlier");
    bench.stand(1.0, Some(here));
    let jumped = VisionMeasurement { reset_counter: 1, ..vision_at(far, 1.0) };
    bench.stand(0.1, Some(jumped));
    assert!((bench.estimator.estimate().p_world_m - far).length() < 0.05);
    assert!((yaw_of(bench.estimator.estimate().world_from_body) - 1.0).abs() < 0.01);
}

#[test]
fn accepts_a_persistent_jump_after_the_position_was_lost() {
    let mut bench = Bench::new();
    bench.stand(2.1, None);
    bench.estimator.set_origin();
    bench.stand(3.0, Some(vision_at(DVec3::ZERO, 0.0)));
    let far = DVec3::new(0.0, 5.0, 0.0);
    bench.stand(POSITION_LOST_S + 2.0, Some(vision_at(far, 0.0)));
    assert!((bench.estimator.estimate().p_world_m - far).length() < 0.1);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, failure_persistence: None, ..Default::default() })]
    #[test]
    fn stays_finite_for_any_input(
        inputs in prop::collection::vec(
            (prop::array::uniform6(prop_oneof![8 => -200.0..200.0f64, 1 => prop::num::f64::ANY]),
             prop::array::uniform3(prop_oneof![8 => -20.0..20.0f64, 1 => prop::num::f64::ANY]),
             any::<u64>(), any::<u8>()), 1..200),
    ) {
        let mut bench = Bench::new();
        bench.stand(2.1, None);
        bench.estimator.set_origin();
        for (sensors, p, usec, reset_counter) in inputs {
            let [ax, ay, az, gx, gy, gz] = sensors;
            let limited = |v: DVec3, most: f64| if v.is_finite() { v.clamp_length_max(most) } else { v };
            let sample = SensorSample {
                accel_body_mps2: limited(DVec3::new(ax, ay, az), 270.0),
                gyro_body_radps: limited(DVec3::new(gx, gy, gz), 60.0),
                baro_m: ax,
                ..Default::default()
            };
            for _ in 0..8 {
                bench.ticks += 1;
                let now = bench.now();
                bench.estimator.handle_sensors(now, &sample, DT_S, false);
            }
            let now = bench.now();
            let vision = VisionMeasurement { usec, reset_counter: reset_counter % 3, ..vision_at(DVec3::from(p), p[0]) };
            bench.estimator.handle_vision(now, &vision);
            let e = bench.estimator.estimate();
            prop_assert!(e.p_world_m.is_finite() && e.v_world_mps.is_finite());
            prop_assert!(e.world_from_body.is_normalized() && e.omega_body_radps.is_finite());
        }
    }
}
