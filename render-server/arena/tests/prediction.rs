//! Benefit of prediction, compared with a known truth. `cargo bench -p vizflyt-arena --bench pose` prints the
//! table.

mod trial;

use trial::Trial;

#[test]
fn prediction_reduces_the_error_of_images_to_a_fifth() {
    for rate_hz in [30.0, 60.0, 100.0, 200.0] {
        for imu in [false, true] {
            let errors = Trial { rate_hz, imu, ..Trial::default() }.fly(1);
            assert!(errors.gain() >= 5.0, "{rate_hz} Hz, IMU {imu}: {errors:?}");
            assert!(errors.accepted > 0.99, "{rate_hz} Hz, IMU {imu}: {errors:?}");
            assert!(errors.predicted_deg < errors.measured_deg, "{rate_hz} Hz: {errors:?}");
        }
    }
}

#[test]
fn prediction_works_with_noise_dropouts_and_latency() {
    let hard = Trial { sigma_m: 0.01, sigma_deg: 0.5, rate_hz: 60.0, ..Trial::default() };
    for trial in [
        hard,
        Trial { dropout: 0.2, ..Trial::default() },
        Trial { latency_s: 0.04, rate_hz: 60.0, ..Trial::default() },
    ] {
        let errors = trial.fly(2);
        assert!(errors.gain() >= 5.0, "{trial:?}: {errors:?}");
        assert!(errors.accepted > 0.95, "{trial:?}: {errors:?}");
    }
}
