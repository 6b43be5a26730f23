//! Solids with a signed distance: geofence, no-fly boxes, and the true geometry of generated scenes.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// Solid in the world frame. Its signed distance is negative inside and positive outside. [m, world]
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Volume {
    /// All points within `radius_m` of `center_m`.
    Sphere {
        /// Centre. [m, world]
        center_m: DVec3,
        /// Radius. [m]
        radius_m: f64,
    },
    /// All points within `radius_m` of the segment from `a_m` to `b_m`, for example trunks and poles.
    Capsule {
        /// One end of the axis. [m, world]
        a_m: DVec3,
        /// The other end. [m, world]
        b_m: DVec3,
        /// Radius. [m]
        radius_m: f64,
    },
    /// Box of any orientation, for example walls and gate beams.
    Cuboid {
        /// Centre. [m, world]
        center_m: DVec3,
        /// Half of each side, along the box's axes. [m]
        half_m: DVec3,
        /// Rotation from the box's axes to the world's.
        rotation: DQuat,
    },
    /// All points below a plane: `normal . p <= offset_m`. For the floor, normal +z and offset 0.
    HalfSpace {
        /// Unit normal that points out of the solid. [world]
        normal: DVec3,
        /// Distance of the plane from the origin along the normal. [m]
        offset_m: f64,
    },
}

impl Volume {
    /// Returns an axis-aligned box from two opposite corners. [m, world]
    pub fn aabb(min_m: DVec3, max_m: DVec3) -> Self {
        Self::Cuboid {
            center_m: (min_m + max_m) / 2.0,
            half_m: (max_m - min_m) / 2.0,
            rotation: DQuat::IDENTITY,
        }
    }

    /// Returns the signed distance of a point to the surface: negative inside. [m]
    ///
    /// ```
    /// use glam::DVec3;
    /// use vizflyt_protocol::geometry::Volume;
    /// let room = Volume::aabb(DVec3::ZERO, DVec3::new(11.0, 4.5, 3.65));
    /// // 0.65 m below the ceiling, which is the nearest face.
    /// assert!((room.signed_distance_m(DVec3::new(5.0, 2.0, 3.0)) + 0.65).abs() < 1e-12);
    /// assert!((room.signed_distance_m(DVec3::new(14.0, 2.0, 7.65)) - 5.0).abs() < 1e-12);
    /// ```
    pub fn signed_distance_m(&self, p_m: DVec3) -> f64 {
        match *self {
            Self::Sphere { center_m, radius_m } => (p_m - center_m).length() - radius_m,
            Self::Capsule { a_m, b_m, radius_m } => {
                let axis = b_m - a_m;
                let along = (p_m - a_m).dot(axis) / axis.length_squared().max(f64::MIN_POSITIVE);
                (p_m - a_m - axis * along.clamp(0.0, 1.0)).length() - radius_m
            }
            Self::Cuboid { center_m, half_m, rotation } => {
                let q = (rotation.conjugate() * (p_m - center_m)).abs() - half_m;
                q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
            }
            Self::HalfSpace { normal, offset_m } => normal.dot(p_m) - offset_m,
        }
    }

    /// Returns the outward unit normal at or nearest to a point, from central differences of the distance over 1 mm.
    /// [world]
    pub fn outward_normal(&self, p_m: DVec3) -> DVec3 {
        const STEP_M: f64 = 1e-3;
        let slope = |axis: DVec3| {
            self.signed_distance_m(p_m + axis * STEP_M)
                - self.signed_distance_m(p_m - axis * STEP_M)
        };
        DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z)).normalize_or(DVec3::Z)
    }

    /// Whether all numbers are finite, sizes are positive, and directions have unit length.
    pub fn is_valid(&self) -> bool {
        let unit = |length_squared: f64| (length_squared - 1.0).abs() < 2e-3;
        match *self {
            Self::Sphere { center_m, radius_m } => {
                center_m.is_finite() && radius_m.is_finite() && radius_m > 0.0
            }
            Self::Capsule { a_m, b_m, radius_m } => {
                a_m.is_finite() && b_m.is_finite() && radius_m.is_finite() && radius_m > 0.0
            }
            Self::Cuboid { center_m, half_m, rotation } => {
                center_m.is_finite()
                    && half_m.is_finite()
                    && half_m.min_element() > 0.0
                    && unit(rotation.length_squared())
            }
            Self::HalfSpace { normal, offset_m } => {
                unit(normal.length_squared()) && offset_m.is_finite()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn vector(range: core::ops::Range<f64>) -> impl Strategy<Value = DVec3> {
        prop::array::uniform3(range).prop_map(DVec3::from)
    }

    fn volume() -> impl Strategy<Value = Volume> {
        prop_oneof![
            (vector(-5.0..5.0), 0.05..3.0f64)
                .prop_map(|(center_m, radius_m)| Volume::Sphere { center_m, radius_m }),
            (vector(-5.0..5.0), vector(-5.0..5.0), 0.05..2.0f64)
                .prop_map(|(a_m, b_m, radius_m)| Volume::Capsule { a_m, b_m, radius_m }),
            (vector(-5.0..5.0), vector(0.05..3.0), vector(-3.0..3.0)).prop_map(
                |(center_m, half_m, turn)| Volume::Cuboid {
                    center_m,
                    half_m,
                    rotation: DQuat::from_scaled_axis(turn),
                }
            ),
        ]
    }

    proptest! {
        /// The signed distance never changes by more than the point moves.
        #[test]
        fn distance_is_one_lipschitz(v in volume(), p in vector(-8.0..8.0), q in vector(-8.0..8.0)) {
            let change = (v.signed_distance_m(p) - v.signed_distance_m(q)).abs();
            prop_assert!(change <= (p - q).length() + 1e-9);
        }

        /// From a point outside, moving by the distance along the normal ends on the surface. (Inside, the distance is
        /// not smooth near edges.)
        #[test]
        fn the_normal_points_from_the_surface(v in volume(), p in vector(-8.0..8.0)) {
            let d = v.signed_distance_m(p);
            prop_assume!(d > 0.05);
            let foot = p - v.outward_normal(p) * d;
            prop_assert!(v.signed_distance_m(foot).abs() < 2e-2 * (1.0 + d));
        }
    }

    #[test]
    fn a_degenerate_capsule_is_a_sphere() {
        let a = DVec3::new(1.0, 2.0, 3.0);
        let v = Volume::Capsule { a_m: a, b_m: a, radius_m: 0.5 };
        assert!((v.signed_distance_m(a + DVec3::X) - 0.5).abs() < 1e-12);
    }
}
