//! Lens of the pictures: calibrated, or an initial guess.

use std::path::Path;

use anyhow::{Result, ensure};
use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_tags::camera::TagCamera;

/// Reads a lens file and scales it to the size of the pictures.
///
/// # Errors
/// The file cannot be read, or its aspect ratio differs.
pub(super) fn read(path: &Path, size_px: [u32; 2]) -> Result<Intrinsics> {
    let k = TagCamera::read(path)?.intrinsics;
    let [width, height] = size_px.map(f64::from);
    let (across, down) = (width / f64::from(k.width_px), height / f64::from(k.height_px));
    // Tolerance for rounding the size by one pixel.
    ensure!(
        (across / down - 1.0).abs() <= 1.5 / width.min(height),
        "{}: calibrated at {} x {} pixels, but the pictures have {} x {}, another aspect ratio; calibrate with the \
         same video mode",
        path.display(),
        k.width_px,
        k.height_px,
        size_px[0],
        size_px[1]
    );
    Ok(Intrinsics {
        width_px: size_px[0],
        height_px: size_px[1],
        fx_px: k.fx_px * across,
        fy_px: k.fy_px * down,
        cx_px: k.cx_px * across,
        cy_px: k.cy_px * down,
        distortion: k.distortion,
    })
}

/// Returns a typical phone lens as the initial guess.
pub(super) fn guess([width, height]: [u32; 2]) -> Intrinsics {
    // Main lenses of phones have a field of view of 62 to 72 degrees along the longer side.
    let long = width.max(height);
    let k = Intrinsics::from_horizontal_fov(long, long, 67f64.to_radians());
    Intrinsics {
        width_px: width,
        height_px: height,
        cx_px: f64::from(width) / 2.0,
        cy_px: f64::from(height) / 2.0,
        ..k
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requires_pictures_of_the_same_aspect_ratio() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("camera.toml");
        let text = "name = \"phone\"\nwidth_px = 1920\nheight_px = 1080\nfx_px = 1500.0\nfy_px = 1501.0\n\
                    cx_px = 960.0\ncy_px = 540.0\n";
        std::fs::write(&path, text).unwrap();
        let k = read(&path, [960, 540]).unwrap();
        assert_eq!((k.width_px, k.fx_px, k.cy_px), (960, 750.0, 270.0));
        let error = read(&path, [1080, 1920]).unwrap_err().to_string();
        assert!(error.contains("another aspect ratio"), "{error}");
        assert!(read(&folder.path().join("none.toml"), [1, 1]).is_err());
    }

    #[test]
    fn guesses_the_same_lens_for_portrait_and_landscape() {
        let (level, upright) = (guess([1920, 1080]), guess([1080, 1920]));
        assert_eq!(level.fx_px, upright.fx_px);
        assert_eq!((upright.cx_px, upright.cy_px), (540.0, 960.0));
    }
}
