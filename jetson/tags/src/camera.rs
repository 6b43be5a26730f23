//! A camera: source of its images, lens, and pose.

use std::path::Path;

use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::{Body, Cam, Distortion, Intrinsics, LensConfig, Pose, World};

use crate::file::{self, FileError, PoseConfig, check_number, invalid};

/// A camera that detects tags.
///
/// ```
/// let text = r#"
/// name = "left"
/// source = "/dev/video0"
/// width_px = 1280
/// height_px = 720
/// fx_px = 905.2
/// fy_px = 904.8
/// cx_px = 641.3
/// cy_px = 357.9
/// distortion = { model = "brown-conrady", k1 = -0.11, k2 = 0.02 }
///
/// [world_from_cam]
/// position_m = [0.0, 0.0, 2.5]
/// rotation_xyzw = [-0.5, 0.5, -0.5, 0.5]
/// "#;
/// let camera = vizflyt_tags::camera::TagCamera::parse(text).unwrap();
/// let vizflyt_tags::camera::Mounting::World(world_from_cam) = camera.mounting else { panic!() };
/// // The camera looks along x, level.
/// assert!((world_from_cam.rotate(glam::DVec3::Z) - glam::DVec3::X).length() < 1e-12);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct TagCamera {
    /// Name in messages and on the page.
    pub name: String,
    /// Source of images: `/dev/video0`, a folder, or a video file. Absent if the caller supplies the images.
    pub source: Option<String>,
    /// Size, focal lengths, principal point, distortion.
    pub intrinsics: Intrinsics,
    pub mounting: Mounting,
    /// Accuracy of the lens; absent if it was not calibrated by this project.
    pub calibration: Option<Calibration>,
    /// Accuracy of the pose; absent if it was not surveyed by this project.
    pub survey: Option<Survey>,
    /// Constant delay from the exposure to the image's stamp. [ms]
    pub latency_ms: f64,
}

/// Accuracy of a camera's pose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Survey {
    /// Standard deviation of the position. [m]
    pub sigma_m: f64,
    /// Root mean square reprojection error of corners. [px]
    pub rms_px: f64,
    /// Number of corners used.
    pub corners: u32,
}

/// Pose of a camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Mounting {
    /// No pose: calibrated, but not yet surveyed.
    Unknown,
    /// Fixed in the room: `world_from_cam`.
    World(Pose<World, Cam>),
    /// On the vehicle: `body_from_cam`.
    Body(Pose<Body, Cam>),
}

/// Accuracy of a lens.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Root mean square reprojection error in the images used. [px]
    pub rms_px: f64,
    /// Root mean square reprojection error in images that were held back. Must not be much larger than `rms_px`. [px]
    pub held_out_rms_px: f64,
    /// Number of images used.
    pub images: u32,
}

/// Format of the file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraFile {
    name: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    source: Option<String>,
    width_px: u32,
    height_px: u32,
    #[serde(default, skip_serializing_if = "is_zero")]
    latency_ms: f64,
    fx_px: f64,
    fy_px: f64,
    cx_px: f64,
    cy_px: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    distortion: Option<LensConfig>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    calibration: Option<Calibration>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    survey: Option<Survey>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    world_from_cam: Option<PoseConfig>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    body_from_cam: Option<PoseConfig>,
}

impl TagCamera {
    /// Parses a camera from TOML.
    ///
    /// # Errors
    /// [`FileError::Toml`] if the text does not match the format, [`FileError::Invalid`] for a value out of range.
    pub fn parse(text: &str) -> Result<Self, FileError> {
        let file: CameraFile = vizflyt_toml::parse(text)?;
        let mounting = match (file.world_from_cam, file.body_from_cam) {
            (None, None) => Mounting::Unknown,
            (Some(pose), None) => {
                pose.check(|field| format!("world_from_cam.{field}"))?;
                Mounting::World(pose.pose())
            }
            (None, Some(pose)) => {
                pose.check(|field| format!("body_from_cam.{field}"))?;
                Mounting::Body(pose.pose())
            }
            (Some(_), Some(pose)) => {
                let advice = "the camera is fixed in the room (world_from_cam) or on the vehicle \
                              (body_from_cam); remove one";
                return Err(invalid("body_from_cam", pose.position_m, advice));
            }
        };
        let camera = Self {
            name: file.name,
            source: file.source,
            intrinsics: Intrinsics {
                width_px: file.width_px,
                height_px: file.height_px,
                fx_px: file.fx_px,
                fy_px: file.fy_px,
                cx_px: file.cx_px,
                cy_px: file.cy_px,
                distortion: file.distortion.map_or(Distortion::None, Distortion::from),
            },
            mounting,
            calibration: file.calibration,
            survey: file.survey,
            latency_ms: file.latency_ms,
        };
        camera.validate()?;
        Ok(camera)
    }

    /// Reads a camera file.
    ///
    /// # Errors
    /// As [`Self::parse`], and [`FileError::Io`]; the error contains the path.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        file::read(path, Self::parse)
    }

    /// Returns the camera as TOML.
    ///
    /// # Errors
    /// [`FileError::Unwritable`], if a number is NaN.
    pub fn to_toml(&self) -> Result<String, FileError> {
        let k = &self.intrinsics;
        let (world_from_cam, body_from_cam) = match self.mounting {
            Mounting::Unknown => (None, None),
            Mounting::World(pose) => (Some(PoseConfig::new(pose)), None),
            Mounting::Body(pose) => (None, Some(PoseConfig::new(pose))),
        };
        Ok(toml::to_string(&CameraFile {
            name: self.name.clone(),
            source: self.source.clone(),
            width_px: k.width_px,
            height_px: k.height_px,
            fx_px: k.fx_px,
            fy_px: k.fy_px,
            cx_px: k.cx_px,
            cy_px: k.cy_px,
            distortion: LensConfig::new(k.distortion),
            calibration: self.calibration,
            survey: self.survey,
            latency_ms: self.latency_ms,
            world_from_cam,
            body_from_cam,
        })?)
    }

    /// Writes a camera file.
    ///
    /// # Errors
    /// [`FileError::Io`]; the error contains the path.
    pub fn write(&self, path: &Path) -> Result<(), FileError> {
        file::write(path, &self.to_toml()?)
    }

    fn validate(&self) -> Result<(), FileError> {
        if self.name.trim().is_empty() || self.name.len() > MAX_NAME_BYTES {
            let advice = format!("give a name of 1 to {MAX_NAME_BYTES} bytes");
            return Err(invalid("name", format!("{:?}", self.name), advice));
        }
        if let Some(source) = &self.source
            && (source.trim().is_empty() || source.contains('\0'))
        {
            let advice = "give a device, a folder or a video file; or leave it out";
            return Err(invalid("source", format!("{source:?}"), advice));
        }
        let k = &self.intrinsics;
        k.validate().map_err(|error| {
            let size = format!("{}x{}, {}, {}", k.width_px, k.height_px, k.fx_px, k.fy_px);
            invalid("width_px x height_px, fx_px, fy_px", size, error.to_string())
        })?;
        check_number("latency_ms", self.latency_ms, "ms", 0.0..=500.0)?;
        if let Some(survey) = &self.survey {
            check_number("survey.sigma_m", survey.sigma_m, "m", 0.0..=10.0)?;
            check_number("survey.rms_px", survey.rms_px, "px", 0.0..=100.0)?;
        }
        if let Some(calibration) = &self.calibration {
            check_number("calibration.rms_px", calibration.rms_px, "px", 0.0..=100.0)?;
            let held_out_px = calibration.held_out_rms_px;
            check_number("calibration.held_out_rms_px", held_out_px, "px", 0.0..=100.0)?;
        }
        Ok(())
    }
}

/// A delay of zero is omitted from the file.
#[allow(clippy::trivially_copy_pass_by_ref, reason = "required by serde")]
fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

/// Same limit as for a camera's name in `arena.toml`.
const MAX_NAME_BYTES: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};
    use proptest::prelude::*;

    const LEFT: &str = "name = \"left\"\nwidth_px = 640\nheight_px = 480\nfx_px = 500.0\n\
                        fy_px = 500.0\ncx_px = 320.0\ncy_px = 240.0\n";

    fn check_refused(text: &str, parts: &[&str]) {
        let error = TagCamera::parse(text).expect_err(text).to_string();
        for part in parts {
            assert!(error.contains(part), "{error:?} lacks {part:?}");
        }
    }

    #[test]
    fn rejects_invalid_values_with_their_key() {
        let pose = "{ position_m = [0.0, 0.0, 1.0], rotation_xyzw = [0.0, 0.0, 0.0, 1.0] }";
        let both = format!("{LEFT}world_from_cam = {pose}\nbody_from_cam = {pose}");
        check_refused(&both, &["body_from_cam", "remove one"]);
        let flat = pose.replace("0.0, 1.0] }", "0.0, 0.0] }");
        let flat = format!("{LEFT}world_from_cam = {flat}");
        check_refused(&flat, &["world_from_cam.rotation_xyzw", "length 1"]);
        check_refused(&LEFT.replace("500.0", "0.0"), &["fx_px", "focal length"]);
        check_refused(&LEFT.replace("640", "0"), &["width_px", "image size 0x480"]);
        check_refused(&LEFT.replace("left", " "), &["name = \" \"", "1 to 32 bytes"]);
        check_refused(&LEFT.replace("fy_px", "fz_px"), &["fz_px"]);
        check_refused(&format!("{LEFT}source = \"\""), &["source", "folder"]);
        check_refused(&format!("{LEFT}latency_ms = 501.0"), &["latency_ms", "0 to 500 ms"]);
        check_refused(&format!("{LEFT}latency_ms = -1.0"), &["latency_ms = -1", "0 to 500 ms"]);
        let lens = format!("{LEFT}distortion = {{ model = \"brown-conrady\", k1 = inf }}");
        check_refused(&lens, &["distortion coefficient"]);
    }

    proptest! {
        #[test]
        fn camera_survives_a_round_trip_through_toml(
            focal_px in 100.0..2000.0f64, k1 in -0.5..0.5f64, fisheye: bool,
            p in prop::array::uniform3(-9.0..9.0f64), mounted in 0..3u8,
            source in prop::option::of("[a-z/]{1,12}"),
        ) {
            let k = Intrinsics { fx_px: focal_px, ..Intrinsics::from_horizontal_fov(1280, 720, 1.2) };
            let distortion = if fisheye {
                Distortion::KannalaBrandt { k1, k2: 0.0, k3: 0.1, k4: 0.0 }
            } else {
                Distortion::BrownConrady { k1, k2: 0.1, p1: 0.0, p2: 0.001, k3: 0.0 }
            };
            let q = DQuat::from_xyzw(0.5, -0.5, 0.5, 0.5);
            let camera = TagCamera {
                name: "a".into(),
                source,
                intrinsics: Intrinsics { distortion, ..k },
                mounting: match mounted {
                    0 => Mounting::Unknown,
                    1 => Mounting::World(Pose::new(DVec3::from(p), q)),
                    _ => Mounting::Body(Pose::new(DVec3::from(p), q)),
                },
                calibration: fisheye.then_some(Calibration { rms_px: 0.2, held_out_rms_px: 0.3, images: 20 }),
                survey: fisheye.then_some(Survey { sigma_m: 0.002, rms_px: 0.2, corners: 400 }),
                latency_ms: if fisheye { 12.5 } else { 0.0 },
            };
            prop_assert_eq!(TagCamera::parse(&camera.to_toml().unwrap()).unwrap(), camera);
        }
    }
}
