//! Conversions between world and NED, and between body and FRD. Each vector conversion is its own inverse.

use core::f64::consts::{FRAC_1_SQRT_2, FRAC_PI_2};

use glam::{DQuat, DVec3};

use crate::geometry::wrap_pi;

/// Converts a vector from world (east, north, up) to NED axes.
///
/// ```
/// use glam::DVec3;
/// use vizflyt_protocol::mavlink::ned_from_world;
/// assert_eq!(ned_from_world(DVec3::new(1.0, 2.0, 3.0)), DVec3::new(2.0, 1.0, -3.0));
/// ```
pub fn ned_from_world(v_world: DVec3) -> DVec3 {
    DVec3::new(v_world.y, v_world.x, -v_world.z)
}

/// Converts a vector from NED axes to world.
///
/// ```
/// use glam::DVec3;
/// use vizflyt_protocol::mavlink::world_from_ned;
/// assert_eq!(world_from_ned(DVec3::new(2.0, 1.0, -3.0)), DVec3::new(1.0, 2.0, 3.0));
/// ```
pub fn world_from_ned(v_ned: DVec3) -> DVec3 {
    ned_from_world(v_ned)
}

/// Converts a vector from body (forward, left, up) to FRD axes.
///
/// ```
/// use glam::DVec3;
/// use vizflyt_protocol::mavlink::frd_from_body;
/// assert_eq!(frd_from_body(DVec3::new(1.0, 2.0, 3.0)), DVec3::new(1.0, -2.0, -3.0));
/// ```
pub fn frd_from_body(v_body: DVec3) -> DVec3 {
    DVec3::new(v_body.x, -v_body.y, -v_body.z)
}

/// Converts a vector from FRD axes to body.
///
/// ```
/// use glam::DVec3;
/// use vizflyt_protocol::mavlink::body_from_frd;
/// assert_eq!(body_from_frd(DVec3::new(1.0, -2.0, -3.0)), DVec3::new(1.0, 2.0, 3.0));
/// ```
pub fn body_from_frd(v_frd: DVec3) -> DVec3 {
    frd_from_body(v_frd)
}

/// Half a turn about (1, 1, 0): swaps x and y, negates z.
const NED_FROM_WORLD: DQuat = DQuat::from_xyzw(FRAC_1_SQRT_2, FRAC_1_SQRT_2, 0.0, 0.0);
/// Half a turn about x: negates y and z.
const FRD_FROM_BODY: DQuat = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);

/// Converts an attitude from body-to-world to FRD-to-NED.
///
/// ```
/// use glam::{DQuat, DVec3};
/// use vizflyt_protocol::mavlink::ned_rotation_from_world;
/// // Level and facing north (world yaw 90 degrees) is the NED identity.
/// let ned_from_frd = ned_rotation_from_world(DQuat::from_rotation_z(90f64.to_radians()));
/// assert!((ned_from_frd * DVec3::X - DVec3::X).length() < 1e-12);
/// assert!((ned_from_frd * DVec3::Z - DVec3::Z).length() < 1e-12);
/// ```
pub fn ned_rotation_from_world(world_from_body: DQuat) -> DQuat {
    (NED_FROM_WORLD * world_from_body * FRD_FROM_BODY).normalize()
}

/// Converts an attitude from FRD-to-NED to body-to-world.
///
/// ```
/// use glam::{DQuat, DVec3};
/// use vizflyt_protocol::mavlink::world_rotation_from_ned;
/// // NED identity: level and facing north, which is world y.
/// let world_from_body = world_rotation_from_ned(DQuat::IDENTITY);
/// assert!((world_from_body * DVec3::X - DVec3::Y).length() < 1e-12);
/// assert!((world_from_body * DVec3::Z - DVec3::Z).length() < 1e-12);
/// ```
pub fn world_rotation_from_ned(ned_from_frd: DQuat) -> DQuat {
    // Both half turns are their own inverses (up to the sign, which does not change a rotation).
    (NED_FROM_WORLD * ned_from_frd * FRD_FROM_BODY).normalize()
}

/// Converts a heading from world (from east, counter-clockwise) to NED (from north, clockwise). [rad]
///
/// ```
/// use vizflyt_protocol::mavlink::yaw_ned_from_world;
/// assert!((yaw_ned_from_world(0.0) - 90f64.to_radians()).abs() < 1e-12); // east
/// assert!(yaw_ned_from_world(90f64.to_radians()).abs() < 1e-12); // north
/// ```
pub fn yaw_ned_from_world(yaw_world_rad: f64) -> f64 {
    wrap_pi(FRAC_PI_2 - yaw_world_rad)
}

/// Converts a heading from NED to world. [rad]
///
/// ```
/// use vizflyt_protocol::mavlink::yaw_world_from_ned;
/// assert!((yaw_world_from_ned(90f64.to_radians())).abs() < 1e-12); // east
/// ```
pub fn yaw_world_from_ned(yaw_ned_rad: f64) -> f64 {
    yaw_ned_from_world(yaw_ned_rad)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::yaw_of;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn attitude_conversions_are_inverses(q in prop::array::uniform4(-1.0..1.0f64)) {
            prop_assume!(q.iter().map(|v| v * v).sum::<f64>() > 1e-3);
            let q = DQuat::from_array(q).normalize();
            let back = world_rotation_from_ned(ned_rotation_from_world(q));
            prop_assert!(back.dot(q).abs() > 1.0 - 1e-9);
        }

        /// Rotating a vector gives the same result in both sets of axes.
        #[test]
        fn attitude_and_vectors_agree(q in prop::array::uniform4(-1.0..1.0f64), v in prop::array::uniform3(-5.0..5.0f64)) {
            prop_assume!(q.iter().map(|v| v * v).sum::<f64>() > 1e-3);
            let (q, v_body) = (DQuat::from_array(q).normalize(), DVec3::from(v));
            let by_world = ned_from_world(q * v_body);
            let by_ned = ned_rotation_from_world(q) * frd_from_body(v_body);
            prop_assert!((by_world - by_ned).length() < 1e-9);
        }

        #[test]
        fn headings_agree_with_attitudes(yaw in -3.1..3.1f64) {
            let ned = ned_rotation_from_world(DQuat::from_rotation_z(yaw));
            prop_assert!((wrap_pi(yaw_of(ned) - yaw_ned_from_world(yaw))).abs() < 1e-9);
        }
    }
}
