//! nerfstudio's transforms.json (docs.nerf.studio, "Data conventions").
//!
//! `transform_matrix` transforms from the camera to the world, with OpenGL's camera axes: x right, y up, z backward.

use glam::{DMat3, DQuat, DVec3};
use serde::Deserialize;
use vizflyt_protocol::geometry::{Cam, Distortion, Intrinsics, Pose, World};

/// Contents of transforms.json.
#[derive(Clone, Debug, PartialEq)]
pub struct Transforms {
    /// Images in the order of the file.
    pub frames: Vec<Frame>,
    /// File of points, relative to the dataset.
    pub points: Option<String>,
}

/// An image and its files, relative to the dataset.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Image file.
    pub file: String,
    /// 8-bit mask; pixels with 0 are ignored.
    pub mask: Option<String>,
    /// 16-bit image of camera-z depths.
    pub depth: Option<String>,
    /// Size of a step of the depth image. [units of the dataset]
    pub depth_step: f32,
    /// Lens; `Err` is a horizontal field of view [rad], which needs the image's size.
    pub intrinsics: Result<Intrinsics, f64>,
    /// Pose of the camera.
    pub world_from_cam: Pose<World, Cam>,
}

/// Why a text is not a valid transforms.json.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TransformsError {
    /// Invalid JSON, or a value out of range.
    #[error("{0}")]
    Damaged(String),
    /// Unsupported lens.
    #[error("camera model {0} is not understood")]
    Lens(String),
}

#[derive(Debug, Deserialize)]
struct File {
    #[serde(flatten)]
    lens: Lens,
    frames: Vec<FrameEntry>,
    ply_file_path: Option<String>,
    depth_unit_scale_factor: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct FrameEntry {
    #[serde(flatten)]
    lens: Lens,
    file_path: String,
    mask_path: Option<String>,
    depth_file_path: Option<String>,
    transform_matrix: Vec<Vec<f64>>,
}

/// Lens parameters, for all images or for one.
#[derive(Clone, Debug, Default, Deserialize)]
struct Lens {
    camera_model: Option<String>,
    camera_angle_x: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

/// Reads a transforms.json.
pub fn parse(text: &str) -> Result<Transforms, TransformsError> {
    let file: File = serde_json::from_str(text).map_err(|error| {
        TransformsError::Damaged(format!(
            "{error}; it needs frames, each with file_path and transform_matrix (4 x 4)"
        ))
    })?;
    let depth_step = file.depth_unit_scale_factor.unwrap_or(1e-3) as f32;
    if !(depth_step.is_finite() && depth_step > 0.0) {
        let what = format!("depth_unit_scale_factor is {depth_step}, not above 0");
        return Err(TransformsError::Damaged(what));
    }
    let frames = file.frames.iter().map(|entry| {
        let damaged =
            |what: String| TransformsError::Damaged(format!("frame {}: {what}", entry.file_path));
        let lens = entry.lens.clone().or(&file.lens);
        let intrinsics = lens.intrinsics().map_err(|error| match error {
            TransformsError::Damaged(what) => damaged(what),
            lens @ TransformsError::Lens(_) => lens,
        })?;
        let world_from_cam = pose(&entry.transform_matrix).map_err(damaged)?;
        Ok(Frame {
            file: entry.file_path.clone(),
            mask: entry.mask_path.clone(),
            depth: entry.depth_file_path.clone(),
            depth_step,
            intrinsics,
            world_from_cam,
        })
    });
    let frames = frames.collect::<Result<_, TransformsError>>()?;
    Ok(Transforms { frames, points: file.ply_file_path })
}

impl Lens {
    fn or(self, all: &Self) -> Self {
        Self {
            camera_model: self.camera_model.or_else(|| all.camera_model.clone()),
            camera_angle_x: self.camera_angle_x.or(all.camera_angle_x),
            fl_x: self.fl_x.or(all.fl_x),
            fl_y: self.fl_y.or(all.fl_y),
            cx: self.cx.or(all.cx),
            cy: self.cy.or(all.cy),
            w: self.w.or(all.w),
            h: self.h.or(all.h),
            k1: self.k1.or(all.k1),
            k2: self.k2.or(all.k2),
            k3: self.k3.or(all.k3),
            k4: self.k4.or(all.k4),
            p1: self.p1.or(all.p1),
            p2: self.p2.or(all.p2),
        }
    }

    fn intrinsics(&self) -> Result<Result<Intrinsics, f64>, TransformsError> {
        let damaged = |what: &str| TransformsError::Damaged(what.to_owned());
        let k = |value: Option<f64>| value.unwrap_or(0.0);
        let (k1, k2, k3, k4) = (k(self.k1), k(self.k2), k(self.k3), k(self.k4));
        let (p1, p2) = (k(self.p1), k(self.p2));
        let bent = [k1, k2, k3, p1, p2].iter().any(|&v| v != 0.0);
        let distortion = match self.camera_model.as_deref().unwrap_or("OPENCV") {
            "OPENCV_FISHEYE" | "fisheye" => Distortion::KannalaBrandt { k1, k2, k3, k4 },
            "OPENCV" | "SIMPLE_RADIAL" | "RADIAL" | "perspective" if bent => {
                // A fourth radial coefficient would be another model.
                if k4 != 0.0 {
                    return Err(TransformsError::Lens("OPENCV with k4".to_owned()));
                }
                Distortion::BrownConrady { k1, k2, p1, p2, k3 }
            }
            "OPENCV" | "SIMPLE_RADIAL" | "RADIAL" | "perspective" | "PINHOLE"
            | "SIMPLE_PINHOLE" => Distortion::None,
            other => return Err(TransformsError::Lens(other.to_owned())),
        };
        let Some(fx_px) = self.fl_x else {
            return match self.camera_angle_x {
                Some(angle) if (1e-3..3.1).contains(&angle) => Ok(Err(angle)),
                Some(angle) => {
                    Err(damaged(&format!("camera_angle_x is {angle}, not 0.001 to 3.1 rad")))
                }
                None => Err(damaged("neither fl_x nor camera_angle_x gives the field of view")),
            };
        };
        let (Some(w), Some(h)) = (self.w, self.h) else {
            return Err(damaged("w and h, the image's size in pixels, are missing"));
        };
        let intrinsics = Intrinsics {
            width_px: w as u32,
            height_px: h as u32,
            fx_px,
            fy_px: self.fl_y.unwrap_or(fx_px),
            cx_px: self.cx.unwrap_or(w / 2.0),
            cy_px: self.cy.unwrap_or(h / 2.0),
            distortion,
        };
        intrinsics.validate().map_err(|error| damaged(&error.to_string()))?;
        Ok(Ok(intrinsics))
    }
}

/// Returns the pose from a matrix of OpenGL's camera to the world.
fn pose(matrix: &[Vec<f64>]) -> Result<Pose<World, Cam>, String> {
    let rows: Vec<[f64; 4]> =
        matrix.iter().take(3).filter_map(|row| <[f64; 4]>::try_from(row.as_slice()).ok()).collect();
    let [x, y, z] = rows.as_slice() else {
        return Err("transform_matrix is not 4 x 4".to_owned());
    };
    let column = |k: usize| DVec3::new(x[k], y[k], z[k]);
    // From OpenGL's axes to x right, y down, z forward.
    let axes = DMat3::from_cols(column(0), -column(1), -column(2));
    let off = axes.transpose() * axes - DMat3::IDENTITY;
    let worst = off.to_cols_array().into_iter().fold(0.0, |a: f64, b| a.max(b.abs()));
    let position = column(3);
    if !(worst < 0.01
        && axes.determinant() > 0.0
        && position.is_finite()
        && position.length() < 1e7)
    {
        return Err(
            "transform_matrix is not a rotation and position; does it contain a scale?".to_owned()
        );
    }
    Ok(Pose::new(position, DQuat::from_mat3(&axes).normalize()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = r#"{"camera_model": "OPENCV", "fl_x": 200.0, "fl_y": 201.0, "cx": 160, "cy": 120, "w": 320,
        "h": 240, "k1": 0.1, "p2": 0.01, "ply_file_path": "points.ply", "applied_transform": [[1, 0, 0, 0]],
        "frames": [{"file_path": "images/a.png", "depth_file_path": "depth/a.png",
            "transform_matrix": [[1, 0, 0, 5], [0, 0, -1, 6], [0, 1, 0, 7], [0, 0, 0, 1]]}]}"#;

    #[test]
    fn converts_axes_from_opengl() {
        let transforms = parse(TEXT).unwrap();
        let frame = &transforms.frames[0];
        // OpenGL's camera looks along its -z, which is +y of this world; its y is the world's z.
        let ahead = frame.world_from_cam.transform_point(DVec3::Z);
        let below = frame.world_from_cam.transform_point(DVec3::Y);
        assert!((ahead - DVec3::new(5.0, 7.0, 7.0)).length() < 1e-12);
        assert!((below - DVec3::new(5.0, 6.0, 6.0)).length() < 1e-12);
        let k = frame.intrinsics.unwrap();
        assert_eq!((k.fx_px, k.cy_px), (200.0, 120.0));
        assert_eq!(
            k.distortion,
            Distortion::BrownConrady { k1: 0.1, k2: 0.0, p1: 0.0, p2: 0.01, k3: 0.0 }
        );
        assert_eq!((transforms.points.as_deref(), frame.depth_step), (Some("points.ply"), 0.001));
    }

    #[test]
    fn error_names_the_fault() {
        let check = |from: &str, to: &str, says: &str| {
            let error = parse(&TEXT.replace(from, to)).unwrap_err().to_string();
            assert!(error.contains(says), "{error}");
        };
        check("\"OPENCV\"", "\"EQUIRECTANGULAR\"", "EQUIRECTANGULAR");
        check("\"fl_x\": 200.0,", "", "camera_angle_x");
        check("\"w\": 320,", "", "w and h");
        check("[1, 0, 0, 5]", "[2, 0, 0, 5]", "scale");
        check("[0, 1, 0, 7],", "", "transform_matrix");
        check("\"file_path\"", "\"path\"", "file_path");
        check("200.0", "-200.0", "focal length");
    }
}
