//! Poses with the names of their frames, intrinsics, volumes.

use numpy::PyArray1;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use vizflyt_sdk::glam::{DMat3, DQuat, DVec2, DVec3, DVec4};
use vizflyt_sdk::protocol::geometry::{Distortion, Frame, yaw_of};
use vizflyt_sdk::{Intrinsics as SdkIntrinsics, Pose as SdkPose, Volume as SdkVolume};

use crate::arguments::{Points, array_of, array3, quaternion, vector, wrong_type};

/// A rigid transform between two named frames. `world_from_body` converts body coordinates to world coordinates,
/// and is the pose of the body in the world.
///
/// Frames are 'world' (x east, y north, z up), 'body' (x forward, y left, z up) and 'cam' (x right, y down, z
/// forward). `@` composes poses. The inner frames must be the same: `world_from_body @ body_from_cam`.
///
/// `Pose(into, from_, translation_m, rotation_xyzw)` creates one for tests.
#[pyclass(frozen, module = "vizflyt", from_py_object)]
#[derive(Clone, PartialEq)]
pub(crate) struct Pose {
    into: String,
    from: String,
    translation_m: DVec3,
    rotation: DQuat,
}

impl Pose {
    /// Converts a pose of the SDK, with the names of its frames.
    pub(crate) fn new<A: Frame, B: Frame>(into: &str, from: &str, pose: &SdkPose<A, B>) -> Self {
        Self {
            into: into.to_owned(),
            from: from.to_owned(),
            translation_m: pose.translation_m,
            rotation: pose.rotation,
        }
    }

    /// Converts to a pose of the SDK, if the frames match.
    pub(crate) fn typed<A: Frame, B: Frame>(
        &self,
        into: &str,
        from: &str,
    ) -> PyResult<SdkPose<A, B>> {
        if (self.into.as_str(), self.from.as_str()) == (into, from) {
            return Ok(SdkPose::new(self.translation_m, self.rotation));
        }
        Err(PyValueError::new_err(format!(
            "expected {into}_from_{from}, got {}_from_{}",
            self.into, self.from
        )))
    }
}

#[pymethods]
impl Pose {
    #[new]
    #[pyo3(signature = (into, from_, translation_m, rotation_xyzw = None))]
    fn make(
        into: String,
        from_: String,
        translation_m: &Bound<'_, PyAny>,
        rotation_xyzw: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        for frame in [&into, &from_] {
            if !FRAMES.contains(&frame.as_str()) {
                return Err(PyValueError::new_err(format!(
                    "unknown frame '{frame}'; known frames: 'world' (x east, y north, z up), 'body' (x \
                     forward, y left, z up), 'cam' (x right, y down, z forward) and 'odom' (plugin's own, z up)"
                )));
            }
        }
        Ok(Self {
            into,
            from: from_,
            translation_m: vector(translation_m, "translation_m")?,
            rotation: rotation_xyzw
                .map_or(Ok(DQuat::IDENTITY), |value| quaternion(value, "rotation_xyzw"))?,
        })
    }

    /// Origin of the right frame in the left one: shape (3,), float64. [m]
    #[getter]
    fn translation_m<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array3(py, self.translation_m)
    }

    /// Unit quaternion x, y, z, w: shape (4,), float64.
    #[getter]
    fn rotation_xyzw<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.rotation.to_array())
    }

    /// Rotation as a matrix: shape (3, 3), float64.
    #[getter]
    fn rotation_matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let rows = DMat3::from_quat(self.rotation).transpose().to_cols_array();
        array_of(py, &rows, vec![3, 3])
    }

    /// Complete transform as a homogeneous matrix: shape (4, 4), float64.
    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (r, t) = (DMat3::from_quat(self.rotation), self.translation_m);
        let rows = [r.row(0).extend(t.x), r.row(1).extend(t.y), r.row(2).extend(t.z)];
        let mut flat: Vec<f64> = rows.iter().flat_map(DVec4::to_array).collect();
        flat.extend([0.0, 0.0, 0.0, 1.0]);
        array_of(py, &flat, vec![4, 4])
    }

    /// Heading: angle of the right frame's x axis about z, from x, counter-clockwise. [rad]
    #[getter]
    fn yaw_rad(&self) -> f64 {
        yaw_of(self.rotation)
    }

    /// Returns the inverse transform.
    fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self {
            into: self.from.clone(),
            from: self.into.clone(),
            translation_m: -(rotation * self.translation_m),
            rotation,
        }
    }

    /// Converts a point (3,) or points (N, 3) from the right frame to the left one. [m]
    fn transform_point<'py>(&self, points_m: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let points = Points::take(points_m, "points_m")?;
        points.vectors(points_m.py(), |p| self.rotation * p + self.translation_m)
    }

    /// Rotates a direction or velocity (3,), or many (N, 3), from the right frame to the left one.
    fn rotate<'py>(&self, vectors: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        Points::take(vectors, "vectors")?.vectors(vectors.py(), |v| self.rotation * v)
    }

    fn __matmul__(&self, other: &Bound<'_, PyAny>) -> PyResult<Self> {
        let Ok(other) = other.extract::<Self>() else {
            return Err(wrong_type(
                other,
                "the right operand of @",
                "a Pose (for points use transform_point, for directions rotate)",
            ));
        };
        if self.from != other.into {
            return Err(PyValueError::new_err(format!(
                "{0}_from_{1} @ {2}_from_{3}: the frames that meet, '{1}' and '{2}', must be the \
                 same; does one of them need .inverse()?",
                self.into, self.from, other.into, other.from
            )));
        }
        Ok(Self {
            into: self.into.clone(),
            from: other.from.clone(),
            translation_m: self.rotation * other.translation_m + self.translation_m,
            rotation: (self.rotation * other.rotation).normalize(),
        })
    }

    fn __eq__(&self, other: &Self) -> bool {
        self == other
    }

    fn __repr__(&self) -> String {
        let (t, [x, y, z, w]) = (self.translation_m, self.rotation.to_array());
        format!(
            "Pose({}_from_{}: translation_m=[{:.4}, {:.4}, {:.4}], rotation_xyzw=[{x:.5}, {y:.5}, \
             {z:.5}, {w:.5}])",
            self.into, self.from, t.x, t.y, t.z
        )
    }
}

const FRAMES: [&str; 5] = ["world", "body", "cam", "odom", "sensor"];

/// Size, focal lengths, principal point and lens of a camera.
///
/// Pixels are continuous: (0, 0) is the outer corner of the top-left pixel, (0.5, 0.5) is its centre.
#[pyclass(frozen, module = "vizflyt", from_py_object)]
#[derive(Clone, PartialEq)]
pub(crate) struct Intrinsics(pub(crate) SdkIntrinsics);

#[pymethods]
impl Intrinsics {
    #[new]
    fn make(
        width_px: u32,
        height_px: u32,
        fx_px: f64,
        fy_px: f64,
        cx_px: f64,
        cy_px: f64,
    ) -> PyResult<Self> {
        let distortion = Distortion::None;
        let k = SdkIntrinsics { width_px, height_px, fx_px, fy_px, cx_px, cy_px, distortion };
        k.validate().map_err(|error| PyValueError::new_err(error.to_string()))?;
        Ok(Self(k))
    }

    /// Creates a camera with square pixels, a centred principal point and this field of view. [px, rad]
    #[staticmethod]
    fn from_horizontal_fov(width_px: u32, height_px: u32, fov_rad: f64) -> PyResult<Self> {
        let k = SdkIntrinsics::from_horizontal_fov(width_px, height_px, fov_rad);
        k.validate().map_err(|error| PyValueError::new_err(error.to_string()))?;
        Ok(Self(k))
    }

    /// Image width. [px]
    #[getter]
    fn width_px(&self) -> u32 {
        self.0.width_px
    }

    /// Image height. [px]
    #[getter]
    fn height_px(&self) -> u32 {
        self.0.height_px
    }

    /// Focal length along x. [px]
    #[getter]
    fn fx_px(&self) -> f64 {
        self.0.fx_px
    }

    /// Focal length along y. [px]
    #[getter]
    fn fy_px(&self) -> f64 {
        self.0.fy_px
    }

    /// Principal point, x; the image's centre is `width_px / 2`. [px]
    #[getter]
    fn cx_px(&self) -> f64 {
        self.0.cx_px
    }

    /// Principal point, y. [px]
    #[getter]
    fn cy_px(&self) -> f64 {
        self.0.cy_px
    }

    /// Lens model: 'none', 'brown_conrady' (OpenCV's standard model) or 'kannala_brandt' (its fisheye model).
    #[getter]
    fn distortion_model(&self) -> &'static str {
        match self.0.distortion {
            Distortion::None => "none",
            Distortion::BrownConrady { .. } => "brown_conrady",
            Distortion::KannalaBrandt { .. } => "kannala_brandt",
        }
    }

    /// Distortion coefficients in OpenCV's order: shape (0,), (5,) or (4,), float64.
    #[getter]
    fn distortion<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        let (_, coefficients) = self.0.distortion.to_wire();
        let used = match self.0.distortion {
            Distortion::None => 0,
            Distortion::BrownConrady { .. } => 5,
            Distortion::KannalaBrandt { .. } => 4,
        };
        PyArray1::from_slice(py, &coefficients[..used])
    }

    /// Camera matrix: shape (3, 3), float64. [px]
    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let k = &self.0;
        let rows = [k.fx_px, 0.0, k.cx_px, 0.0, k.fy_px, k.cy_px, 0.0, 0.0, 1.0];
        array_of(py, &rows, vec![3, 3])
    }

    /// Camera matrix for OpenCV, where (0, 0) is the centre of the top-left pixel: the principal point is
    /// smaller by half a pixel. Shape (3, 3), float64. [px]
    #[getter]
    fn opencv_matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        // OpenCV puts (0, 0) at the centre of the top-left pixel, VizFlyt at its outer corner.
        let k = &self.0;
        let rows = [k.fx_px, 0.0, k.cx_px - 0.5, 0.0, k.fy_px, k.cy_px - 0.5, 0.0, 0.0, 1.0];
        array_of(py, &rows, vec![3, 3])
    }

    /// Returns the pixel of a point (3,) [m, cam]: shape (2,) [px]. For points (N, 3), shape (N, 2). NaN for
    /// points behind the camera or outside the range of the lens model.
    fn project<'py>(
        &self,
        py: Python<'py>,
        p_cam_m: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let points = Points::take(p_cam_m, "p_cam_m")?;
        let off = DVec2::NAN;
        let found: Vec<f64> = points
            .points
            .iter()
            .flat_map(|&p| self.0.project(p).unwrap_or(off).to_array())
            .collect();
        let shape = if points.is_single() { vec![2] } else { vec![points.points.len(), 2] };
        array_of(py, &found, shape)
    }

    fn __eq__(&self, other: &Self) -> bool {
        self == other
    }

    fn __repr__(&self) -> String {
        let k = &self.0;
        format!(
            "Intrinsics({}x{} px, fx {:.2}, fy {:.2}, cx {:.2}, cy {:.2}, distortion {})",
            k.width_px,
            k.height_px,
            k.fx_px,
            k.fy_px,
            k.cx_px,
            k.cy_px,
            self.distortion_model()
        )
    }
}

/// A solid volume in the world frame: sphere, box, capsule or half space.
#[pyclass(frozen, module = "vizflyt", from_py_object)]
#[derive(Clone, PartialEq)]
pub(crate) struct Volume(pub(crate) SdkVolume);

#[pymethods]
impl Volume {
    /// Creates a sphere. [m, world]
    #[staticmethod]
    fn sphere(center_m: &Bound<'_, PyAny>, radius_m: f64) -> PyResult<Self> {
        Ok(Self(SdkVolume::Sphere { center_m: vector(center_m, "center_m")?, radius_m }))
    }

    /// Creates a box from two opposite corners, with its sides along the axes. [m, world]
    #[staticmethod]
    fn aabb(min_m: &Bound<'_, PyAny>, max_m: &Bound<'_, PyAny>) -> PyResult<Self> {
        Ok(Self(SdkVolume::aabb(vector(min_m, "min_m")?, vector(max_m, "max_m")?)))
    }

    /// Returns the distance of a point (3,), or of points (N, 3), from the surface; negative inside. A float or
    /// shape (N,), float64. [m, world]
    fn signed_distance_m<'py>(&self, p_world_m: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let points = Points::take(p_world_m, "p_world_m")?;
        points.scalars(p_world_m.py(), |p| self.0.signed_distance_m(p))
    }

    fn __eq__(&self, other: &Self) -> bool {
        self == other
    }

    fn __repr__(&self) -> String {
        format!("Volume({:?})", self.0)
    }
}
