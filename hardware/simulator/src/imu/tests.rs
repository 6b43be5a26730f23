//! Noise measured by its Allan deviation and compared with data sheets; ranges and seeds.

use vizflyt_protocol::mavlink::MAX_PACKET;

use super::*;
use crate::simulation::{Simulation, SimulationConfig};

const DT_S: f64 = 0.0025;

/// Returns the Allan deviation of samples at averages of `count` of them: the root of half the mean square of the
/// differences of successive averages (IEEE Std 952-1997, annex C, equation C.5).
fn allan(samples: &[f64], count: usize) -> f64 {
    let means: Vec<f64> =
        samples.chunks_exact(count).map(|c| c.iter().sum::<f64>() / count as f64).collect();
    let squares: f64 = means.windows(2).map(|w| (w[1] - w[0]).powi(2)).sum();
    (squares / (2.0 * (means.len() - 1) as f64)).sqrt()
}

/// Returns the measurements of a standing sensor along x: gyro and accelerometer.
fn standing(model: ImuModel, samples: usize) -> [Vec<f64>; 2] {
    let mut imu = Imu::new(model, 5);
    let mut sample = || imu.sample(DVec3::ZERO, DVec3::ZERO, 0.0, [0.0; 4], DT_S);
    let all: Vec<_> = (0..samples).map(|_| sample()).collect();
    [
        all.iter().map(|s| s.gyro_body_radps.x).collect(),
        all.iter().map(|s| s.accel_body_mps2.x).collect(),
    ]
}

#[test]
fn white_noise_matches_the_data_sheet() {
    // (name, degrees a second and g per root hertz), as printed in the data sheets.
    for (name, gyro_dps, accel_g) in
        [("icm-42688-p", 0.0028, 70e-6), ("bmi088", 0.014, 175e-6), ("mpu-6000", 0.005, 400e-6)]
    {
        let model: ImuModel = name.parse().unwrap();
        let [gyro, accel] =
            standing(ImuModel { gyro_walk: 0.0, accel_walk: 0.0, ..model }, 100_000);
        for (samples, density) in
            [(gyro, gyro_dps * std::f64::consts::PI / 180.0), (accel, accel_g * 9.80665)]
        {
            // At 25 ms, 100 ms and 0.5 s; the smallest number of averages, 500, gives the deviation to about 4 %.
            for count in [10, 40, 200] {
                let tau_s = count as f64 * DT_S;
                let ratio = allan(&samples, count) / (density / (2.0 * tau_s).sqrt());
                assert!((ratio - 1.0).abs() < 0.13, "{name} at {tau_s} s: {ratio}");
            }
        }
    }
}

#[test]
fn bias_drifts_at_the_configured_rate() {
    let model: ImuModel = "icm-42688-p".parse().unwrap();
    let quiet = ImuModel { gyro_density: 0.0, accel_density: 0.0, ..model };
    let [gyro, accel] = standing(quiet, 400_000);
    for (samples, walk) in [(gyro, model.gyro_walk), (accel, model.accel_walk)] {
        // Over 1 s and 4 s: 1000 averages, and 250.
        for count in [400, 1600] {
            let tau_s = count as f64 * DT_S;
            let ratio = allan(&samples, count) / (walk * (tau_s / 3.0).sqrt());
            assert!((ratio - 1.0).abs() < 0.2, "at {tau_s} s: {ratio}");
        }
    }
}

#[test]
fn the_default_model_has_the_noise_of_the_frame() {
    let [gyro, accel] = standing(ImuModel::default(), 4000);
    for (samples, sigma, bias) in [(gyro, 0.01, 0.003), (accel, 0.2, 0.03)] {
        let mean = samples.iter().sum::<f64>() / 4000.0;
        let square = samples.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / 4000.0;
        assert!(mean.abs() < 4.0 * bias, "bias {mean}");
        assert!((square.sqrt() / sigma - 1.0).abs() < 0.06, "sigma {}", square.sqrt());
    }
    // Bit-exact, because the noise affects every grade.
    assert_eq!(ImuModel::default().sigma(), [0.01, 0.2]);
}

#[test]
fn seeds_are_repeatable_and_ranges_limit() {
    let run = |model: ImuModel, seed| {
        let far = DVec3::splat(1e6);
        Imu::new(model, seed).sample(far, -far, 0.0, [0.0; 4], DT_S)
    };
    let frame = ImuModel::default();
    assert_eq!(run(frame, 1), run(frame, 1));
    assert_ne!(run(frame, 1).baro_m, run(frame, 2).baro_m);
    assert_eq!(run(frame, 1).accel_body_mps2, DVec3::splat(157.0));
    assert_eq!(run(frame, 1).gyro_body_radps, DVec3::splat(-34.9));
    let wide: ImuModel = "bmi088".parse().unwrap();
    assert!((run(wide, 1).accel_body_mps2.x - 24.0 * 9.80665).abs() < 1e-9);
}

#[test]
fn names_parse_and_print() {
    for model in MODELS {
        assert_eq!(model.to_string().parse(), Ok(model));
    }
    let error = "mpu".parse::<ImuModel>().unwrap_err().to_string();
    assert!(error.contains("'mpu'") && error.contains("bmi088"), "{error}");
}

#[test]
fn the_simulation_uses_the_selected_sensor() {
    let sent = |imu: ImuModel| {
        let mut lab = Simulation::new(SimulationConfig { imu, ..Default::default() }).unwrap();
        let mut bytes = Vec::new();
        for _ in 0..1200 {
            lab.tick();
            let mut buffer = [0; MAX_PACKET];
            while let Some(packet) = lab.poll_mavlink(&mut buffer) {
                bytes.extend_from_slice(packet);
            }
        }
        bytes
    };
    let frame = sent(ImuModel::default());
    assert_eq!(frame, sent("frame".parse().unwrap()));
    let others = ["icm-42688-p", "bmi088", "mpu-6000"].map(|name| sent(name.parse().unwrap()));
    for (i, other) in others.iter().enumerate() {
        assert!(*other != frame && others[..i].iter().all(|before| before != other), "{i}");
    }
}
