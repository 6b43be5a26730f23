//! `[[cameras]]`: size, lens, mounting, and what the server alone needs to know of a camera.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::{
    Body, Cam, Distortion, Intrinsics, InvalidIntrinsics, LensConfig, Pose, body_from_forward_cam,
};
use vizflyt_protocol::messages::{CameraInfo, bounded};

use super::imaging::ImagingConfig;
use super::validate::{ConfigError, check_number, check_position, invalid};

/// One of `[[cameras]]`.
///
/// What it sees is given either by `horizontal_fov_deg` (a pinhole, square pixels, the axis in the
/// middle), or as a calibration gives it: `fx_px`, `fy_px`, `cx_px`, `cy_px` and `distortion`.
///
/// ```
/// let text = r#"
/// name = "fisheye"
/// width_px = 640
/// height_px = 480
/// fx_px = 212.0
/// fy_px = 211.5
/// cx_px = 322.5
/// cy_px = 238.1
/// distortion = { model = "kannala-brandt", k1 = 0.01, k2 = -0.002 }
/// position_m = [0.06, 0.03, 0.02]
/// tilt_deg = 10.0
/// yaw_deg = 90.0
/// near_m = 0.1
/// rate_hz = 30.0
/// priority = 1
/// "#;
/// let camera: vizflyt_arena::config::CameraConfig = toml::from_str(text).unwrap();
/// assert_eq!(camera.intrinsics().cx_px, 322.5);
/// // It looks to the left, 10 degrees up.
/// let axis = camera.body_from_cam().rotate(glam::DVec3::Z);
/// assert!((axis - glam::DVec3::new(0.0, 0.9848, 0.1736)).length() < 1e-4);
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// What plugins call it; unique, at most 32 bytes.
    pub name: String,
    /// Image width. [px]
    pub width_px: u32,
    /// Image height. [px]
    pub height_px: u32,
    /// From the left edge to the right edge, of a camera without distortion; or give the four below. [deg]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub horizontal_fov_deg: Option<f64>,
    /// Focal length along x. [px]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fx_px: Option<f64>,
    /// Focal length along y. [px]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fy_px: Option<f64>,
    /// Principal point from the image's left edge: OpenCV's, which counts from the middle of the
    /// first pixel, plus 0.5. [px]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cx_px: Option<f64>,
    /// Principal point from the image's upper edge: OpenCV's plus 0.5. [px]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cy_px: Option<f64>,
    /// How the lens distorts; of the same calibration as the focal lengths. Without it, not at all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distortion: Option<LensConfig>,
    /// Where it sits on the vehicle. [m, body]
    pub position_m: DVec3,
    /// Nose-up tilt of the optical axis, after the yaw. [deg]
    #[serde(default)]
    pub tilt_deg: f64,
    /// Turn of the optical axis to the left, about the body's z, before the tilt. [deg]
    #[serde(default, skip_serializing_if = "is_zero")]
    pub yaw_deg: f64,
    /// Turn about the optical axis, its right side down, after yaw and tilt. [deg]
    #[serde(default, skip_serializing_if = "is_zero")]
    pub roll_deg: f64,
    /// Nearest distance along the optical axis that is drawn. [m]
    #[serde(default = "default_near_m", skip_serializing_if = "is_default_near")]
    pub near_m: f64,
    /// Images a second at most; without it as many as the server can render. [Hz]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    /// When the network is short, images of cameras with a higher number are sent first.
    #[serde(default, skip_serializing_if = "is_normal")]
    pub priority: i32,
    /// Whether its images come with depth; by default they do. Depth that a course withholds does
    /// not leave the server: plugins get "no return" in every pixel.
    #[serde(default = "yes", skip_serializing_if = "is_yes")]
    pub depth: bool,
    /// How it differs from a perfect camera; without it, not at all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub imaging: Option<ImagingConfig>,
}

impl CameraConfig {
    /// Nearer splats would fill the image when the body brushes something; less than a body's
    /// radius. [m]
    pub const NEAR_M: f64 = 0.05;

    /// Returns a pinhole camera at `position_m` [m, body] that looks along the nose.
    pub fn ahead(
        name: &str,
        [width_px, height_px]: [u32; 2],
        horizontal_fov_deg: f64,
        position_m: DVec3,
    ) -> Self {
        Self {
            name: name.to_owned(),
            width_px,
            height_px,
            horizontal_fov_deg: Some(horizontal_fov_deg),
            fx_px: None,
            fy_px: None,
            cx_px: None,
            cy_px: None,
            distortion: None,
            position_m,
            tilt_deg: 0.0,
            yaw_deg: 0.0,
            roll_deg: 0.0,
            near_m: Self::NEAR_M,
            rate_hz: None,
            priority: 0,
            depth: true,
            imaging: None,
        }
    }

    /// Returns size, focal lengths, principal point and lens. Focal lengths that are not there,
    /// which a validated config does not lack, are 0.
    pub fn intrinsics(&self) -> Intrinsics {
        if let Some(fov_deg) = self.horizontal_fov_deg {
            let fov_rad = fov_deg.to_radians();
            return Intrinsics::from_horizontal_fov(self.width_px, self.height_px, fov_rad);
        }
        Intrinsics {
            width_px: self.width_px,
            height_px: self.height_px,
            fx_px: self.fx_px.unwrap_or_default(),
            fy_px: self.fy_px.unwrap_or_default(),
            cx_px: self.cx_px.unwrap_or_default(),
            cy_px: self.cy_px.unwrap_or_default(),
            distortion: self.distortion.map_or(Distortion::None, Distortion::from),
        }
    }

    /// Returns the extrinsics: the forward camera rolled about its axis, tilted up, then turned to
    /// the left.
    pub fn body_from_cam(&self) -> Pose<Body, Cam> {
        let forward = body_from_forward_cam(self.position_m, self.tilt_deg.to_radians());
        // A camera's z is ahead and its y down: the right side goes down by turning x towards y.
        let roll = DQuat::from_rotation_z(self.roll_deg.to_radians());
        let yaw = DQuat::from_rotation_z(self.yaw_deg.to_radians());
        Pose::new(self.position_m, yaw * forward.rotation * roll)
    }

    /// Returns what the runtime must know of it.
    pub fn info(&self) -> CameraInfo {
        CameraInfo {
            name: bounded(&self.name),
            intrinsics: self.intrinsics(),
            body_from_cam: self.body_from_cam(),
        }
    }

    /// Checks every value but the name: for a camera that is changed later.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] for the first value that cannot work.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.check(str::to_owned)
    }

    /// Checks all but the name, which must differ from other cameras'; `key` names a field.
    pub(super) fn check(&self, key: impl Fn(&str) -> String) -> Result<(), ConfigError> {
        self.check_intrinsics(&key)?;
        check_position(&key("position_m"), self.position_m)?;
        if self.position_m.length() > MAX_LEVER_M {
            let advice = format!("the camera must be within {MAX_LEVER_M} m of the body");
            return Err(invalid(key("position_m"), self.position_m, advice));
        }
        check_number(&key("tilt_deg"), self.tilt_deg, "degrees", -90.0..=90.0)?;
        check_number(&key("yaw_deg"), self.yaw_deg, "degrees", -360.0..=360.0)?;
        check_number(&key("roll_deg"), self.roll_deg, "degrees", -360.0..=360.0)?;
        check_number(&key("near_m"), self.near_m, "m", 0.001..=100.0)?;
        self.rate_hz.map_or(Ok(()), |hz| check_number(&key("rate_hz"), hz, "Hz", 0.1..=1000.0))?;
        let key = |field: &str| key(&format!("imaging.{field}"));
        self.imaging.as_ref().map_or(Ok(()), |imaging| imaging.check(key))
    }

    fn check_intrinsics(&self, key: impl Fn(&str) -> String) -> Result<(), ConfigError> {
        let calibrated = [
            ("fx_px", self.fx_px),
            ("fy_px", self.fy_px),
            ("cx_px", self.cx_px),
            ("cy_px", self.cy_px),
        ];
        let given = calibrated.iter().find_map(|&(name, value)| Some((name, value?)));
        let absent = calibrated.iter().find(|(_, value)| value.is_none());
        if let Some(fov_deg) = self.horizontal_fov_deg {
            check_number(&key("horizontal_fov_deg"), fov_deg, "degrees", 1.0..=170.0)?;
            if let Some((name, value)) = given {
                let advice = format!(
                    "horizontal_fov_deg = {fov_deg} is the same in another form; remove it, or \
                     fx_px, fy_px, cx_px and cy_px"
                );
                return Err(invalid(key(name), value, advice));
            }
            if self.distortion.is_some() {
                let advice = "with a distortion give fx_px, fy_px, cx_px and cy_px of the same \
                              calibration instead; the field of view of a lens depends on both";
                return Err(invalid(key("horizontal_fov_deg"), fov_deg, advice));
            }
        } else if let Some((name, _)) = absent {
            let advice = if given.is_some() || self.distortion.is_some() {
                "a calibration is whole: give all of fx_px, fy_px, cx_px and cy_px"
            } else {
                "give horizontal_fov_deg, or fx_px, fy_px, cx_px and cy_px"
            };
            return Err(invalid(key(name), "absent", advice));
        }
        let k = self.intrinsics();
        k.validate().map_err(|error| {
            let (name, value) = match error {
                InvalidIntrinsics::Size(w, h) => ("width_px x height_px", format!("{w}x{h}")),
                InvalidIntrinsics::Focal(fx, fy) => ("fx_px, fy_px", format!("{fx}, {fy}")),
                InvalidIntrinsics::Centre(cx, cy) => ("cx_px, cy_px", format!("{cx}, {cy}")),
                InvalidIntrinsics::Distortion => ("distortion", format!("{:?}", k.distortion)),
            };
            invalid(key(name), value, error.to_string())
        })
    }
}

fn default_near_m() -> f64 {
    CameraConfig::NEAR_M
}

#[allow(clippy::trivially_copy_pass_by_ref, clippy::float_cmp, reason = "as serde calls it")]
fn is_default_near(near_m: &f64) -> bool {
    *near_m == CameraConfig::NEAR_M
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
fn is_normal(priority: &i32) -> bool {
    *priority == 0
}

fn yes() -> bool {
    true
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
fn is_yes(value: &bool) -> bool {
    *value
}

/// A camera further from the body than this is a typing error. [m]
const MAX_LEVER_M: f64 = 2.0;
