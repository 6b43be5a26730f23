//! `[[cameras]]`: size, lens, mounting, and settings that only the server uses.

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
/// The field of view is given either by `horizontal_fov_deg` (a pinhole, square pixels, the axis in the
/// middle), or by a calibration: `fx_px`, `fy_px`, `cx_px`, `cy_px` and `distortion`.
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
    /// Name for plugins; unique, at most 32 bytes.
    pub name: String,
    /// Image width. [px]
    pub width_px: u32,
    /// Image height. [px]
    pub height_px: u32,
    /// Field of view from the left edge to the right edge, for a camera without distortion; or give the four
    /// keys below. [deg]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub horizontal_fov_deg: Option<f64>,
    /// Focal length along x. [px]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fx_px: Option<f64>,
    /// Focal length along y. [px]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fy_px: Option<f64>,
    /// Principal point from the left edge of the image: OpenCV's value, which counts from the middle of the
    /// first pixel, plus 0.5. [px]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cx_px: Option<f64>,
    /// Principal point from the upper edge of the image: OpenCV's value plus 0.5. [px]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cy_px: Option<f64>,
    /// Lens distortion, from the same calibration as the focal lengths; without it, the lens has no distortion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distortion: Option<LensConfig>,
    /// Mounting position on the vehicle. [m, body]
    pub position_m: DVec3,
    /// Nose-up tilt of the optical axis, after the yaw. [deg]
    #[serde(default)]
    pub tilt_deg: f64,
    /// Turn of the optical axis to the left, about the body's z, before the tilt. [deg]
    #[serde(default, skip_serializing_if = "is_zero")]
    pub yaw_deg: f64,
    /// Turn about the optical axis, right side down, after yaw and tilt. [deg]
    #[serde(default, skip_serializing_if = "is_zero")]
    pub roll_deg: f64,
    /// Near limit: minimum rendered distance along the optical axis. [m]
    #[serde(default = "default_near_m", skip_serializing_if = "is_default_near")]
    pub near_m: f64,
    /// Maximum frame rate; without it, as high as the server can render. [Hz]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    /// Priority on a slow network: images of cameras with a higher number are sent first.
    #[serde(default, skip_serializing_if = "is_normal")]
    pub priority: i32,
    /// Whether images contain depth. If `false`, depth does not leave the server: plugins get "no return" in
    /// every pixel.
    #[serde(default = "yes", skip_serializing_if = "is_yes")]
    pub depth: bool,
    /// Simulation of a real sensor; without it, the camera is perfect.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub imaging: Option<ImagingConfig>,
}

impl CameraConfig {
    /// Nearer splats would fill the image when the body brushes against something; less than a body's radius.
    /// [m]
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

    /// Returns size, focal lengths, principal point and lens. Absent focal lengths are 0; a validated config
    /// has none absent.
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

    /// Returns the extrinsics: the forward camera rolled about its axis, tilted up, then turned left.
    pub fn body_from_cam(&self) -> Pose<Body, Cam> {
        let forward = body_from_forward_cam(self.position_m, self.tilt_deg.to_radians());
        // A camera's z points ahead and its y down: a turn of x towards y moves the right side down.
        let roll = DQuat::from_rotation_z(self.roll_deg.to_radians());
        let yaw = DQuat::from_rotation_z(self.yaw_deg.to_radians());
        Pose::new(self.position_m, yaw * forward.rotation * roll)
    }

    /// Returns the data that the runtime needs.
    pub fn info(&self) -> CameraInfo {
        CameraInfo {
            name: bounded(&self.name),
            intrinsics: self.intrinsics(),
            body_from_cam: self.body_from_cam(),
        }
    }

    /// Checks every value except the name: for later changes of one camera.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] for the first invalid value.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.check(str::to_owned)
    }

    /// Checks every value except the name, which must differ from other cameras' names; `key` names a field.
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
                "a calibration needs all four: give all of fx_px, fy_px, cx_px and cy_px"
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

/// A larger distance from the body is a typing error. [m]
const MAX_LEVER_M: f64 = 2.0;
