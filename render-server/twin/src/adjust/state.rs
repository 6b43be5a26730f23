//! Everything that is found, and how far sightings are from it.

use glam::{DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

use super::capture::{Capture, TagSighting};
use super::project::{Projected, project};
use super::start::Start;

/// The unknowns, in metres.
#[derive(Clone, Debug)]
pub(super) struct State {
    pub(super) lens: Intrinsics,
    /// World from camera.
    pub(super) cameras: Vec<Pose<World, Cam>>,
    pub(super) points: Vec<DVec3>,
    pub(super) tags: Vec<TagPlace>,
    /// How far inside a tag its corners are found: white bleeds into black, in lenses and in sensors. [px]
    pub(super) inset_px: f64,
    /// Slopes beyond this are not seen.
    pub(super) reach: f64,
}

/// Where a tag is.
#[derive(Clone, Copy, Debug)]
pub(super) enum TagPlace {
    /// Not known: its sightings do not count.
    Nowhere,
    /// Measured, and held to.
    Given([DVec3; 4]),
    /// To be found: world from tag.
    Found(DVec3, DQuat),
}

impl State {
    pub(super) fn new(capture: &Capture, start: &Start) -> Self {
        let to = &start.world_from_scene;
        let cameras = capture.images.iter().map(|image| {
            let pose = &image.scene_from_cam;
            let q = (to.rotation * pose.rotation).normalize();
            Pose::new(to.transform_point(pose.translation_m), q)
        });
        Self {
            lens: capture.lens,
            cameras: cameras.collect(),
            points: capture.points.iter().map(|&p| to.transform_point(p)).collect(),
            tags: start.tags.clone(),
            inset_px: 0.0,
            reach: reach(&capture.lens),
        }
    }

    /// Returns a tag's corners; `None` if it is nowhere. [m, world]
    pub(super) fn corners_m(&self, capture: &Capture, tag: usize) -> Option<[DVec3; 4]> {
        match self.tags[tag] {
            TagPlace::Nowhere => None,
            TagPlace::Given(corners) => Some(corners),
            TagPlace::Found(t, q) => Some(capture.square_m(tag).map(|corner| q * corner + t)),
        }
    }

    /// Returns where a point of the world appears in an image, and its place in the camera.
    pub(super) fn see(&self, camera: usize, p_world: DVec3) -> Option<(Projected, DVec3)> {
        let pose = &self.cameras[camera];
        let p_cam = pose.rotation.conjugate() * (p_world - pose.translation_m);
        Some((project(&self.lens, self.reach, p_cam)?, p_cam))
    }

    /// Returns how far a point is from where an image saw it; `None` where it cannot be seen. [px]
    pub(super) fn off_px(&self, camera: usize, p_world: DVec3, pixel: DVec2) -> Option<DVec2> {
        Some(self.see(camera, p_world)?.0.pixel - pixel)
    }

    /// Returns how far a tag's corners are from where an image saw them, root mean square. [px]
    pub(super) fn tag_off_px(
        &self,
        camera: usize,
        corners_m: &[DVec3; 4],
        seen: &TagSighting,
    ) -> Option<f64> {
        let mut sum = 0.0;
        for (k, &corner) in corners_m.iter().enumerate() {
            let pixel = seen.corners_px[k] - inwards(seen)[k] * self.inset_px;
            sum += self.off_px(camera, corner, pixel)?.length_squared();
        }
        Some((sum / 4.0).sqrt())
    }
}

/// Returns the directions from a tag's corners to its middle, as they were found.
pub(super) fn inwards(seen: &TagSighting) -> [DVec2; 4] {
    let middle = seen.corners_px.iter().sum::<DVec2>() / 4.0;
    seen.corners_px.map(|corner| (middle - corner).normalize_or_zero())
}

/// Derivatives of a pixel by a camera's place and its turn about its own axes, by the point, and by the lens.
pub(super) struct Slopes {
    pub(super) by_camera: [DVec2; 6],
    pub(super) by_point: [DVec2; 3],
}

/// Returns them, given the derivatives by the point in the camera.
pub(super) fn slopes(camera: &Pose<World, Cam>, by_cam: &[DVec2; 3], p_cam: DVec3) -> Slopes {
    let through = |v: DVec3| by_cam[0] * v.x + by_cam[1] * v.y + by_cam[2] * v.z;
    let cam_from_world = DMat3::from_quat(camera.rotation.conjugate());
    let by_point = DVec3::AXES.map(|axis| through(cam_from_world * axis));
    // The camera turned by a small w sees the point turned by -w: p + p x w.
    let by_turn = DVec3::AXES.map(|axis| through(p_cam.cross(axis)));
    let by_camera = [-by_point[0], -by_point[1], -by_point[2], by_turn[0], by_turn[1], by_turn[2]];
    Slopes { by_camera, by_point }
}

/// Returns the greatest slope that an image's corner has, with a margin for a lens that is still found; at most the
/// lens's own.
fn reach(lens: &Intrinsics) -> f64 {
    let far = DVec2::new(
        lens.cx_px.max(f64::from(lens.width_px) - lens.cx_px) / lens.fx_px,
        lens.cy_px.max(f64::from(lens.height_px) - lens.cy_px) / lens.fy_px,
    );
    let corner = lens.distortion.undistort(far).map_or(far.length(), DVec2::length);
    1.5 * corner.max(far.length())
}
