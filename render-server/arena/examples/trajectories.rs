//! Writes the filter's output for simulated flights, for tests/pose. For each flight, without and with 5 %
//! outliers, it writes the true and the fused poses as TUM trajectories. `ate.csv` has a line per flight: name
//! (flight, Hz, mm of noise, IMU, kind), absolute trajectory error [m], number of outliers, accepted outliers,
//! rejected true poses.
//!
//! `trajectories FOLDER`

#[path = "../tests/outliers/scenario.rs"]
mod scenario;

use std::fmt::Write;
use std::path::Path;

use glam::DVec3;
use scenario::{Flight, Scenario};
use vizflyt_protocol::geometry::{Body, Pose, World};

fn main() -> std::io::Result<()> {
    let folder = std::env::args_os().nth(1).expect("usage: trajectories FOLDER");
    let mut errors = String::new();
    for flight in [Flight::Hover, Flight::Eight, Flight::Dashes] {
        for rate_hz in [10.0, 30.0, 200.0] {
            for noise_m in [0.001, 0.005] {
                for imu in [true, false] {
                    // At 10 Hz and in a hard manoeuvre, poses without an IMU are not enough to detect outliers.
                    if imu && flight != Flight::Dashes || rate_hz > 10.0 {
                        write_flight(folder.as_ref(), &mut errors, flight, rate_hz, noise_m, imu)?;
                    }
                }
            }
        }
    }
    std::fs::write(Path::new(&folder).join("ate.csv"), errors)
}

fn write_flight(
    folder: &Path,
    errors: &mut String,
    flight: Flight,
    rate_hz: f64,
    noise_m: f64,
    imu: bool,
) -> std::io::Result<()> {
    let scenario =
        Scenario { seed: 1, rate_hz, noise_m, sent: true, burst: 1, agree: true, flight, imu };
    for (kind, share) in [("clean", 0.0), ("outliers", 0.05)] {
        let outcome = scenario.run(share, DVec3::ZERO);
        assert_eq!((outcome.resets(), outcome.lost()), (0, 0), "{scenario:?}, {kind}");
        let sensors = if imu { "yes" } else { "no" };
        let name = format!("{flight:?}-{rate_hz}-{:.0}-{sensors}-{kind}", noise_m * 1e3);
        let (outliers, accepted) = (outcome.outliers(), outcome.accepted_outliers().count());
        let left_out = outcome.left_out();
        let _ = writeln!(errors, "{name},{},{outliers},{accepted},{left_out}", outcome.ate_m());
        let (mut truth, mut fused) = (String::new(), String::new());
        for (t, sample, pose) in outcome.fused() {
            write_line(&mut truth, t, &pose);
            write_line(&mut fused, t, &sample.world_from_body);
        }
        std::fs::write(folder.join(format!("{name}-truth.tum")), truth)?;
        std::fs::write(folder.join(format!("{name}-fused.tum")), fused)?;
    }
    Ok(())
}

/// `t x y z qx qy qz qw`: TUM format (RGB-D SLAM benchmark). [s], [m, world]
fn write_line(to: &mut String, t: f64, pose: &Pose<World, Body>) {
    let (p, q) = (pose.translation_m, pose.rotation);
    let _ = writeln!(
        to,
        "{t:.6} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9}",
        p.x, p.y, p.z, q.x, q.y, q.z, q.w
    );
}
