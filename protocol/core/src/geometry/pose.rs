//! Rigid transforms between two typed frames.

use core::f64::consts::PI;
use core::fmt;
use core::marker::PhantomData;
use core::ops::Mul;

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use super::frame::{Body, Cam, Frame};

/// Rigid transform from coordinates in `B` to coordinates in `A`. Also the pose of `B` in `A`. Name values `a_from_b`.
///
/// ```
/// use glam::{DQuat, DVec3};
/// use vizflyt_protocol::geometry::{Body, Pose, World};
/// // Vehicle at (1, 2, 3), facing north (yaw +90 degrees).
/// let world_from_body: Pose<World, Body> =
///     Pose::new(DVec3::new(1.0, 2.0, 3.0), DQuat::from_rotation_z(90f64.to_radians()));
/// // One metre ahead of the vehicle is one metre further north.
/// let p_world = world_from_body.transform_point(DVec3::X);
/// assert!((p_world - DVec3::new(1.0, 3.0, 3.0)).length() < 1e-12);
/// ```
#[derive(Serialize, Deserialize)]
#[serde(bound = "")]
pub struct Pose<A, B> {
    /// Origin of `B` in `A`. [m, A]
    pub translation_m: DVec3,
    /// Rotation from `B` axes to `A` axes; unit quaternion, Hamilton, xyzw in memory.
    pub rotation: DQuat,
    #[serde(skip)]
    frames: PhantomData<fn() -> (A, B)>,
}

impl<A: Frame, B: Frame> Pose<A, B> {
    /// Identity: both frames coincide.
    pub const IDENTITY: Self =
        Self { translation_m: DVec3::ZERO, rotation: DQuat::IDENTITY, frames: PhantomData };

    /// Returns the transform with the origin of `B` in `A` [m] and the rotation of `B` in `A`.
    pub const fn new(translation_m: DVec3, rotation: DQuat) -> Self {
        Self { translation_m, rotation, frames: PhantomData }
    }

    /// Returns the inverse transform.
    pub fn inverse(&self) -> Pose<B, A> {
        let rotation = self.rotation.conjugate();
        Pose::new(-(rotation * self.translation_m), rotation)
    }

    /// Transforms a point [m] from `B` to `A`.
    pub fn transform_point(&self, p_b: DVec3) -> DVec3 {
        self.rotation * p_b + self.translation_m
    }

    /// Rotates a free vector (velocity, direction) from `B` to `A`.
    pub fn rotate(&self, v_b: DVec3) -> DVec3 {
        self.rotation * v_b
    }

    /// Whether all numbers are finite and the quaternion has unit length within 1e-3.
    pub fn is_valid(&self) -> bool {
        self.translation_m.is_finite()
            && self.rotation.is_finite()
            && (self.rotation.length_squared() - 1.0).abs() < 2e-3
    }

    /// Interpolates between `self` (t = 0) and `other` (t = 1): linear in position, slerp in rotation.
    pub fn interpolate(&self, other: &Self, t: f64) -> Self {
        Self::new(
            self.translation_m.lerp(other.translation_m, t),
            self.rotation.slerp(other.rotation, t),
        )
    }
}

impl<A: Frame, B: Frame, C: Frame> Mul<Pose<B, C>> for Pose<A, B> {
    type Output = Pose<A, C>;

    fn mul(self, b_from_c: Pose<B, C>) -> Pose<A, C> {
        Pose::new(
            self.transform_point(b_from_c.translation_m),
            // Normalized, so that long products keep unit quaternions.
            (self.rotation * b_from_c.rotation).normalize(),
        )
    }
}

// Implemented by hand, because `derive` would require the same traits of the frame types.
impl<A, B> Clone for Pose<A, B> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<A, B> Copy for Pose<A, B> {}
impl<A, B> PartialEq for Pose<A, B> {
    fn eq(&self, other: &Self) -> bool {
        self.translation_m == other.translation_m && self.rotation == other.rotation
    }
}
impl<A: Frame, B: Frame> fmt::Debug for Pose<A, B> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (t, r) = (self.translation_m, self.rotation);
        write!(f, "{}_from_{}([{}, {}, {}] m, ", A::NAME, B::NAME, t.x, t.y, t.z)?;
        write!(f, "[{}, {}, {}, {}] xyzw)", r.x, r.y, r.z, r.w)
    }
}

/// Linear and angular velocity. The variable's name states the frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Twist {
    /// Linear velocity. [m/s, frame in the variable's name]
    pub linear_mps: DVec3,
    /// Angular velocity. [rad/s, frame in the variable's name]
    pub angular_radps: DVec3,
}

/// Returns the extrinsics of a camera at `p_body_m` that looks forward, tilted up by `tilt_rad`. Camera axes in body
/// axes: (-y, -z, x).
///
/// ```
/// use glam::DVec3;
/// use vizflyt_protocol::geometry::body_from_forward_cam;
/// let body_from_cam = body_from_forward_cam(DVec3::ZERO, 0.0);
/// // One metre along the optical axis is one metre ahead; one to the right is -y; one down -z.
/// assert!((body_from_cam.transform_point(DVec3::Z) - DVec3::X).length() < 1e-12);
/// assert!((body_from_cam.transform_point(DVec3::X) + DVec3::Y).length() < 1e-12);
/// assert!((body_from_cam.transform_point(DVec3::Y) + DVec3::Z).length() < 1e-12);
/// ```
pub fn body_from_forward_cam(p_body_m: DVec3, tilt_rad: f64) -> Pose<Body, Cam> {
    // Columns: the camera's x, y and z axes in body axes.
    let level = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    // Nose-up is a negative rotation about body y.
    Pose::new(p_body_m, DQuat::from_rotation_y(-tilt_rad) * DQuat::from_mat3(&level))
}

/// Returns the heading (yaw) of a rotation: the angle of its x axis about z, in (-pi, pi]. [rad]
///
/// ```
/// use glam::DQuat;
/// use vizflyt_protocol::geometry::yaw_of;
/// assert!((yaw_of(DQuat::from_rotation_z(0.5)) - 0.5).abs() < 1e-12);
/// ```
pub fn yaw_of(rotation: DQuat) -> f64 {
    let nose = rotation * DVec3::X;
    libm::atan2(nose.y, nose.x)
}

/// Wraps an angle to (-pi, pi]. [rad]
///
/// ```
/// use core::f64::consts::PI;
/// use vizflyt_protocol::geometry::wrap_pi;
/// assert!((wrap_pi(1.5 * PI) + 0.5 * PI).abs() < 1e-12);
/// ```
pub fn wrap_pi(angle_rad: f64) -> f64 {
    let wrapped = libm::fmod(angle_rad, 2.0 * PI);
    if wrapped > PI {
        wrapped - 2.0 * PI
    } else if wrapped <= -PI {
        wrapped + 2.0 * PI
    } else {
        wrapped
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::World;
    use proptest::prelude::*;

    fn pose() -> impl Strategy<Value = Pose<World, Body>> {
        (prop::array::uniform3(-1e3..1e3f64), prop::array::uniform4(-1.0..1.0f64))
            .prop_filter("a rotation", |(_, q)| q.iter().map(|v| v * v).sum::<f64>() > 1e-3)
            .prop_map(|(t, q)| Pose::new(t.into(), DQuat::from_array(q).normalize()))
    }

    proptest! {
        #[test]
        fn a_pose_times_its_inverse_is_the_identity(a_from_b in pose()) {
            let a_from_a = a_from_b * a_from_b.inverse();
            prop_assert!(a_from_a.translation_m.length() < 1e-9);
            prop_assert!(a_from_a.rotation.angle_between(DQuat::IDENTITY) < 1e-6);
        }

        #[test]
        fn composition_equals_successive_application(a in pose(), b in pose(), p in prop::array::uniform3(-10.0..10.0f64)) {
            let b: Pose<Body, Cam> = Pose::new(b.translation_m, b.rotation);
            let p_cam = DVec3::from(p);
            let in_turn = a.transform_point(b.transform_point(p_cam));
            prop_assert!(((a * b).transform_point(p_cam) - in_turn).length() < 1e-9);
        }

        #[test]
        fn wrapped_angles_are_in_range_and_congruent(angle in -1e3..1e3f64) {
            let wrapped = wrap_pi(angle);
            prop_assert!(wrapped > -PI - 1e-12 && wrapped <= PI + 1e-12);
            let turns = (angle - wrapped) / (2.0 * PI);
            prop_assert!((turns - turns.round()).abs() < 1e-9);
        }
    }

    #[test]
    fn detects_invalid_poses() {
        let nan: Pose<World, Body> = Pose::new(DVec3::new(f64::NAN, 0.0, 0.0), DQuat::IDENTITY);
        let zero: Pose<World, Body> = Pose::new(DVec3::ZERO, DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0));
        assert!(!nan.is_valid() && !zero.is_valid());
        assert!(Pose::<World, Body>::IDENTITY.is_valid());
    }
}
