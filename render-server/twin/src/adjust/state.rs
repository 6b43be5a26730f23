//! All unknowns, and the residuals of sightings.

use glam::{DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

use super::capture::{Capture, TagSighting};
use super::project::{Projected, project};
use super::rolling::{InRow, Rolling};
use super::start::Start;

/// The unknowns, in metres.
#[derive(Clone, Debug)]
pub(super) struct State {
    pub(super) lens: Intrinsics,
    /// Poses, world from camera.
    pub(super) cameras: Vec<Pose<World, Cam>>,
    pub(super) points: Vec<DVec3>,
    pub(super) rolling: Rolling,
    pub(super) tags: Vec<TagPlace>,
    /// Distance by which corners are detected inside tags, because white bleeds into black in lenses and sensors. [px]
    pub(super) inset_px: f64,
    /// Initial principal point. [px]
    pub(super) middle_px: DVec2,
    /// Maximum visible slope.
    pub(super) reach: f64,
}

/// Position of a tag.
#[derive(Clone, Copy, Debug)]
pub(super) enum TagPlace {
    /// Unknown; its sightings are ignored.
    Nowhere,
    /// Measured corners, constant.
    Given([DVec3; 4]),
    /// Estimated position and rotation, world from tag.
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
            rolling: Rolling::new(&capture.lens, capture.images.len()),
            tags: start.tags.clone(),
            inset_px: 0.0,
            middle_px: DVec2::new(capture.lens.cx_px, capture.lens.cy_px),
            reach: reach(&capture.lens),
        }
    }

    /// Returns a tag's corners; `None` if its position is unknown. [m, world]
    pub(super) fn corners_m(&self, capture: &Capture, tag: usize) -> Option<[DVec3; 4]> {
        match self.tags[tag] {
            TagPlace::Nowhere => None,
            TagPlace::Given(corners) => Some(corners),
            TagPlace::Found(t, q) => Some(capture.square_m(tag).map(|corner| q * corner + t)),
        }
    }

    /// Projects a point of the world into an image. Returns its pixel, and its position in the camera frame when the
    /// row of `seen_px` is exposed.
    pub(super) fn see(
        &self,
        camera: usize,
        p_world: DVec3,
        seen_px: DVec2,
    ) -> Option<(Projected, InRow)> {
        let seen = self.rolling.row(camera, seen_px).see(&self.cameras[camera], p_world);
        Some((project(&self.lens, self.reach, seen.p_cam)?, seen))
    }

    /// Returns the change of the principal point.
    pub(super) fn off_middle_px(&self) -> DVec2 {
        DVec2::new(self.lens.cx_px, self.lens.cy_px) - self.middle_px
    }

    /// Returns the prior standard deviation of that change: phones deviate from the centre by up to 1 % of the image.
    pub(super) fn middle_sigma_px(&self) -> f64 {
        0.01 * f64::from(self.lens.width_px)
    }

    /// Returns a camera's pose at the exposure of a pixel's row.
    pub(super) fn pose_at(&self, camera: usize, seen_px: DVec2) -> Pose<World, Cam> {
        self.rolling.row(camera, seen_px).pose(&self.cameras[camera])
    }

    /// Returns the reprojection error of a point; `None` if the point is not visible. [px]
    pub(super) fn off_px(&self, camera: usize, p_world: DVec3, pixel: DVec2) -> Option<DVec2> {
        Some(self.see(camera, p_world, pixel)?.0.pixel - pixel)
    }

    /// Returns the RMS reprojection error of a tag's corners. [px]
    pub(super) fn tag_off_px(
        &self,
        camera: usize,
        corners_m: &[DVec3; 4],
        seen: &TagSighting,
    ) -> Option<f64> {
        let mut sum = 0.0;
        for (k, &corner) in corners_m.iter().enumerate() {
            let pixel = seen.corners_px[k] - inwards(seen)[k] * self.inset_px;
            let seen = self.see(camera, corner, seen.corners_px[k])?.0;
            sum += seen.pixel.distance_squared(pixel);
        }
        Some((sum / 4.0).sqrt())
    }
}

/// Returns the directions from a tag's detected corners to their centre.
pub(super) fn inwards(seen: &TagSighting) -> [DVec2; 4] {
    let middle = seen.corners_px.iter().sum::<DVec2>() / 4.0;
    seen.corners_px.map(|corner| (middle - corner).normalize_or_zero())
}

/// Returns the slope of the image's farthest corner, with a margin for a lens that is being estimated.
fn reach(lens: &Intrinsics) -> f64 {
    let far = DVec2::new(
        lens.cx_px.max(f64::from(lens.width_px) - lens.cx_px) / lens.fx_px,
        lens.cy_px.max(f64::from(lens.height_px) - lens.cy_px) / lens.fy_px,
    );
    let corner = lens.distortion.undistort(far).map_or(far.length(), DVec2::length);
    1.5 * corner.max(far.length())
}
