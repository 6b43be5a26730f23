//! Sensors other than cameras: their newest readings as structured arrays in shared memory.

use std::sync::Arc;

use numpy::ndarray::ArrayView1;
use numpy::{PyArray1, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::PyDict;
use vizflyt_sdk::protocol::messages::bounded;
use vizflyt_sdk::{
    Body, Pose as SdkPose, Sensor, SensorInfo as SdkSensorInfo, SensorKind,
    SensorReading as SdkReading, World,
};

use crate::geometry::Pose;
use crate::shared_memory::Memory;

/// One sensor of the vehicle other than a camera.
///
/// `SensorInfo(name, kind, most_records=1, ...)` creates one for tests. Without `body_from_sensor` it points
/// forward.
#[pyclass(frozen, module = "vizflyt", from_py_object)]
#[derive(Clone, PartialEq)]
pub(crate) struct SensorInfo(pub(crate) SdkSensorInfo);

#[pymethods]
impl SensorInfo {
    #[new]
    #[pyo3(signature = (
        name, kind, *, most_records = 1, rate_hz = 10.0, min_range_m = 0.0, max_range_m = 100.0,
        horizontal_fov_rad = 0.0, vertical_fov_rad = 0.0, body_from_sensor = None
    ))]
    #[allow(clippy::too_many_arguments)] // Why: most are Python keywords.
    fn make(
        name: &str,
        kind: &str,
        most_records: u32,
        rate_hz: f32,
        min_range_m: f32,
        max_range_m: f32,
        horizontal_fov_rad: f32,
        vertical_fov_rad: f32,
        body_from_sensor: Option<Pose>,
    ) -> PyResult<Self> {
        let body_from_sensor = match body_from_sensor {
            Some(pose) => pose.typed::<Body, Sensor>("body", "sensor")?,
            None => SdkPose::IDENTITY,
        };
        let kind =
            SensorKind::ALL.into_iter().find(|known| known.name() == kind).ok_or_else(|| {
                let known = SensorKind::ALL.map(SensorKind::name).join(", ");
                PyValueError::new_err(format!(
                    "unknown kind of sensor {kind:?}; known kinds: {known}"
                ))
            })?;
        Ok(Self(SdkSensorInfo {
            name: bounded(name),
            kind,
            enabled: true,
            to_autopilot: false,
            rate_hz,
            min_range_m,
            max_range_m,
            horizontal_fov_rad,
            vertical_fov_rad,
            most_records,
            body_from_sensor,
        }))
    }

    /// Name of the sensor, the argument of `obs.sensor(name)`.
    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }

    /// Kind: 'lidar', 'range_finder', 'sonar' or 'radar'.
    #[getter]
    fn kind(&self) -> &'static str {
        self.0.kind.name()
    }

    /// Rate of readings. [Hz]
    #[getter]
    fn rate_hz(&self) -> f32 {
        self.0.rate_hz
    }

    /// Minimum range. [m]
    #[getter]
    fn min_range_m(&self) -> f32 {
        self.0.min_range_m
    }

    /// Maximum range. [m]
    #[getter]
    fn max_range_m(&self) -> f32 {
        self.0.max_range_m
    }

    /// Horizontal field of view. [rad]
    #[getter]
    fn horizontal_fov_rad(&self) -> f32 {
        self.0.horizontal_fov_rad
    }

    /// Vertical field of view. [rad]
    #[getter]
    fn vertical_fov_rad(&self) -> f32 {
        self.0.vertical_fov_rad
    }

    /// Pose of the sensor on the body. Sensor axes are x forward, y left, z up.
    #[getter]
    fn body_from_sensor(&self) -> Pose {
        Pose::new("body", "sensor", &self.0.body_from_sensor)
    }

    fn __repr__(&self) -> String {
        format!("SensorInfo({:?}, {:?})", self.0.name.as_str(), self.0.kind.name())
    }
}

/// Newest reading of one sensor. It stays in later observations until the next one arrives; a changed `seq`
/// marks a new reading.
#[pyclass(frozen, module = "vizflyt")]
pub(crate) struct SensorReading {
    memory: Arc<Memory>,
    records_at: usize,
    record_count: usize,
    kind: SensorKind,
    /// Name of the sensor in `arena.toml`.
    #[pyo3(get)]
    name: String,
    /// Number of the reading, from 1.
    #[pyo3(get)]
    seq: u64,
    /// Measurement time of the newest pose behind the reading. [ns, `time.monotonic_ns()`]
    #[pyo3(get)]
    stamp_ns: u64,
    /// Instant of the reading; for a sweep, the instant of its last beam. [ns, `time.monotonic_ns()`]
    #[pyo3(get)]
    shown_ns: u64,
    /// Time at which the runtime received the reading. [ns, `time.monotonic_ns()`]
    #[pyo3(get)]
    ready_ns: u64,
    range_m: Option<f32>,
    body_from_sensor: SdkPose<Body, Sensor>,
    pose_at_reading: Option<SdkPose<World, Body>>,
}

impl SensorReading {
    pub(crate) fn new(
        memory: &Arc<Memory>,
        reading: &SdkReading<'_>,
        (records_at, record_count): (usize, usize),
    ) -> Self {
        Self {
            memory: Arc::clone(memory),
            records_at,
            record_count,
            kind: reading.kind,
            name: reading.name.to_owned(),
            seq: reading.seq,
            stamp_ns: reading.stamp.as_ns(),
            shown_ns: reading.shown.as_ns(),
            ready_ns: reading.ready.as_ns(),
            range_m: reading.range_m(),
            body_from_sensor: reading.body_from_sensor,
            pose_at_reading: reading.pose_at_reading,
        }
    }

    /// Returns whether the sensor has this name.
    pub(crate) fn is(&self, name: &str) -> bool {
        self.name == name
    }
}

#[pymethods]
impl SensorReading {
    /// Kind: 'lidar', 'range_finder', 'sonar' or 'radar'.
    #[getter]
    fn kind(&self) -> &'static str {
        self.kind.name()
    }

    /// Measured values: a read-only structured view of shape (N,). [sensor: x forward, y left, z up]
    ///
    /// lidar: `p_m` (3 x float32, [m]), `before_ns` (uint32), `intensity` (uint16), `ring` (uint16);
    /// range_finder, sonar (N is 1): `range_m` (0 means no echo), `signal` (float32);
    /// radar: `range_m`, `azimuth_rad`, `radial_mps`, `snr_db`, `cross_section_m2` (float32).
    #[getter]
    fn records<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let this = slf.get();
        let len = this.record_count * this.kind.record_len();
        let bytes = &this.memory.bytes()[this.records_at..this.records_at + len];
        let view = ArrayView1::from(bytes);
        // SAFETY: `slf` becomes the array's base. It is frozen and owns the memory through an `Arc`, whose bytes
        // neither move nor change while it lives. The array is made read-only before other code sees it.
        let array = unsafe { PyArray1::borrow_from_array(&view, slf.clone().into_any()) };
        array.readwrite().make_nonwriteable();
        array.call_method1("view", (record_type(slf.py(), this.kind)?,))
    }

    /// Points of a LiDAR: a read-only view of shape (N, 3), float32; None for other sensors. [m, sensor]
    #[getter]
    fn points_m<'py>(slf: &Bound<'py, Self>) -> PyResult<Option<Bound<'py, PyAny>>> {
        if slf.get().kind != SensorKind::Lidar {
            return Ok(None);
        }
        Self::records(slf)?.get_item("p_m").map(Some)
    }

    /// Distance measured by a range finder or sonar; None without a return, and for other sensors. [m]
    #[getter]
    fn range_m(&self) -> Option<f32> {
        self.range_m
    }

    /// Pose of the sensor on the body.
    #[getter]
    fn body_from_sensor(&self) -> Pose {
        Pose::new("body", "sensor", &self.body_from_sensor)
    }

    /// Pose of the body at the instant of the reading; None if the course withholds the pose. [m, world]
    #[getter]
    fn pose_at_reading(&self) -> Option<Pose> {
        self.pose_at_reading.map(|pose| Pose::new("world", "body", &pose))
    }

    fn __repr__(&self) -> String {
        let (kind, seq, count) = (self.kind.name(), self.seq, self.record_count);
        format!("SensorReading({:?}, {kind}, seq={seq}, records={count})", self.name)
    }
}

/// Returns the numpy dtype of a kind's records, in the layout of `vizflyt_protocol::sensor::records`.
fn record_type(py: Python<'_>, kind: SensorKind) -> PyResult<Bound<'_, PyAny>> {
    static TYPES: [PyOnceLock<Py<PyAny>>; 4] = [const { PyOnceLock::new() }; 4];
    let fields: &[(&str, &str, usize)] = match kind {
        SensorKind::Lidar => &[
            ("p_m", "3<f4", 0),
            ("before_ns", "<u4", 12),
            ("intensity", "<u2", 16),
            ("ring", "<u2", 18),
        ],
        SensorKind::RangeFinder | SensorKind::Sonar => {
            &[("range_m", "<f4", 0), ("signal", "<f4", 4)]
        }
        SensorKind::Radar => &[
            ("range_m", "<f4", 0),
            ("azimuth_rad", "<f4", 4),
            ("radial_mps", "<f4", 8),
            ("snr_db", "<f4", 12),
            ("cross_section_m2", "<f4", 16),
        ],
    };
    let make = || -> PyResult<Py<PyAny>> {
        let description = PyDict::new(py);
        let names: Vec<&str> = fields.iter().map(|field| field.0).collect();
        let formats: Vec<&str> = fields.iter().map(|field| field.1).collect();
        let offsets: Vec<usize> = fields.iter().map(|field| field.2).collect();
        description.set_item("names", names)?;
        description.set_item("formats", formats)?;
        description.set_item("offsets", offsets)?;
        description.set_item("itemsize", kind.record_len())?;
        Ok(py.import("numpy")?.call_method1("dtype", (description,))?.unbind())
    };
    let slot = &TYPES[kind as usize - 1];
    slot.get_or_try_init(py, make).map(|dtype| dtype.bind(py).clone())
}
