//! Pinhole camera of one image, as the passes need it.

use glam::{DMat3, Vec3};
use vizflyt_protocol::geometry::{Cam, Distortion, Intrinsics, Pose, World};
use vizflyt_splat::limits::JACOBIAN_MARGIN;

/// Pinhole camera with a pose, in the dataset's unit of length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Image width. [px]
    pub width: usize,
    /// Image height. [px]
    pub height: usize,
    /// Focal lengths. [px]
    pub focal: [f32; 2],
    /// Principal point. [px]
    pub center: [f32; 2],
    /// Rows of `cam_from_world`: right, down, forward. [world]
    pub rows: [Vec3; 3],
    /// Camera position. [world]
    pub position: Vec3,
    /// Minimum depth: closer points are not rendered.
    pub near: f32,
    /// Range of slopes (x and y) within which the projection is linearised at the splat; outside, at the limit.
    pub slopes: [[f32; 2]; 2],
}

impl View {
    /// Returns the view of a pinhole.
    ///
    /// # Panics
    /// If the intrinsics have a distortion: images are undistorted when they are read.
    pub fn new(k: &Intrinsics, world_from_cam: &Pose<World, Cam>, near: f32) -> Self {
        assert_eq!(k.distortion, Distortion::None, "training supports only pinhole cameras");
        let rows = DMat3::from_quat(world_from_cam.rotation.normalize());
        let bounds = |center: f64, focal: f64, size: u32| {
            let (low, high) = (-center / focal, (f64::from(size) - center) / focal);
            let margin = (high - low) * 0.5 * JACOBIAN_MARGIN;
            [(low - margin) as f32, (high + margin) as f32]
        };
        Self {
            width: k.width_px as usize,
            height: k.height_px as usize,
            focal: [k.fx_px as f32, k.fy_px as f32],
            center: [k.cx_px as f32, k.cy_px as f32],
            rows: [rows.x_axis.as_vec3(), rows.y_axis.as_vec3(), rows.z_axis.as_vec3()],
            position: world_from_cam.translation_m.as_vec3(),
            near,
            slopes: [bounds(k.cx_px, k.fx_px, k.width_px), bounds(k.cy_px, k.fy_px, k.height_px)],
        }
    }

    /// Returns the intrinsics.
    pub fn intrinsics(&self) -> Intrinsics {
        Intrinsics {
            width_px: self.width as u32,
            height_px: self.height as u32,
            fx_px: f64::from(self.focal[0]),
            fy_px: f64::from(self.focal[1]),
            cx_px: f64::from(self.center[0]),
            cy_px: f64::from(self.center[1]),
            distortion: Distortion::None,
        }
    }

    /// Returns the point in the camera's axes: right, down, forward.
    pub fn in_cam(&self, p_world: Vec3) -> Vec3 {
        let d = p_world - self.position;
        Vec3::new(self.rows[0].dot(d), self.rows[1].dot(d), self.rows[2].dot(d))
    }

    /// Returns a point's pixel and its z; `None` if it is not in front of the camera.
    pub fn project(&self, p_world: Vec3) -> Option<([f32; 2], f32)> {
        let p = self.in_cam(p_world);
        (p.z > self.near).then(|| {
            let x = self.focal[0] * p.x / p.z + self.center[0];
            let y = self.focal[1] * p.y / p.z + self.center[1];
            ([x, y], p.z)
        })
    }

    /// Returns the point seen at a pixel with a camera-z depth. [world]
    pub fn unproject(&self, [x, y]: [f32; 2], z: f32) -> Vec3 {
        let across = (x - self.center[0]) / self.focal[0];
        let down = (y - self.center[1]) / self.focal[1];
        self.position + (self.rows[0] * across + self.rows[1] * down + self.rows[2]) * z
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};

    #[test]
    fn project_inverts_unproject() {
        let k = Intrinsics::from_horizontal_fov(320, 240, 1.3);
        let pose = Pose::new(
            DVec3::new(1.0, 2.0, -0.5),
            DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -1.1, 2.0),
        );
        let view = View::new(&k, &pose, 0.05);
        let p = view.unproject([17.5, 201.0], 3.25);
        // The protocol's own projection gives the same pixel.
        let pixel = k.project(pose.inverse().transform_point(p.as_dvec3())).unwrap();
        assert!((pixel - glam::DVec2::new(17.5, 201.0)).length() < 1e-3);
        let ([x, y], z) = view.project(p).unwrap();
        assert!((x - 17.5).abs() < 1e-3 && (y - 201.0).abs() < 1e-3 && (z - 3.25).abs() < 1e-5);
    }
}
