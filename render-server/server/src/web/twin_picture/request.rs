//! Request of an image: a camera, as query of an address.

use glam::{DQuat, DVec3};
use serde::Deserialize;
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::{Atmosphere, Camera, InvalidCamera};

/// Query of an image of the twin; all keys are required, others are rejected.
#[derive(Clone, Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub(in crate::web) struct PictureRequest {
    /// Position of the camera. [m, world]
    x_m: f64,
    y_m: f64,
    z_m: f64,
    /// Rotation from the camera's axes (x right, y down, z forward) to the world's; unit quaternion.
    qx: f64,
    qy: f64,
    qz: f64,
    qw: f64,
    /// Vertical field of view. [deg]
    fov_deg: f64,
    width_px: u32,
    height_px: u32,
    /// Whether to omit splats beyond the sides of the fence that the camera is beyond.
    pub(in crate::web) cut: bool,
    /// Background colour: RGB as six hexadecimal digits.
    background: String,
}

/// Reason for which a request is rejected.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(in crate::web) enum Refused {
    #[error("{0} x {1} px: give 16 to {MAX_SIDE_PX} a side, {MAX_PX} in all")]
    Size(u32, u32),
    #[error("fov_deg = {0}: give 5 to 150")]
    Fov(f64),
    #[error("qx, qy, qz, qw = {0}: give a unit quaternion")]
    Rotation(DQuat),
    #[error("background = {0:?}: give six hexadecimal digits, such as 0d1217")]
    Background(String),
    #[error(transparent)]
    Camera(#[from] InvalidCamera),
}

impl PictureRequest {
    /// Returns the requested camera, valid for every renderer.
    ///
    /// # Errors
    /// If a number is not finite, or out of range.
    pub(in crate::web) fn camera(&self) -> Result<Camera, Refused> {
        let Self { width_px, height_px, fov_deg, .. } = *self;
        let is_side = |side| (16..=MAX_SIDE_PX).contains(&side);
        if !is_side(width_px) || !is_side(height_px) || width_px * height_px > MAX_PX {
            return Err(Refused::Size(width_px, height_px));
        }
        if !(5.0..=150.0).contains(&fov_deg) {
            return Err(Refused::Fov(fov_deg));
        }
        let rotation = DQuat::from_xyzw(self.qx, self.qy, self.qz, self.qw);
        if !((rotation.length() - 1.0).abs() < 1e-3) {
            return Err(Refused::Rotation(rotation));
        }
        let p_m = DVec3::new(self.x_m, self.y_m, self.z_m);
        let across_rad = 2.0
            * ((fov_deg.to_radians() / 2.0).tan() * f64::from(width_px) / f64::from(height_px))
                .atan();
        let camera = Camera {
            intrinsics: Intrinsics::from_horizontal_fov(width_px, height_px, across_rad),
            world_from_cam: Pose::new(p_m, rotation.normalize()),
            near_m: NEAR_M,
            background: self.background()?,
            atmosphere: Atmosphere::CLEAR,
        };
        camera.validate()?;
        Ok(camera)
    }

    fn background(&self) -> Result<[f32; 3], Refused> {
        let text = &self.background;
        let is_hex = text.len() == 6 && text.bytes().all(|digit| digit.is_ascii_hexdigit());
        let rgb = u32::from_str_radix(text, 16).ok().filter(|_| is_hex);
        let [_, rgb @ ..] = rgb.ok_or_else(|| Refused::Background(text.clone()))?.to_be_bytes();
        Ok(rgb.map(|level| f32::from(level) / 255.0))
    }
}

/// Near plane of the page's 3D view. [m]
const NEAR_M: f32 = 0.1;
const MAX_SIDE_PX: u32 = 960;
const MAX_PX: u32 = 960 * 540;

#[cfg(test)]
mod tests {
    use super::*;
    use axum::extract::Query;
    use axum::http::Uri;
    use glam::DVec2;
    use proptest::prelude::*;

    const GOOD: &str = "x_m=1&y_m=-2.5&z_m=1e0&qx=0&qy=0&qz=0&qw=1&fov_deg=50&width_px=960&height_px=540\
         &cut=true&background=0d1217";

    /// Parses a query as the server does; `None` if it is malformed.
    fn read(query: &str) -> Option<Result<Camera, Refused>> {
        let uri: Uri = format!("/api/twin?{query}").parse().ok()?;
        let request = Query::<PictureRequest>::try_from_uri(&uri).ok()?;
        Some(request.camera())
    }

    #[test]
    fn a_request_becomes_the_camera_that_it_describes() {
        let camera = read(GOOD).unwrap().unwrap();
        assert_eq!(camera.world_from_cam.translation_m, DVec3::new(1.0, -2.5, 1.0));
        let middle = camera.intrinsics.project(DVec3::Z).unwrap();
        assert!(middle.distance(DVec2::new(480.0, 270.0)) < 1e-9);
        let top = DVec3::new(0.0, -(25.0_f64.to_radians().tan()), 1.0);
        let top = camera.intrinsics.project(top).unwrap();
        assert!(top.distance(DVec2::new(480.0, 0.0)) < 1e-9, "{top}");
        assert_eq!(camera.background.map(|level| (level * 255.0).round()), [13.0, 18.0, 23.0]);
    }

    #[test]
    fn errors_name_the_value_and_the_accepted_range() {
        for (good, bad, says) in [
            ("width_px=960", "width_px=961", "16 to 960 a side"),
            ("height_px=540", "height_px=541", "518400 in all"),
            ("height_px=540", "height_px=0", "16 to 960 a side"),
            ("fov_deg=50", "fov_deg=NaN", "give 5 to 150"),
            ("fov_deg=50", "fov_deg=151", "give 5 to 150"),
            ("qw=1", "qw=2", "unit quaternion"),
            ("qw=1", "qw=NaN", "unit quaternion"),
            ("x_m=1", "x_m=inf", "finite position"),
            ("x_m=1", "x_m=1e8", "finite position"),
            ("0d1217", "+d1217", "six hexadecimal digits"),
            ("0d1217", "0d12", "six hexadecimal digits"),
        ] {
            let query = GOOD.replace(good, bad);
            let error = read(&query).unwrap().unwrap_err().to_string();
            assert!(error.contains(says), "{bad}: {error}");
        }
        for query in ["", "x_m=1", &format!("{GOOD}&more=1"), &GOOD.replace("cut=true", "cut=7")] {
            assert_eq!(read(query), None, "{query}");
        }
    }

    proptest! {
        #[test]
        fn no_query_panics_and_accepted_ones_are_small_and_valid(
            key in 0..12_usize, value in "[-+0-9a-zA-Z.%&=]{0,12}", noise in "\\PC{0,80}",
        ) {
            let mut pairs: Vec<_> = GOOD.split('&').map(str::to_owned).collect();
            let (name, _) = pairs[key].split_once('=').unwrap();
            pairs[key] = format!("{name}={value}");
            for query in [pairs.join("&"), noise] {
                if let Some(Ok(camera)) = read(&query) {
                    prop_assert_eq!(camera.validate(), Ok(()));
                    prop_assert!(camera.intrinsics.pixels() <= MAX_PX as usize);
                }
            }
        }

        #[test]
        fn accepts_every_camera_of_a_page(
            p in prop::array::uniform3(-1e3..1e3_f64), turn in prop::array::uniform3(-3.0..3.0_f64),
            fov in 5.0..150.0_f64, width in 16..=960_u32, height in 16..=540_u32,
        ) {
            let q = DQuat::from_scaled_axis(turn.into());
            let query = format!(
                "x_m={}&y_m={}&z_m={}&qx={}&qy={}&qz={}&qw={}&fov_deg={fov}&width_px={width}\
                 &height_px={height}&cut=false&background=ffffff",
                p[0], p[1], p[2], q.x, q.y, q.z, q.w
            );
            let camera = read(&query).unwrap().unwrap();
            prop_assert_eq!(camera.world_from_cam.translation_m, DVec3::from(p));
            prop_assert!(camera.world_from_cam.rotation.abs_diff_eq(q, 1e-12));
        }
    }
}
