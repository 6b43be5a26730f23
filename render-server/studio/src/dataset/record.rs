//! Record of an image: `records/SPLIT/N.json`. It is the last file of an image, so that an image with a record is
//! complete. The annotations of all formats are generated from records.
//!
//! Pixel coordinates are continuous: (0, 0) is the upper left corner of the image, (0.5, 0.5) the centre of the first
//! pixel.

use serde::{Deserialize, Serialize};
use vizflyt_arena::config::EnvironmentConfig;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World as WorldFrame};

use super::shot::numbers;
use super::store::ImageName;

/// Content of a record.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ImageRecord {
    /// Index in the whole data set, from 0.
    pub(super) index: u64,
    /// `train` or `val`.
    pub(super) split: String,
    pub(super) scene: String,
    /// Seed of the scene.
    pub(super) seed: u64,
    /// Time of the scene's clock. [ns]
    pub(super) at_ns: i64,
    pub(super) camera: CameraRecord,
    pub(super) world_from_cam: PoseRecord,
    /// Camera at the second time of the optical flow; none at the end of a path.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) next: Option<NextRecord>,
    pub(super) environment: EnvironmentConfig,
    /// Visible things, in order of their ids.
    pub(super) things: Vec<ThingRecord>,
    /// Gates that are visible or have a (possibly hidden) corner in the image, in the order of the course.
    pub(super) gates: Vec<GateRecord>,
}

impl ImageRecord {
    /// Returns the data for the names of the image's files.
    pub(super) fn name(&self) -> ImageName<'_> {
        let Self { index, split, scene, at_ns, .. } = self;
        ImageName { index: *index, split, scene, at_ns: *at_ns }
    }
}

/// Intrinsics of a pinhole camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CameraRecord {
    pub(super) width_px: u32,
    pub(super) height_px: u32,
    pub(super) fx_px: f64,
    pub(super) fy_px: f64,
    pub(super) cx_px: f64,
    pub(super) cy_px: f64,
}

impl CameraRecord {
    pub(super) fn of(k: &Intrinsics) -> Self {
        let Intrinsics { width_px, height_px, fx_px, fy_px, cx_px, cy_px, .. } = *k;
        Self { width_px, height_px, fx_px, fy_px, cx_px, cy_px }
    }

    /// Returns the intrinsics for the renderer.
    pub(super) fn intrinsics(&self) -> Intrinsics {
        let Self { width_px, height_px, fx_px, fy_px, cx_px, cy_px } = *self;
        let distortion = vizflyt_protocol::geometry::Distortion::None;
        Intrinsics { width_px, height_px, fx_px, fy_px, cx_px, cy_px, distortion }
    }
}

/// Pose `a_from_b`: transforms points from frame b to frame a.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PoseRecord {
    /// [m]
    pub(super) p_m: [f64; 3],
    /// Unit quaternion, Hamilton convention.
    pub(super) q_xyzw: [f64; 4],
}

impl PoseRecord {
    pub(super) fn of<A, B>(pose: &Pose<A, B>) -> Self {
        let (p_m, q_xyzw) = numbers(pose);
        Self { p_m, q_xyzw }
    }

    pub(super) fn world_from_cam(&self) -> Pose<WorldFrame, Cam> {
        Pose::new(self.p_m.into(), glam::DQuat::from_array(self.q_xyzw))
    }
}

/// Camera at the second time of the optical flow.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct NextRecord {
    /// Time of the scene's clock. [ns]
    pub(super) at_ns: i64,
    pub(super) world_from_cam: PoseRecord,
}

/// Thing in the image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ThingRecord {
    /// Value of its pixels in the instance mask.
    pub(super) id: u16,
    pub(super) name: String,
    pub(super) class: String,
    pub(super) area_px: u32,
    /// Tight box: left, top, width, height. [px]
    pub(super) box_px: [u32; 4],
    /// Mask as compressed RLE text of COCO.
    pub(super) rle: String,
}

/// Gate of the course.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct GateRecord {
    /// Name of its stage.
    pub(super) name: String,
    /// Id of its thing; 0 if its splats are unknown.
    pub(super) id: u16,
    /// Pose of the opening's centre: x along the passage, y to the left, z up.
    pub(super) cam_from_gate: PoseRecord,
    /// Width and height of the opening. [m]
    pub(super) size_m: [f64; 2],
    /// Corners of the opening as seen by an approaching vehicle: upper left, upper right, lower right, lower left.
    pub(super) corners: [CornerRecord; 4],
}

/// Corner of a gate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CornerRecord {
    /// Position in the image; [0, 0] if it is behind the camera. [px]
    pub(super) at_px: [f64; 2],
    /// Depth along the optical axis. [m, cam]
    pub(super) depth_m: f64,
    /// Visibility of COCO: 0 not in the image, 1 in the image but hidden, 2 visible.
    pub(super) visibility: u8,
}
