//! Description of the arena: `ArenaInfo`, cameras and limits.

use numpy::PyArray1;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::protocol::geometry::body_from_forward_cam;
use vizflyt_sdk::protocol::messages::{MAX_CAMERAS, MAX_NO_FLY, PoseAges, bounded};
use vizflyt_sdk::protocol::sensor::MAX_SENSORS;
use vizflyt_sdk::{
    ArenaInfo as SdkArenaInfo, CameraInfo as SdkCameraInfo, Limits as SdkLimits, SetpointKind,
    SetpointKinds,
};
use vizflyt_sdk::{Body, Cam};

use crate::arguments::{array3, vector};
use crate::geometry::{Intrinsics, Pose, Volume};
use crate::sensor::SensorInfo;

/// One camera of the vehicle.
///
/// `CameraInfo(name, intrinsics, body_from_cam=None)` creates one for tests. Without `body_from_cam` it looks
/// forward.
#[pyclass(frozen, module = "vizflyt", from_py_object)]
#[derive(Clone, PartialEq)]
pub(crate) struct CameraInfo(pub(crate) SdkCameraInfo);

#[pymethods]
impl CameraInfo {
    #[new]
    #[pyo3(signature = (name, intrinsics, body_from_cam = None))]
    fn make(name: &str, intrinsics: Intrinsics, body_from_cam: Option<Pose>) -> PyResult<Self> {
        let body_from_cam = match body_from_cam {
            Some(pose) => pose.typed::<Body, Cam>("body", "cam")?,
            None => body_from_forward_cam(DVec3::ZERO, 0.0),
        };
        Ok(Self(SdkCameraInfo { name: bounded(name), intrinsics: intrinsics.0, body_from_cam }))
    }

    /// Name of the camera, the argument of `obs.camera(name)`.
    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }

    /// Size, focal lengths, principal point, lens.
    #[getter]
    fn intrinsics(&self) -> Intrinsics {
        Intrinsics(self.0.intrinsics)
    }

    /// Pose of the camera on the body.
    #[getter]
    fn body_from_cam(&self) -> Pose {
        Pose::new("body", "cam", &self.0.body_from_cam)
    }

    fn __repr__(&self) -> String {
        let k = &self.0.intrinsics;
        format!("CameraInfo({:?}, {}x{} px)", self.0.name.as_str(), k.width_px, k.height_px)
    }
}

/// Limits that the guard enforces on every setpoint.
#[pyclass(frozen, module = "vizflyt", from_py_object)]
#[derive(Clone, PartialEq)]
pub(crate) struct Limits(SdkLimits);

#[pymethods]
impl Limits {
    #[new]
    #[pyo3(signature = (
        *, max_speed_mps, max_acceleration_mps2, max_tilt_deg = None, max_altitude_m = None
    ))]
    fn make(
        max_speed_mps: f64,
        max_acceleration_mps2: f64,
        max_tilt_deg: Option<f64>,
        max_altitude_m: Option<f64>,
    ) -> Self {
        Self(SdkLimits { max_speed_mps, max_acceleration_mps2, max_tilt_deg, max_altitude_m })
    }

    /// Maximum speed. [m/s]
    #[getter]
    fn max_speed_mps(&self) -> f64 {
        self.0.max_speed_mps
    }

    /// Maximum acceleration; the guard also assumes it for stopping. [m/s^2]
    #[getter]
    fn max_acceleration_mps2(&self) -> f64 {
        self.0.max_acceleration_mps2
    }

    /// Maximum tilt from level; None if only the acceleration limits it. [deg]
    #[getter]
    fn max_tilt_deg(&self) -> Option<f64> {
        self.0.max_tilt_deg
    }

    /// Maximum height of the body's centre; None if only the geofence limits it. [m, world]
    #[getter]
    fn max_altitude_m(&self) -> Option<f64> {
        self.0.max_altitude_m
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.0)
    }
}

/// Description of the arena in which the plugin flies.
///
/// `ArenaInfo(goal_m=[5, 0, 1], ...)` creates one for tests; every keyword has a default.
#[pyclass(frozen, module = "vizflyt")]
#[derive(Clone, PartialEq)]
pub(crate) struct ArenaInfo(pub(crate) SdkArenaInfo);

#[pymethods]
impl ArenaInfo {
    #[new]
    #[pyo3(signature = (
        *, name = "test", geofence = None, no_fly = Vec::new(), floor_z_m = 0.0, limits = None, body_radius_m = 0.12, takeoff_height_m = 1.0,
        goal_m = None, goal_radius_m = 1.0, time_limit_s = 0.0, start_box = None, ground_truth = true,
        attitude_rate = false, setpoints = None, cameras = Vec::new(), sensors = Vec::new()
    ))]
    #[allow(clippy::too_many_arguments)] // Why: all are Python keywords.
    fn make(
        name: &str,
        geofence: Option<Volume>,
        no_fly: Vec<Volume>,
        floor_z_m: f64,
        limits: Option<Limits>,
        body_radius_m: f64,
        takeoff_height_m: f64,
        goal_m: Option<&Bound<'_, PyAny>>,
        goal_radius_m: f64,
        time_limit_s: f64,
        start_box: Option<Volume>,
        ground_truth: bool,
        attitude_rate: bool,
        setpoints: Option<Vec<String>>,
        cameras: Vec<CameraInfo>,
        sensors: Vec<SensorInfo>,
    ) -> PyResult<Self> {
        if no_fly.len() > MAX_NO_FLY {
            return Err(PyValueError::new_err(format!(
                "an arena has at most {MAX_NO_FLY} no-fly boxes, not {}",
                no_fly.len()
            )));
        }
        let mut kinds = match setpoints {
            Some(names) => names.iter().map(|name| kind(name)).collect::<PyResult<_>>()?,
            None => SetpointKinds::USUAL,
        };
        if attitude_rate {
            kinds = kinds.with(SetpointKind::AttitudeRate);
        }
        if cameras.len() > MAX_CAMERAS {
            return Err(PyValueError::new_err(format!(
                "a vehicle has at most {MAX_CAMERAS} cameras, not {}",
                cameras.len()
            )));
        }
        if sensors.len() > MAX_SENSORS {
            return Err(PyValueError::new_err(format!(
                "a vehicle has at most {MAX_SENSORS} sensors in addition to its cameras, not {}",
                sensors.len()
            )));
        }
        let everywhere = vizflyt_sdk::Volume::Sphere { center_m: DVec3::ZERO, radius_m: 1000.0 };
        let usual = SdkLimits::new(5.0, 5.0);
        Ok(Self(SdkArenaInfo {
            name: bounded(name),
            geofence: geofence.map_or(everywhere, |volume| volume.0),
            no_fly: no_fly.into_iter().map(|volume| volume.0).collect(),
            floor_z_m,
            limits: limits.map_or(usual, |limits| limits.0),
            body_radius_m,
            takeoff_height_m,
            goal_m: goal_m.map(|goal_m| vector(goal_m, "goal_m")).transpose()?,
            goal_radius_m,
            time_limit_s,
            start_box: start_box.map(|volume| volume.0),
            ground_truth,
            pose_ages: PoseAges::default(),
            setpoints: kinds,
            cameras: cameras.into_iter().map(|camera| camera.0).collect(),
            sensors: sensors.into_iter().map(|sensor| sensor.0).collect(),
        }))
    }

    /// Name of the arena.
    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }

    /// Volume in which the body's surface must stay. [world]
    #[getter]
    fn geofence(&self) -> Volume {
        Volume(self.0.geofence)
    }

    /// Volumes that the body's surface must not enter. [world]
    #[getter]
    fn no_fly(&self) -> Vec<Volume> {
        self.0.no_fly.iter().copied().map(Volume).collect()
    }

    /// Height of the floor. [m, world]
    #[getter]
    fn floor_z_m(&self) -> f64 {
        self.0.floor_z_m
    }

    /// Limits of motion.
    #[getter]
    fn limits(&self) -> Limits {
        Limits(self.0.limits)
    }

    /// Radius of the sphere that encloses the vehicle. [m]
    #[getter]
    fn body_radius_m(&self) -> f64 {
        self.0.body_radius_m
    }

    /// Height above the start to which the runtime climbs before the plugin gets control. [m]
    #[getter]
    fn takeoff_height_m(&self) -> f64 {
        self.0.takeoff_height_m
    }

    /// Goal of the flight: shape (3,), float64; None if the course has no goal. [m, world]
    #[getter]
    fn goal_m<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<f64>>> {
        self.0.goal_m.map(|goal_m| array3(py, goal_m))
    }

    /// Distance at which the goal counts as reached. [m]
    #[getter]
    fn goal_radius_m(&self) -> f64 {
        self.0.goal_radius_m
    }

    /// Time limit from take-off; 0 means no limit. [s]
    #[getter]
    fn time_limit_s(&self) -> f64 {
        self.0.time_limit_s
    }

    /// Box in which a flight begins; None if anywhere. [world]
    #[getter]
    fn start_box(&self) -> Option<Volume> {
        self.0.start_box.map(Volume)
    }

    /// Whether the plugin receives the vehicle's pose and velocity.
    #[getter]
    fn ground_truth(&self) -> bool {
        self.0.ground_truth
    }

    /// Whether `Setpoint.attitude_rate` is allowed.
    #[getter]
    fn attitude_rate(&self) -> bool {
        self.0.setpoints.contains(SetpointKind::AttitudeRate)
    }

    /// Allowed kinds of setpoint, of 'position', 'velocity', 'acceleration', 'offset', 'attitude_rate' and
    /// 'trajectory'. hold, land and take_off are always allowed.
    #[getter]
    fn setpoints(&self) -> Vec<&'static str> {
        self.0.setpoints.iter().map(SetpointKind::name).collect()
    }

    /// Cameras of the vehicle.
    #[getter]
    fn cameras(&self) -> Vec<CameraInfo> {
        self.0.cameras.iter().cloned().map(CameraInfo).collect()
    }

    /// Sensors of the vehicle other than cameras.
    #[getter]
    fn sensors(&self) -> Vec<SensorInfo> {
        self.0.sensors.iter().cloned().map(SensorInfo).collect()
    }

    fn __repr__(&self) -> String {
        let cameras: Vec<&str> = self.0.cameras.iter().map(|camera| camera.name.as_str()).collect();
        format!(
            "ArenaInfo({:?}, goal_m={:?}, cameras={cameras:?})",
            self.0.name.as_str(),
            self.0.goal_m.map(|goal_m| goal_m.to_array())
        )
    }
}

/// Returns every obstacle of the course, or None if the course does not give the map. [world]
///
/// Raises ValueError if the map cannot be read.
#[pyfunction]
pub(crate) fn course_map() -> PyResult<Option<Vec<Volume>>> {
    let map = vizflyt_sdk::map().map_err(|error| PyValueError::new_err(error.to_string()))?;
    Ok(map.map(|volumes| volumes.into_iter().map(Volume).collect()))
}

/// Returns the kind of setpoint with this name.
fn kind(name: &str) -> PyResult<SetpointKind> {
    let known = SetpointKind::ALL.into_iter().find(|kind| kind.name() == name);
    known.ok_or_else(|| {
        let all = SetpointKinds::ALL;
        PyValueError::new_err(format!("unknown kind of setpoint {name:?}; known kinds: {all}"))
    })
}
