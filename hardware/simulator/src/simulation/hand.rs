//! Motion of a vehicle in a person's hand, in front of the motion capture: lift, push forward, turn left, raise the
//! nose, raise the left side, put back; repeated.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_6};

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};

use crate::airframe::GRAVITY_MPS2;

/// Poses at the end of each motion: up [m], ahead [m], left [rad], nose up [rad], left side up [rad].
const HELD: [[f64; 5]; 6] = [
    [0.0; 5],
    [0.5, 0.0, 0.0, 0.0, 0.0],
    [0.5, 0.6, 0.0, 0.0, 0.0],
    [0.5, 0.6, FRAC_PI_2, 0.0, 0.0],
    [0.5, 0.6, FRAC_PI_2, FRAC_PI_6, 0.0],
    [0.5, 0.6, FRAC_PI_2, 0.0, FRAC_PI_6],
];
/// Duration of each motion, the last third at rest [s].
const EACH_S: f64 = 3.0;

/// Returns the pose of the vehicle after `seconds`.
pub(super) fn carried(world_from_start: &Pose<World, Body>, seconds: f64) -> Pose<World, Body> {
    let at = seconds / EACH_S;
    let index = at.floor() as usize % HELD.len();
    let (from, to) = (HELD[(index + HELD.len() - 1) % HELD.len()], HELD[index]);
    // Before the first motion, it stands.
    let from = if at < 1.0 { HELD[0] } else { from };
    let share = (at.fract() * 1.5).min(1.0);
    let smooth = share * share * (3.0 - 2.0 * share);
    let [up_m, ahead_m, left_rad, nose_rad, side_rad] =
        std::array::from_fn(|i| from[i] + (to[i] - from[i]) * smooth);
    let p = world_from_start.translation_m
        + DVec3::Z * up_m
        + world_from_start.rotate(DVec3::X * ahead_m);
    let turned = DQuat::from_rotation_z(left_rad)
        * DQuat::from_rotation_y(-nose_rad)
        * DQuat::from_rotation_x(side_rad);
    Pose::new(p, world_from_start.rotation * turned)
}

/// Returns the IMU's measurements at that time over a sample of `dt_s`: specific force [m/s^2, body] and angular
/// velocity [rad/s, body].
pub(super) fn felt(
    world_from_start: &Pose<World, Body>,
    seconds: f64,
    dt_s: f64,
) -> (DVec3, DVec3) {
    let at = |seconds| carried(world_from_start, seconds);
    let (before, now, after) = (at(seconds - dt_s), at(seconds), at(seconds + dt_s));
    let bend_m = before.translation_m + after.translation_m - 2.0 * now.translation_m;
    let felt_world = bend_m / (dt_s * dt_s) + DVec3::Z * GRAVITY_MPS2;
    let turned = (before.rotation.conjugate() * after.rotation).normalize();
    // Shortest rotation.
    let turned = if turned.w < 0.0 { -turned } else { turned };
    (now.rotation.conjugate() * felt_world, turned.to_scaled_axis() / (2.0 * dt_s))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_imu_measures_the_motion_of_the_hand() {
        let start = Pose::new(DVec3::new(1.0, 2.0, 0.0), DQuat::from_rotation_z(0.3));
        let (mut turned_rad, mut risen_mps) = (0.0, 0.0);
        for step in 0..6000u32 {
            let (felt, omega) = felt(&start, f64::from(step) * 2.5e-3, 2.5e-3);
            let seconds = f64::from(step) * 2.5e-3;
            turned_rad += omega.z * 2.5e-3 * f64::from(u8::from((9.0..12.0).contains(&seconds)));
            risen_mps += (felt.z - GRAVITY_MPS2) * 2.5e-3 * f64::from(u8::from(seconds < 4.0));
        }
        assert!((turned_rad - FRAC_PI_2).abs() < 1e-3, "{turned_rad}");
        // Half-way up, at maximum speed.
        assert!((risen_mps - 0.375).abs() < 1e-2, "{risen_mps}");
        let (still, _) = felt(&start, 2.9, 2.5e-3);
        assert!((still - DVec3::Z * GRAVITY_MPS2).length() < 1e-6);
    }

    #[test]
    fn each_motion_ends_at_rest_without_jumps() {
        let start = Pose::new(DVec3::new(1.0, 2.0, 0.0), DQuat::from_rotation_z(0.3));
        let at = |seconds| carried(&start, seconds);
        assert_eq!(at(2.9), start);
        assert!((at(5.9).translation_m - DVec3::new(1.0, 2.0, 0.5)).length() < 1e-9);
        let ahead = at(8.9).translation_m - at(5.9).translation_m;
        assert!((ahead - start.rotate(DVec3::X * 0.6)).length() < 1e-9);
        let turned = start.rotation.conjugate() * at(11.9).rotation;
        assert!((turned.to_scaled_axis().z - FRAC_PI_2).abs() < 1e-9);
        assert!((at(14.9).rotate(DVec3::X).z - 0.5).abs() < 1e-9);
        assert!((at(17.9).rotate(DVec3::Y).z - 0.5).abs() < 1e-9);
        assert!((at(20.9).translation_m - start.translation_m).length() < 1e-9);
        // No jumps.
        for step in 0..20_000u32 {
            let (a, b) = (at(f64::from(step) * 1e-3), at(f64::from(step + 1) * 1e-3));
            assert!((a.translation_m - b.translation_m).length() < 1e-3, "at {step} ms");
            assert!(a.rotation.angle_between(b.rotation) < 2e-3, "at {step} ms");
        }
    }
}
