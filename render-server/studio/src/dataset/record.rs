//! What is known of an image, beside its pixels: `records/SPLIT/N.json`. Written last of an image's files, so that an image
//! whose record is there is whole; indices of all formats are made of records alone.
//!
//! Pixels are continuous: (0, 0) is the image's upper left corner, the first pixel's middle (0.5, 0.5).

use serde::{Deserialize, Serialize};
use vizflyt_arena::config::EnvironmentConfig;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World as WorldFrame};

use super::shot::numbers;
use super::store::ImageName;

/// The whole record.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ImageRecord {
    /// From 0, over the whole data set.
    pub(super) index: u64,
    /// `train` or `val`.
    pub(super) split: String,
    pub(super) scene: String,
    /// Of the scene.
    pub(super) seed: u64,
    /// Of the scene's clock. [ns]
    pub(super) at_ns: i64,
    pub(super) camera: CameraRecord,
    pub(super) world_from_cam: PoseRecord,
    /// Where optical flow leads to; none at the end of a path.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) next: Option<NextRecord>,
    pub(super) environment: EnvironmentConfig,
    /// Things that are seen, by their ids.
    pub(super) things: Vec<ThingRecord>,
    /// Gates that are seen, and those a corner of which is in the image though hidden, in the order of the course.
    pub(super) gates: Vec<GateRecord>,
}

impl ImageRecord {
    /// Returns what names its files.
    pub(super) fn name(&self) -> ImageName<'_> {
        let Self { index, split, scene, at_ns, .. } = self;
        ImageName { index: *index, split, scene, at_ns: *at_ns }
    }
}

/// A pinhole.
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

    /// Returns them as the renderer takes them.
    pub(super) fn intrinsics(&self) -> Intrinsics {
        let Self { width_px, height_px, fx_px, fy_px, cx_px, cy_px } = *self;
        let distortion = vizflyt_protocol::geometry::Distortion::None;
        Intrinsics { width_px, height_px, fx_px, fy_px, cx_px, cy_px, distortion }
    }
}

/// `a_from_b`: takes points of b to a.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PoseRecord {
    /// [m]
    pub(super) p_m: [f64; 3],
    /// Unit, Hamilton.
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

/// The camera a moment later.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct NextRecord {
    /// Of the scene's clock. [ns]
    pub(super) at_ns: i64,
    pub(super) world_from_cam: PoseRecord,
}

/// A thing in the image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ThingRecord {
    /// What the instance mask has where it is seen.
    pub(super) id: u16,
    pub(super) name: String,
    pub(super) class: String,
    pub(super) area_px: u32,
    /// Left, top, width, height; tight. [px]
    pub(super) box_px: [u32; 4],
    /// Its mask as run lengths, COCO's text.
    pub(super) rle: String,
}

/// A gate of the course.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct GateRecord {
    /// Of its stage.
    pub(super) name: String,
    /// Of its thing; 0 if no splats are known to be its own.
    pub(super) id: u16,
    /// Middle of the opening; x along the passage, y to the left, z up.
    pub(super) cam_from_gate: PoseRecord,
    /// Width and height of the opening. [m]
    pub(super) size_m: [f64; 2],
    /// Of the opening, as one sees them who flies through: upper left, upper right, lower right, lower left.
    pub(super) corners: [CornerRecord; 4],
}

/// A corner of a gate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CornerRecord {
    /// Where it is; [0, 0] behind the camera. [px]
    pub(super) at_px: [f64; 2],
    /// Along the optical axis. [m, cam]
    pub(super) depth_m: f64,
    /// As COCO has it: 0 not in the image, 1 in it but hidden, 2 seen.
    pub(super) visibility: u8,
}
