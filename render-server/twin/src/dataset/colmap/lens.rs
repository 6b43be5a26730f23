//! COLMAP's camera models (its `src/colmap/sensor/models.h`): names, numbers, parameters.

use vizflyt_protocol::geometry::{Distortion, Intrinsics};

use super::ColmapError;

/// Name and number of parameters, by the model's number.
const MODELS: [(&str, usize); 12] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
];

/// Returns a model's name and number of parameters.
pub(super) fn of_number(number: i32) -> Result<(&'static str, usize), ColmapError> {
    let model = usize::try_from(number).ok().and_then(|n| MODELS.get(n));
    model.copied().ok_or_else(|| ColmapError::Lens(format!("number {number}")))
}

/// Returns the intrinsics of a named model.
pub(super) fn intrinsics(
    name: &str,
    width: u64,
    height: u64,
    parameters: &[f64],
) -> Result<Intrinsics, ColmapError> {
    let Some(&(_, count)) = MODELS.iter().find(|(known, _)| *known == name) else {
        return Err(ColmapError::Lens(name.to_owned()));
    };
    if parameters.len() != count {
        let what = format!("camera model {name} has {} parameters, not {count}", parameters.len());
        return Err(ColmapError::Damaged(what));
    }
    let brown = |k1, k2, p1, p2| Distortion::BrownConrady { k1, k2, p1, p2, k3: 0.0 };
    let fisheye = |k1, k2, k3, k4| Distortion::KannalaBrandt { k1, k2, k3, k4 };
    let (focal, centre, distortion) = match (name, parameters) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], Distortion::None),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], Distortion::None),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f], [cx, cy], brown(k, 0.0, 0.0, 0.0)),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], brown(k1, k2, 0.0, 0.0)),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => {
            ([fx, fy], [cx, cy], brown(k1, k2, p1, p2))
        }
        ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]) => {
            ([fx, fy], [cx, cy], Distortion::BrownConrady { k1, k2, p1, p2, k3 })
        }
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => {
            ([fx, fy], [cx, cy], fisheye(k1, k2, k3, k4))
        }
        ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k]) => ([f, f], [cx, cy], fisheye(k, 0.0, 0.0, 0.0)),
        ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], fisheye(k1, k2, 0.0, 0.0)),
        _ => return Err(ColmapError::Lens(name.to_owned())),
    };
    let distortion = match distortion {
        // All coefficients zero: no distortion.
        Distortion::BrownConrady { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0 } => {
            Distortion::None
        }
        bent => bent,
    };
    let side = |v: u64| u32::try_from(v).unwrap_or(u32::MAX);
    let intrinsics = Intrinsics {
        width_px: side(width),
        height_px: side(height),
        fx_px: focal[0],
        fy_px: focal[1],
        cx_px: centre[0],
        cy_px: centre[1],
        distortion,
    };
    intrinsics.validate().map_err(|error| ColmapError::Damaged(error.to_string()))?;
    Ok(intrinsics)
}

/// Returns COLMAP's name of a lens model, and its parameters.
///
/// ```
/// use vizflyt_protocol::geometry::Intrinsics;
/// let k = Intrinsics::from_horizontal_fov(640, 480, std::f64::consts::FRAC_PI_2);
/// let (model, numbers) = vizflyt_twin::dataset::colmap::parameters(&k);
/// assert_eq!((model, numbers.len(), numbers[2]), ("PINHOLE", 4, 320.0));
/// ```
pub fn parameters(k: &Intrinsics) -> (&'static str, Vec<f64>) {
    let mut numbers = vec![k.fx_px, k.fy_px, k.cx_px, k.cy_px];
    let model = match k.distortion {
        Distortion::None => "PINHOLE",
        Distortion::BrownConrady { k1, k2, p1, p2, k3: 0.0 } => {
            numbers.extend([k1, k2, p1, p2]);
            "OPENCV"
        }
        Distortion::BrownConrady { k1, k2, p1, p2, k3 } => {
            numbers.extend([k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]);
            "FULL_OPENCV"
        }
        Distortion::KannalaBrandt { k1, k2, k3, k4 } => {
            numbers.extend([k1, k2, k3, k4]);
            "OPENCV_FISHEYE"
        }
    };
    (model, numbers)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_back_written_lens_parameters() {
        let plain = Intrinsics::from_horizontal_fov(640, 480, 1.2);
        for distortion in [
            Distortion::None,
            Distortion::BrownConrady { k1: -0.1, k2: 0.02, p1: 0.001, p2: -0.002, k3: 0.0 },
            Distortion::BrownConrady { k1: -0.1, k2: 0.02, p1: 0.001, p2: -0.002, k3: 0.03 },
            Distortion::KannalaBrandt { k1: 0.01, k2: 0.02, k3: -0.01, k4: 0.001 },
        ] {
            let k = Intrinsics { distortion, ..plain };
            let (model, numbers) = parameters(&k);
            assert_eq!(intrinsics(model, 640, 480, &numbers), Ok(k));
        }
        let bent = [500.0, 500.0, 320.0, 240.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0];
        assert!(intrinsics("FULL_OPENCV", 640, 480, &bent).is_err(), "k4 is not understood");
    }
}
