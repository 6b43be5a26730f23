//! A person carries the vehicle about in front of the motion capture: lifts it, pushes it forward,
//! turns it left, raises its nose, puts it back; over and over.

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};

/// What is done one after another: (up [m], ahead [m], left [rad], nose up [rad]), held until the next.
const HELD: [(f64, f64, f64, f64); 5] = [
    (0.0, 0.0, 0.0, 0.0),
    (0.5, 0.0, 0.0, 0.0),
    (0.5, 0.6, 0.0, 0.0),
    (0.5, 0.6, std::f64::consts::FRAC_PI_2, 0.0),
    (0.5, 0.6, std::f64::consts::FRAC_PI_2, std::f64::consts::FRAC_PI_6),
];
/// Each takes so long, the last third of it at rest. [s]
const EACH_S: f64 = 3.0;

/// Returns where the vehicle is after so many seconds.
pub(super) fn carried(world_from_start: &Pose<World, Body>, seconds: f64) -> Pose<World, Body> {
    let at = seconds / EACH_S;
    let index = at.floor() as usize % HELD.len();
    let (from, to) = (HELD[(index + HELD.len() - 1) % HELD.len()], HELD[index]);
    // Before anything was done, it stands.
    let from = if at < 1.0 { HELD[0] } else { from };
    let share = (at.fract() * 1.5).min(1.0);
    let smooth = share * share * (3.0 - 2.0 * share);
    let mix = |a: f64, b: f64| a + (b - a) * smooth;
    let (up_m, ahead_m) = (mix(from.0, to.0), mix(from.1, to.1));
    let (left_rad, nose_rad) = (mix(from.2, to.2), mix(from.3, to.3));
    let p = world_from_start.translation_m
        + DVec3::Z * up_m
        + world_from_start.rotate(DVec3::X * ahead_m);
    let turned = DQuat::from_rotation_z(left_rad) * DQuat::from_rotation_y(-nose_rad);
    Pose::new(p, world_from_start.rotation * turned)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_is_held_at_its_end() {
        let start = Pose::new(DVec3::new(1.0, 2.0, 0.0), DQuat::from_rotation_z(0.3));
        let at = |seconds| carried(&start, seconds);
        assert_eq!(at(2.9), start);
        assert!((at(5.9).translation_m - DVec3::new(1.0, 2.0, 0.5)).length() < 1e-9);
        let ahead = at(8.9).translation_m - at(5.9).translation_m;
        assert!((ahead - start.rotate(DVec3::X * 0.6)).length() < 1e-9);
        let turned = start.rotation.conjugate() * at(11.9).rotation;
        assert!((turned.to_scaled_axis().z - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
        assert!((at(14.9).rotate(DVec3::X).z - 0.5).abs() < 1e-9);
        assert!((at(17.9).translation_m - start.translation_m).length() < 1e-9);
        // Nothing jumps.
        for step in 0..20_000u32 {
            let (a, b) = (at(f64::from(step) * 1e-3), at(f64::from(step + 1) * 1e-3));
            assert!((a.translation_m - b.translation_m).length() < 1e-3, "at {step} ms");
            assert!(a.rotation.angle_between(b.rotation) < 2e-3, "at {step} ms");
        }
    }
}
