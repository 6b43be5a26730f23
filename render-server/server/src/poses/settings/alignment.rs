//! Conversion between a stream's numbers and poses in the world.

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::{Body, Pose, World};

use super::conventions::{Axes, BodyAxes, Nose, Quaternion};

/// `offset`: position and heading of the stream's origin in the world.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Offset {
    /// Position of the stream's origin. [m, world]
    pub position_m: DVec3,
    /// Rotation of its x axis from the world's, counter-clockwise. [deg]
    pub yaw_deg: f64,
}

/// Conversion from a stream's numbers to poses; made by [`LocalizationConfig::alignment`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Alignment {
    /// Metres per unit of the stream. [m]
    pub unit_m: f64,
    pub axes: Axes,
    /// Convention of its quaternions.
    pub quaternion: Quaternion,
    /// The object's axes.
    pub body: BodyAxes,
    /// The object's nose.
    pub nose: Nose,
    pub offset: Offset,
    /// The tracked point. [m, body]
    pub pivot_m: DVec3,
}

impl Alignment {
    /// Returns the vehicle's pose from the streamed position of the object and the streamed rotation from its
    /// axes to the stream's.
    ///
    /// ```
    /// use glam::{DQuat, DVec3};
    /// use vizflyt_server::poses::settings::LocalizationConfig;
    /// // Motive as installed, y up: 1 m up is y, and a turn to the left is one about y.
    /// let config = LocalizationConfig::parse("natnet:1.2.3.4,up=y").unwrap();
    /// let left = DQuat::from_rotation_y(0.5);
    /// let pose = config.alignment().world_from_body(DVec3::new(0.0, 1.0, 2.0), left);
    /// assert!((pose.translation_m - DVec3::new(0.0, -2.0, 1.0)).length() < 1e-12);
    /// assert!((pose.rotation.to_scaled_axis() - DVec3::Z * 0.5).length() < 1e-12);
    /// ```
    pub fn world_from_body(&self, p_stream: DVec3, stream_from_object: DQuat) -> Pose<World, Body> {
        let turn = DQuat::from_rotation_z(self.offset.yaw_deg.to_radians());
        let axes = self.axes.matrix();
        let p_m = turn * (axes * (p_stream * self.unit_m)) + self.offset.position_m;
        let stream_from_object = self.quaternion.rotation(stream_from_object);
        let world_from_level = match self.object_from_flu() {
            None => conjugated(axes, stream_from_object),
            Some(laid) => DQuat::from_mat3(&axes) * stream_from_object * laid,
        };
        let rotation = (turn * world_from_level * self.nose.object_from_body()).normalize();
        Pose::new(p_m - rotation * self.pivot_m, rotation)
    }

    /// Returns the streamed values of a pose: the inverse of [`Self::world_from_body`].
    pub fn streamed(&self, pose: &Pose<World, Body>) -> (DVec3, DQuat) {
        let turn = DQuat::from_rotation_z(self.offset.yaw_deg.to_radians()).conjugate();
        let back = self.axes.matrix().transpose();
        let p_m = pose.translation_m + pose.rotation * self.pivot_m - self.offset.position_m;
        let rotation = turn * pose.rotation * self.nose.object_from_body().conjugate();
        let rotation = match self.object_from_flu() {
            None => conjugated(back, rotation),
            Some(laid) => DQuat::from_mat3(&back) * rotation * laid.conjugate(),
        };
        (back * (turn * p_m) / self.unit_m, self.quaternion.streamed(rotation))
    }

    /// Returns the matrix from the object's own axes to the body's.
    pub fn body_from_object(&self) -> DMat3 {
        let laid = match self.object_from_flu() {
            None => self.axes.matrix(),
            Some(laid) => DMat3::from_quat(laid.conjugate()),
        };
        DMat3::from_quat(self.nose.object_from_body().conjugate()) * laid
    }

    /// Returns the rotation from forward, left and up to the object's own axes, if these are named; `None` if
    /// they follow the stream's.
    fn object_from_flu(&self) -> Option<DQuat> {
        match self.body {
            BodyAxes::Stream => None,
            BodyAxes::Flu => Some(DQuat::IDENTITY),
            BodyAxes::Frd => Some(DQuat::from_rotation_x(std::f64::consts::PI)),
        }
    }
}

/// Returns a rotation in axes that are exchanged, turned or mirrored.
fn conjugated(axes: DMat3, rotation: DQuat) -> DQuat {
    // The axis of a rotation is a pseudovector: a mirror reverses the direction of rotation.
    let axis = axes.determinant() * (axes * rotation.xyz());
    DQuat::from_xyzw(axis.x, axis.y, axis.z, rotation.w)
}
