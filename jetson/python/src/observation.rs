//! Input of a plugin: observation, camera images, vehicle state, IMU and battery.

use std::ops::Range;
use std::sync::Arc;

use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods};
use pyo3::exceptions::{PyIndexError, PyLookupError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use vizflyt_sdk::glam::{DQuat, DVec3};
use vizflyt_sdk::protocol::geometry::yaw_of;
use vizflyt_sdk::protocol::packet::ObservationHeader;
use vizflyt_sdk::{
    Battery as SdkBattery, CameraImage as SdkCameraImage, HostTime, ImuSample as SdkImuSample,
    Intrinsics as SdkIntrinsics, Observation as SdkObservation, Pose as SdkPose,
    Vehicle as SdkVehicle,
};
use vizflyt_sdk::{Body, Cam, World};

use crate::arguments::{array3, quaternion, vector};
use crate::geometry::{Intrinsics, Pose};
use crate::sensor::SensorReading;
use crate::shared_memory::{Memory, depth_array, rgb_array};

/// The vehicle and the images of its cameras at one moment.
///
/// Images lie in shared memory and are not copied. Images that you keep after `on_image` do not change. If you
/// keep more than the newest two, later images are copied, with a warning.
#[pyclass(frozen, module = "vizflyt")]
pub(crate) struct Observation {
    memory: Arc<Memory>,
    /// Number of the observation in this flight; missing numbers were skipped.
    #[pyo3(get)]
    seq: u64,
    /// Measurement time of the newest image's pose. [ns, `time.monotonic_ns()`]
    #[pyo3(get)]
    stamp_ns: u64,
    vehicle: Option<Py<Vehicle>>,
    imu: Vec<SdkImuSample>,
    battery: SdkBattery,
    images: Vec<Py<CameraImage>>,
    readings: Vec<Py<SensorReading>>,
    /// Names of all sensors, with or without a reading.
    sensor_names: Vec<String>,
}

/// RGB-D image of one camera. Row 0 is the top; index arrays as [y, x].
#[pyclass(frozen, module = "vizflyt")]
pub(crate) struct CameraImage {
    memory: Arc<Memory>,
    rgb_at: usize,
    depth_at: usize,
    /// Name of the camera in `arena.toml`, for example 'front'.
    #[pyo3(get)]
    name: String,
    /// Server tick that rendered the image; equal for all cameras of a tick.
    #[pyo3(get)]
    seq: u64,
    /// Measurement time of the newest pose behind the image. [ns, `time.monotonic_ns()`]
    #[pyo3(get)]
    stamp_ns: u64,
    /// Instant that the image shows, which is about now. To combine depth with the vehicle's pose, use the pose
    /// at this instant. [ns, `time.monotonic_ns()`]
    #[pyo3(get)]
    shown_ns: u64,
    /// Time at which the runtime had decoded the image. [ns, `time.monotonic_ns()`]
    #[pyo3(get)]
    ready_ns: u64,
    intrinsics: SdkIntrinsics,
    body_from_cam: SdkPose<Body, Cam>,
    pose_at_image: Option<SdkPose<World, Body>>,
    /// Created on first access.
    depth: PyOnceLock<Py<PyArray2<f32>>>,
}

/// State of the vehicle.
///
/// `Vehicle(world_from_body, v_world_mps, omega_body_radps, ...)` creates one for tests.
#[pyclass(frozen, module = "vizflyt", from_py_object)]
#[derive(Clone)]
pub(crate) struct Vehicle(pub(crate) SdkVehicle);

impl Observation {
    /// Reads the observation in `memory`, without IMU samples that the plugin already has.
    ///
    /// # Errors
    /// If the memory contains no valid observation.
    pub(crate) fn new(py: Python<'_>, memory: Memory, imu_after: HostTime) -> PyResult<Self> {
        let memory = Arc::new(memory);
        let seen = SdkObservation::from_bytes(memory.bytes(), &memory.names)
            .map_err(|error| PyValueError::new_err(error.to_string()))?
            .with_imu_after(imu_after);
        let images = seen
            .cameras()
            .map(|image| Py::new(py, CameraImage::new(&memory, &image)))
            .collect::<PyResult<_>>()?;
        let header = ObservationHeader::parse(memory.bytes())
            .map_err(|error| PyValueError::new_err(error.to_string()))?;
        let table = header.sensors(memory.bytes());
        let sensor_names = table.iter().map(|sensor| sensor.name().to_owned()).collect();
        let mut readings = Vec::new();
        for (sensor, reading) in table.iter().filter(|sensor| sensor.seq > 0).zip(seen.sensors()) {
            let place = (sensor.records_offset as usize, sensor.record_count as usize);
            readings.push(Py::new(py, SensorReading::new(&memory, &reading, place))?);
        }
        let vehicle = seen.vehicle().map(|vehicle| Py::new(py, Vehicle(vehicle))).transpose()?;
        let (imu, battery) = (seen.imu().collect(), seen.battery());
        let (seq, stamp_ns) = (seen.seq(), seen.stamp().as_ns());
        Ok(Self { memory, seq, stamp_ns, vehicle, imu, battery, images, readings, sensor_names })
    }

    /// Returns the measurement time of the newest IMU sample.
    pub(crate) fn newest_imu(&self) -> Option<HostTime> {
        self.imu.last().map(|sample| sample.stamp)
    }
}

#[pymethods]
impl Observation {
    /// Returns the image of the camera with this name; None if there is no image yet.
    ///
    /// Raises LookupError if the vehicle has no such camera.
    fn camera(&self, py: Python<'_>, name: &str) -> PyResult<Option<Py<CameraImage>>> {
        if let Some(image) = self.images.iter().find(|image| image.get().name == name) {
            return Ok(Some(image.clone_ref(py)));
        }
        if self.memory.names.iter().any(|known| known == name) {
            return Ok(None);
        }
        let known: Vec<String> =
            self.memory.names.iter().map(|known| format!("'{known}'")).collect();
        Err(PyLookupError::new_err(format!(
            "there is no camera '{name}'; this vehicle has {}",
            if known.is_empty() { "none".to_owned() } else { known.join(", ") }
        )))
    }

    /// Returns the newest reading of the sensor with this name; None if there is no reading yet.
    ///
    /// Raises LookupError if the vehicle has no such sensor.
    fn sensor(&self, py: Python<'_>, name: &str) -> PyResult<Option<Py<SensorReading>>> {
        if let Some(reading) = self.readings.iter().find(|reading| reading.get().is(name)) {
            return Ok(Some(reading.clone_ref(py)));
        }
        if self.sensor_names.iter().any(|known| known == name) {
            return Ok(None);
        }
        let known: Vec<String> =
            self.sensor_names.iter().map(|known| format!("'{known}'")).collect();
        Err(PyLookupError::new_err(format!(
            "there is no sensor '{name}'; this vehicle has {}",
            if known.is_empty() { "none".to_owned() } else { known.join(", ") }
        )))
    }

    /// Newest available readings, in the order of the arena's sensors.
    #[getter]
    fn sensors(&self, py: Python<'_>) -> Vec<Py<SensorReading>> {
        self.readings.iter().map(|reading| reading.clone_ref(py)).collect()
    }

    /// Available images, in the order of the arena's cameras.
    #[getter]
    fn cameras(&self, py: Python<'_>) -> Vec<Py<CameraImage>> {
        self.images.iter().map(|image| image.clone_ref(py)).collect()
    }

    /// Pose of the body at the instant that the newest image shows, which belongs to its pixels. None without an
    /// image, and if the course withholds the pose. [m, world]
    #[getter]
    fn pose_at_image(&self) -> Option<Pose> {
        let newest = self.images.iter().max_by_key(|image| image.get().shown_ns)?;
        newest.get().pose_at_image()
    }

    /// State of the vehicle; None before the first one.
    #[getter]
    fn vehicle(&self, py: Python<'_>) -> Option<Py<Vehicle>> {
        self.vehicle.as_ref().map(|vehicle| vehicle.clone_ref(py))
    }

    /// IMU samples of the autopilot since the plugin's previous image, oldest first. At most the newest 64 (0.6
    /// s at 100 Hz).
    #[getter]
    fn imu(&self) -> Vec<ImuSample> {
        self.imu.iter().copied().map(ImuSample).collect()
    }

    /// State of the battery.
    #[getter]
    fn battery(&self) -> Battery {
        Battery(self.battery)
    }

    /// Whether the images are copies, because the plugin keeps too many earlier ones.
    #[getter]
    fn is_copy(&self) -> bool {
        self.memory.is_copy()
    }

    fn __repr__(&self) -> String {
        let cameras: Vec<&str> =
            self.images.iter().map(|image| image.get().name.as_str()).collect();
        let vehicle = if self.vehicle.is_some() { "with" } else { "without" };
        format!("Observation(seq={}, cameras={cameras:?}, {vehicle} vehicle)", self.seq)
    }
}

impl CameraImage {
    /// Returns the memory that this image keeps alive and unchanged.
    pub(crate) fn memory(&self) -> &Memory {
        &self.memory
    }

    fn new(memory: &Arc<Memory>, image: &SdkCameraImage<'_>) -> Self {
        let start = memory.bytes().as_ptr() as usize;
        Self {
            memory: Arc::clone(memory),
            rgb_at: image.rgb.as_ptr() as usize - start,
            depth_at: image.depth_mm.as_ptr() as usize - start,
            name: image.name.to_owned(),
            seq: image.seq,
            stamp_ns: image.stamp.as_ns(),
            shown_ns: image.shown.as_ns(),
            ready_ns: image.ready.as_ns(),
            intrinsics: image.intrinsics,
            body_from_cam: image.body_from_cam,
            pose_at_image: image.pose_at_image,
            depth: PyOnceLock::new(),
        }
    }

    fn shape(&self) -> (usize, usize) {
        (self.intrinsics.height_px as usize, self.intrinsics.width_px as usize)
    }

    fn depth_plane(&self) -> Range<usize> {
        self.depth_at..self.depth_at + 2 * self.intrinsics.pixels()
    }
}

#[pymethods]
impl CameraImage {
    /// Colour: a read-only view of shape (H, W, 3), uint8, sRGB, in the order red, green, blue.
    ///
    /// For OpenCV, convert it with `cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)`.
    #[getter]
    fn rgb<'py>(slf: &Bound<'py, Self>) -> Bound<'py, PyArray3<u8>> {
        let image = slf.get();
        rgb_array(slf, image.rgb_at, image.shape())
    }

    /// Depth along the optical axis: a read-only view of shape (H, W), uint16; 0: no return. [mm, cam]
    #[getter]
    fn depth_mm<'py>(slf: &Bound<'py, Self>) -> Bound<'py, PyArray2<u16>> {
        let image = slf.get();
        depth_array(slf, image.depth_at, image.shape())
    }

    /// Depth along the optical axis: read-only, shape (H, W), float32; 0 means no return. [m, cam]
    ///
    /// Converted from `depth_mm` on first access (0.1 ms at 640x480).
    #[getter]
    fn depth(&self, py: Python<'_>) -> Py<PyArray2<f32>> {
        let make = || {
            let (height, width) = self.shape();
            let millimetres = &self.memory.bytes()[self.depth_plane()];
            // A division, not a multiplication by 0.001, so that 2500 mm is exactly 2.5 m.
            let metres: Vec<f32> = millimetres
                .as_chunks::<2>()
                .0
                .iter()
                .map(|&depth_mm| f32::from(u16::from_ne_bytes(depth_mm)) / 1000.0)
                .collect();
            let array = numpy::ndarray::Array2::from_shape_vec((height, width), metres)
                .expect("one number per pixel");
            let array = PyArray2::from_owned_array(py, array);
            array.readwrite().make_nonwriteable();
            array.unbind()
        };
        self.depth.get_or_init(py, make).clone_ref(py)
    }

    /// Returns the depth at column x, row y; None without a return. [m, cam]
    ///
    /// Raises IndexError outside the image.
    fn depth_m(&self, x_px: usize, y_px: usize) -> PyResult<Option<f64>> {
        let (height, width) = self.shape();
        if x_px >= width || y_px >= height {
            return Err(PyIndexError::new_err(format!(
                "pixel x {x_px}, y {y_px} lies outside the image of {width} x {height} px"
            )));
        }
        let at = self.depth_at + 2 * (y_px * width + x_px);
        let bytes = &self.memory.bytes()[at..at + 2];
        let depth_mm = u16::from_ne_bytes([bytes[0], bytes[1]]);
        Ok((depth_mm > 0).then(|| f64::from(depth_mm) / 1000.0))
    }

    /// Width. [px]
    #[getter]
    fn width_px(&self) -> u32 {
        self.intrinsics.width_px
    }

    /// Height. [px]
    #[getter]
    fn height_px(&self) -> u32 {
        self.intrinsics.height_px
    }

    /// Size, focal lengths, principal point, lens.
    #[getter]
    fn intrinsics(&self) -> Intrinsics {
        Intrinsics(self.intrinsics)
    }

    /// Pose of the body at the instant that the image shows, from which the image was rendered. None if the
    /// course withholds the pose. [m, world]
    #[getter]
    fn pose_at_image(&self) -> Option<Pose> {
        self.pose_at_image.map(|pose| Pose::new("world", "body", &pose))
    }

    /// Pose of the camera on the body.
    #[getter]
    fn body_from_cam(&self) -> Pose {
        Pose::new("body", "cam", &self.body_from_cam)
    }

    fn __repr__(&self) -> String {
        let (height, width) = self.shape();
        format!("CameraImage({:?}, {width}x{height} px, seq={})", self.name, self.seq)
    }
}

#[pymethods]
impl Vehicle {
    #[new]
    #[pyo3(signature = (
        world_from_body = None, v_world_mps = None, omega_body_radps = None, *, attitude_xyzw = None,
        stamp_ns = 0
    ))]
    fn make(
        world_from_body: Option<Pose>,
        v_world_mps: Option<&Bound<'_, PyAny>>,
        omega_body_radps: Option<&Bound<'_, PyAny>>,
        attitude_xyzw: Option<&Bound<'_, PyAny>>,
        stamp_ns: u64,
    ) -> PyResult<Self> {
        let or_zero = |value: Option<&Bound<'_, PyAny>>, name| {
            value.map_or(Ok(DVec3::ZERO), |value| vector(value, name))
        };
        let world_from_body: Option<SdkPose<World, Body>> =
            world_from_body.map(|pose| pose.typed("world", "body")).transpose()?;
        let attitude = match (attitude_xyzw, &world_from_body) {
            (Some(given), _) => quaternion(given, "attitude_xyzw")?,
            (None, Some(pose)) => pose.rotation,
            (None, None) => DQuat::IDENTITY,
        };
        let v_world_mps = or_zero(v_world_mps, "v_world_mps")?;
        Ok(Self(SdkVehicle {
            stamp: HostTime::from_ns(stamp_ns),
            attitude,
            omega_body_radps: or_zero(omega_body_radps, "omega_body_radps")?,
            world_from_body,
            v_world_mps: world_from_body.map(|_| v_world_mps),
        }))
    }

    /// Time of this state. [ns, `time.monotonic_ns()`]
    #[getter]
    fn stamp_ns(&self) -> u64 {
        self.0.stamp.as_ns()
    }

    /// Attitude as a unit quaternion x, y, z, w that rotates vectors from body to world axes: shape (4,),
    /// float64. From localization if the course gives the pose, otherwise the autopilot's estimate.
    #[getter]
    fn attitude_xyzw<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.0.attitude.to_array())
    }

    /// Heading: angle of the nose from world x, counter-clockwise. [rad, world]
    #[getter]
    fn yaw_rad(&self) -> f64 {
        yaw_of(self.0.attitude)
    }

    /// Angular velocity: shape (3,), float64. [rad/s, body]
    #[getter]
    fn omega_body_radps<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array3(py, self.0.omega_body_radps)
    }

    /// Position and attitude from localization; None if the course withholds them. [m, world]
    #[getter]
    fn world_from_body(&self) -> Option<Pose> {
        self.0.world_from_body.map(|pose| Pose::new("world", "body", &pose))
    }

    /// Position: shape (3,), float64; None if the course withholds it. [m, world]
    #[getter]
    fn p_world_m<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<f64>>> {
        self.0.world_from_body.map(|pose| array3(py, pose.translation_m))
    }

    /// Velocity: shape (3,), float64; None if the course withholds it. [m/s, world]
    #[getter]
    fn v_world_mps<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<f64>>> {
        self.0.v_world_mps.map(|v_mps| array3(py, v_mps))
    }

    fn __repr__(&self) -> String {
        let yaw_rad = self.yaw_rad();
        match (self.0.world_from_body, self.0.v_world_mps) {
            (Some(pose), Some(v)) => {
                let p = pose.translation_m;
                format!(
                    "Vehicle(p_world_m=[{:.3}, {:.3}, {:.3}], v_world_mps=[{:.3}, {:.3}, {:.3}], \
                     yaw_rad={yaw_rad:.3})",
                    p.x, p.y, p.z, v.x, v.y, v.z
                )
            }
            _ => format!("Vehicle(yaw_rad={yaw_rad:.3}, without its pose)"),
        }
    }
}

/// One sample of the autopilot's accelerometer and gyroscope.
///
/// `ImuSample(accel_mps2, gyro_radps, stamp_ns=0)` creates one for tests.
#[pyclass(frozen, module = "vizflyt", from_py_object)]
#[derive(Clone)]
pub(crate) struct ImuSample(pub(crate) SdkImuSample);

#[pymethods]
impl ImuSample {
    #[new]
    #[pyo3(signature = (accel_mps2, gyro_radps, *, stamp_ns = 0))]
    fn make(
        accel_mps2: &Bound<'_, PyAny>,
        gyro_radps: &Bound<'_, PyAny>,
        stamp_ns: u64,
    ) -> PyResult<Self> {
        Ok(Self(SdkImuSample {
            stamp: HostTime::from_ns(stamp_ns),
            accel_mps2: vector(accel_mps2, "accel_mps2")?,
            gyro_radps: vector(gyro_radps, "gyro_radps")?,
        }))
    }

    /// Time of the measurement. [ns, `time.monotonic_ns()`]
    #[getter]
    fn stamp_ns(&self) -> u64 {
        self.0.stamp.as_ns()
    }

    /// Specific force: shape (3,), float64; at rest and level +9.8 along z. [m/s^2, body]
    #[getter]
    fn accel_mps2<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array3(py, self.0.accel_mps2)
    }

    /// Angular velocity: shape (3,), float64. [rad/s, body]
    #[getter]
    fn gyro_radps<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array3(py, self.0.gyro_radps)
    }

    fn __repr__(&self) -> String {
        let (a, w) = (self.0.accel_mps2.to_array(), self.0.gyro_radps.to_array());
        format!("ImuSample(accel_mps2={a:.3?}, gyro_radps={w:.4?})")
    }
}

/// State of the battery, as measured by the autopilot.
///
/// `Battery(fraction=None, voltage_v=None)` creates one for tests.
#[pyclass(frozen, module = "vizflyt", from_py_object)]
#[derive(Clone)]
pub(crate) struct Battery(pub(crate) SdkBattery);

#[pymethods]
impl Battery {
    #[new]
    #[pyo3(signature = (fraction = None, voltage_v = None))]
    fn make(fraction: Option<f64>, voltage_v: Option<f64>) -> Self {
        Self(SdkBattery { fraction, voltage_v })
    }

    /// Remaining charge, 0 to 1; None if the autopilot does not report it.
    #[getter]
    fn fraction(&self) -> Option<f64> {
        self.0.fraction
    }

    /// Voltage; None if it is not measured. [V]
    #[getter]
    fn voltage_v(&self) -> Option<f64> {
        self.0.voltage_v
    }

    fn __repr__(&self) -> String {
        let show = |value: Option<f64>| value.map_or("None".to_owned(), |value| value.to_string());
        let (fraction, voltage_v) = (show(self.0.fraction), show(self.0.voltage_v));
        format!("Battery(fraction={fraction}, voltage_v={voltage_v})")
    }
}
