//! CAM.json: camera in the format of the numpy reference renderer (`splat_oracle.py`), plus `near_m` and `distortion`.
//!
//! ```json
//! {"fx": 251.1, "fy": 251.1, "cx": 160.0, "cy": 120.0, "w": 320, "h": 240, "bg": [0, 0, 0],
//!  "w2c": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
//!  "near_m": 0.01, "distortion": {"model": "brown-conrady", "k1": -0.1}}
//! ```
//! `w2c` transforms points of the scene file to the camera: x right, y down, z forward. Pixel centres lie at +0.5.
//! `bg`, `near_m` and `distortion` are optional.

use std::path::Path;
use std::str::FromStr;

use anyhow::{Context, Result, bail};
use glam::{DMat3, DQuat, DVec3};
use serde::Deserialize;
use vizflyt_protocol::geometry::{Cam, Distortion, Intrinsics, LensConfig, Pose, World};
use vizflyt_splat::{Atmosphere, Camera};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraFile {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    w: u32,
    h: u32,
    w2c: [[f64; 4]; 4],
    #[serde(default)]
    bg: [f32; 3],
    #[serde(default = "oracle_near_m")]
    near_m: f32,
    #[serde(default)]
    distortion: Option<LensConfig>,
}

/// Default of the reference renderer. [m]
fn oracle_near_m() -> f32 {
    0.01
}

/// Reads a camera. Its world frame is the frame of the scene file.
pub fn read(path: &Path) -> Result<Camera> {
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("cannot read {} as a camera, a JSON file", path.display()))?;
    parse(&text).with_context(|| format!("{} is not a valid camera", path.display()))
}

fn parse(text: &str) -> Result<Camera> {
    let file: CameraFile = serde_json::from_str(text).context(
        "it needs fx, fy, cx, cy, w, h and w2c (4x4, world to camera), and may have bg, near_m \
         and distortion",
    )?;
    let [rows @ .., last] = file.w2c;
    if last != [0.0, 0.0, 0.0, 1.0] {
        bail!("the last row of w2c is {last:?}, not [0, 0, 0, 1]; is it transposed?");
    }
    let row = |k: usize| DVec3::new(rows[k][0], rows[k][1], rows[k][2]);
    let rotation = DMat3::from_cols(row(0), row(1), row(2)).transpose();
    let off = rotation * rotation.transpose() - DMat3::IDENTITY;
    let worst = off.to_cols_array().into_iter().fold(0.0, |a: f64, b| a.max(b.abs()));
    if !(worst < 1e-3 && rotation.determinant() > 0.0) {
        bail!(
            "the upper left 3x3 of w2c is not a rotation (its rows deviate from orthonormal by {worst:.2e}, \
             its determinant is {:.3}); apply a scale to the scene instead, and let y point down, \
             z forward",
            rotation.determinant()
        );
    }
    let translation = DVec3::new(rows[0][3], rows[1][3], rows[2][3]);
    let cam_from_world: Pose<Cam, World> =
        Pose::new(translation, DQuat::from_mat3(&rotation).normalize());
    let camera = Camera {
        intrinsics: Intrinsics {
            width_px: file.w,
            height_px: file.h,
            fx_px: file.fx,
            fy_px: file.fy,
            cx_px: file.cx,
            cy_px: file.cy,
            distortion: file.distortion.map_or(Distortion::None, Distortion::from),
        },
        world_from_cam: cam_from_world.inverse(),
        near_m: file.near_m,
        background: file.bg,
        atmosphere: Atmosphere::CLEAR,
    };
    camera.validate()?;
    Ok(camera)
}

/// Returns the camera with another image size and the same field of view.
pub fn resized(camera: &Camera, size: ImageSize) -> Result<Camera> {
    let k = camera.intrinsics;
    let [across, down] = [
        f64::from(size.width_px) / f64::from(k.width_px),
        f64::from(size.height_px) / f64::from(k.height_px),
    ];
    let intrinsics = Intrinsics {
        width_px: size.width_px,
        height_px: size.height_px,
        fx_px: k.fx_px * across,
        fy_px: k.fy_px * down,
        cx_px: k.cx_px * across,
        cy_px: k.cy_px * down,
        distortion: k.distortion,
    };
    let camera = Camera { intrinsics, ..*camera };
    camera.validate().context("--size")?;
    Ok(camera)
}

/// Image size, parsed from `WxH`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageSize {
    pub width_px: u32,
    pub height_px: u32,
}

impl FromStr for ImageSize {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let sides = text.split_once(['x', 'X']);
        let number = |side: &str| side.trim().parse().ok().filter(|&side: &u32| side > 0);
        match sides.map(|(width, height)| (number(width), number(height))) {
            Some((Some(width_px), Some(height_px))) => Ok(Self { width_px, height_px }),
            _ => Err(format!("'{text}' is not a size in pixels; write it as 640x480")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = r#"{"fx": 200, "fy": 210, "cx": 160, "cy": 120, "w": 320, "h": 240,
        "w2c": [[0, -1, 0, 1], [0, 0, -1, 2], [1, 0, 0, 3], [0, 0, 0, 1]]}"#;

    fn refused(text: &str, expected: &str) {
        let error = format!("{:#}", parse(text).unwrap_err());
        assert!(error.contains(expected), "'{error}' lacks '{expected}'");
    }

    #[test]
    fn reads_a_camera_of_the_reference_renderer() {
        let camera = parse(GOOD).unwrap();
        // The world's x axis is the camera's forward axis: row 2 of w2c.
        let p_cam = camera.world_from_cam.inverse().transform_point(DVec3::X);
        assert!((p_cam - DVec3::new(1.0, 2.0, 4.0)).length() < 1e-12);
        assert_eq!((camera.near_m, camera.background), (0.01, [0.0; 3]));
        let more = GOOD.replace("{\"fx\"", "{\"near_m\": 0.5, \"bg\": [1, 1, 1], \"fx\"");
        assert_eq!(parse(&more).unwrap().near_m, 0.5);
    }

    #[test]
    fn errors_name_the_problem_of_a_camera() {
        refused("{}", "missing field `fx`");
        refused(&GOOD.replace("\"cx\"", "\"near\""), "unknown field `near`");
        refused(&GOOD.replace("[0, 0, 0, 1]]", "[1, 2, 3, 1]]"), "is it transposed?");
        refused(&GOOD.replace("[1, 0, 0, 3]", "[2, 0, 0, 3]"), "is not a rotation");
        refused(&GOOD.replace("[1, 0, 0, 3]", "[-1, 0, 0, 3]"), "determinant is -1.000");
        refused(&GOOD.replace("320", "0"), "image size 0x240");
        refused(&GOOD.replace("210", "-1"), "focal length");
    }

    #[test]
    fn another_size_keeps_the_field_of_view() {
        let camera = parse(GOOD).unwrap();
        let double = resized(&camera, "640x480".parse().unwrap()).unwrap();
        let p_cam = DVec3::new(0.3, -0.2, 2.0);
        let (a, b) = (camera.intrinsics.project(p_cam), double.intrinsics.project(p_cam));
        assert!((a.unwrap() * 2.0 - b.unwrap()).length() < 1e-9);
        for wrong in ["640", "640x", "0x10", "axb", "640x480x2", "-1x5"] {
            assert!(wrong.parse::<ImageSize>().unwrap_err().contains("as 640x480"), "{wrong}");
        }
    }
}
