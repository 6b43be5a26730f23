//! {{name}}: climbs to 1 m, flies forward, and turns towards larger depth.
//!
//! Fly it:   vizflyt fly {{folder}}
//! Test it:  cargo test

use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::{Autonomy, Axes, CameraImage, Observation, Setpoint, YawTarget};

/// Height to fly at. [m]
const HEIGHT_M: f64 = 1.0;
/// Limit of depth; pixels without a return count as this far. [m]
const FAR_M: f64 = 8.0;
/// Below this distance, only turn. [m]
const STOP_M: f64 = 1.2;

struct {{class}};

impl Autonomy for {{class}} {
    fn on_image(&mut self, obs: &Observation<'_>) -> Option<Setpoint> {
        let pose = obs.vehicle().and_then(|vehicle| vehicle.world_from_body);
        let height_m = pose.map(|pose| pose.translation_m.z);
        let (v_mps, turn_radps) = steer(&obs.camera("front")?, height_m);
        Some(Setpoint::Velocity { v_mps, axes: Axes::Heading, yaw: YawTarget::Rate(turn_radps) })
    }
}

/// Returns a velocity (forward, left, up) [m/s] and a turn rate, positive to the left [rad/s], for one image.
/// `height_m` is `None` if the course withholds it.
fn steer(image: &CameraImage<'_>, height_m: Option<f64>) -> (DVec3, f64) {
    let depth_m = |x, y| image.depth_m(x, y).map_or(FAR_M, |depth_m| f64::from(depth_m).min(FAR_M));
    let (columns, rows) = (image.width_px, image.height_px);
    // Rows at the height of the vehicle.
    let band = rows / 3..(2 * rows / 3).max(rows / 3 + 1);

    // Gradient: the slope of the depth from the middle to the right edge, by least squares over the mean depth of each
    // column.
    let (mut moment, mut spread) = (0.0, 0.0);
    for column in 0..columns {
        let x = 2.0 * (f64::from(column) + 0.5) / f64::from(columns) - 1.0;
        let mean_m = band.clone().map(|row| depth_m(column, row)).sum::<f64>() / band.len() as f64;
        moment += x * mean_m;
        spread += x * x;
    }
    let gradient_m = moment / spread;

    // Free distance ahead: the 5 % quantile of the middle third, because the nearest pixels may be noise.
    let middle = columns / 3..(2 * columns / 3).max(columns / 3 + 1);
    let mut ahead: Vec<f64> =
        middle.flat_map(|column| band.clone().map(move |row| depth_m(column, row))).collect();
    ahead.sort_by(f64::total_cmp);
    let ahead_m = ahead[ahead.len() / 20];

    let forward_mps = (0.5 * (ahead_m - STOP_M)).clamp(0.0, 1.0);
    let turn_radps = if ahead_m >= STOP_M {
        (-0.4 * gradient_m).clamp(-1.0, 1.0)
    } else if gradient_m > 0.0 {
        -0.8 // a wall: turn until there is free space
    } else {
        0.8
    };
    let up_mps = height_m.map_or(0.0, |height_m| (HEIGHT_M - height_m).clamp(-0.5, 0.5));
    (DVec3::new(forward_mps, 0.0, up_mps), turn_radps)
}

fn main() -> std::process::ExitCode {
    vizflyt_sdk::run({{class}})
}

/// Tests that need no vehicle.
#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_sdk::{CameraInfo, HostTime, ImageStamps, Intrinsics, ObservationBuffer};

    /// Steers with an image with these depths in the left and right half. [mm]
    fn see(left_mm: u16, right_mm: u16, height_m: Option<f64>) -> (DVec3, f64) {
        let intrinsics = Intrinsics::from_horizontal_fov(64, 48, 90_f64.to_radians());
        let front = CameraInfo::forward("front", intrinsics);
        let mut buffer = ObservationBuffer::new(&[front]);
        let stamps = ImageStamps { seq: 1, ..ImageStamps::default() };
        buffer.set_image(0, stamps, |planes| {
            for row in planes.depth_mm.chunks_mut(64) {
                row[..32].fill(left_mm);
                row[32..].fill(right_mm);
            }
        });
        steer(&buffer.observation().cameras().next().unwrap(), height_m)
    }

    #[test]
    fn it_flies_where_there_is_room() {
        let (v_mps, turn_radps) = see(8000, 8000, Some(1.0));
        assert!(v_mps.x > 0.5 && turn_radps.abs() < 1e-9, "{v_mps} {turn_radps}");
        assert!(see(0, 0, Some(1.0)).0.x > 0.5, "pixels without a return must count as free space");
    }

    #[test]
    fn it_turns_to_the_deeper_side() {
        assert!(see(8000, 3000, Some(1.0)).1 > 0.2);
        assert!(see(3000, 8000, Some(1.0)).1 < -0.2);
    }

    #[test]
    fn it_stops_before_a_wall_and_turns() {
        let (v_mps, turn_radps) = see(800, 800, Some(1.0));
        assert!(v_mps.x == 0.0 && turn_radps != 0.0, "{v_mps} {turn_radps}");
    }

    #[test]
    fn it_keeps_its_height() {
        assert!(see(8000, 8000, Some(0.5)).0.z > 0.0);
        assert!(see(8000, 8000, Some(1.5)).0.z < 0.0);
        assert!(see(8000, 8000, None).0.z == 0.0);
    }
}
