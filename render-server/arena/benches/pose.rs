//! Pose filter: benefit of prediction (a table), and time per measurement.
//!
//! `cargo bench -p vizflyt-arena --bench pose`

#[path = "../tests/trial/mod.rs"]
mod trial;

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use glam::{DQuat, DVec3};
use trial::Trial;
use vizflyt_arena::pose::{ImuReading, Measured, PoseFilter};
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::time::ServerTime;

fn row(trial: Trial) {
    let with = |imu| Trial { imu, ..trial }.fly(1);
    let (alone, imu) = (with(false), with(true));
    println!(
        "| {} | {} | {} | {} | {:.0} | {:.0} | {:.1} | {:.1} | {:.0} | {:.0} | {:.1} | {:.2} | {:.2} | {:.1} |",
        trial.speed_mps,
        trial.rate_hz,
        trial.sigma_m * 1e3,
        trial.sigma_deg,
        trial.latency_s * 1e3,
        trial.dropout * 100.0,
        alone.measured_m * 1e3,
        alone.predicted_m * 1e3,
        alone.gain(),
        imu.gain(),
        alone.measured_deg,
        alone.predicted_deg,
        imu.predicted_deg,
        alone.accepted * 100.0,
    );
}

fn table() {
    println!(
        "| speed m/s | poses Hz | noise mm | noise deg | latency ms | lost % | as measured mm | \
         predicted mm | times less | with IMU | as measured deg | predicted deg | with IMU | accepted % |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|---|---|");
    let usual = Trial::default();
    for speed_mps in [1.0, 2.0, 3.0, 5.0, 10.0] {
        row(Trial { speed_mps, ..usual });
    }
    for rate_hz in [30.0, 60.0, 100.0] {
        row(Trial { rate_hz, ..usual });
    }
    for (sigma_m, sigma_deg) in [(0.002, 0.3), (0.01, 0.5), (0.03, 1.0)] {
        row(Trial { sigma_m, sigma_deg, rate_hz: 60.0, ..usual });
    }
    for latency_s in [0.02, 0.04, 0.08] {
        row(Trial { latency_s, rate_hz: 60.0, ..usual });
    }
    for dropout in [0.1, 0.3, 0.6] {
        row(Trial { dropout, ..usual });
    }
}

fn cost(criterion: &mut Criterion) {
    if std::env::args().all(|argument| argument != "--test") {
        table();
    }
    let at = |t: f64| ServerTime::from_ns(1_000_000_000).plus_seconds(t);
    let pose = |t: f64| {
        Measured::new(at(t), Pose::new(DVec3::X * 2.0 * t, DQuat::from_rotation_z(0.5 * t)))
    };
    let imu = |t: f64| ImuReading {
        stamp: at(t),
        accel_mps2: DVec3::Z * 9.81,
        gyro_radps: DVec3::Z * 0.5,
    };
    let mut warm = PoseFilter::default();
    for k in 0..200 {
        let _ = warm.handle_pose(&pose(0.005 * f64::from(k)));
        let t = 0.01 * f64::from(k / 2) + 0.001;
        if k % 2 == 1 && t < 0.96 {
            warm.handle_imu(&imu(t));
        }
    }
    assert!(warm.motion().is_some(), "it has poses");
    let mut group = criterion.benchmark_group("pose filter");
    group.bench_function("a pose", |bencher| {
        bencher.iter_batched_ref(
            || warm.clone(),
            |filter| filter.handle_pose(&pose(1.0)),
            BatchSize::SmallInput,
        );
    });
    // A late reading affects all newer ones; they are recomputed once, at the next request for a pose.
    for late_ms in [5u32, 30, 60] {
        let late_s = 1e-3 * f64::from(late_ms);
        let name =
            format!("a second of flight: 200 poses, 100 readings of the IMU, {late_ms} ms late");
        group.bench_function(name, |bencher| {
            bencher.iter_batched_ref(
                || warm.clone(),
                |filter| {
                    let mut readings = (0..100).map(|k| 1.001 + 0.01 * f64::from(k)).peekable();
                    for k in 0..200 {
                        let t = 1.0 + 0.005 * f64::from(k);
                        while let Some(stamp) = readings.next_if(|stamp| stamp + late_s < t) {
                            filter.handle_imu(&imu(stamp));
                        }
                        let _ = filter.handle_pose(&pose(t));
                    }
                    filter.motion()
                },
                BatchSize::SmallInput,
            );
        });
    }
    group.finish();
}

criterion_group!(benches, cost);
criterion_main!(benches);
