//! Observations created by hand, for a plugin's own tests and for notebooks.

use std::sync::{Arc, Mutex, PoisonError};

use numpy::{PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::exceptions::PyLookupError;
use pyo3::prelude::*;
use vizflyt_sdk::protocol::messages::Name;
use vizflyt_sdk::{
    Body, CameraInfo as SdkCameraInfo, GivenReading, HostTime, ImageStamps,
    ObservationBuffer as SdkBuffer, Pose as SdkPose, SensorInfo as SdkSensorInfo, World,
};

use crate::arena::CameraInfo;
use crate::arguments::wrong_type;
use crate::geometry::Pose;
use crate::observation::{Battery, ImuSample, Observation, Vehicle};
use crate::sensor::SensorInfo;
use crate::shared_memory::Memory;

/// Observations created by hand, for a plugin's own tests and for notebooks.
///
/// `ObservationBuffer([CameraInfo(...)], [SensorInfo(...)])` has planes for these cameras and space for these
/// sensors.
#[pyclass(frozen, module = "vizflyt")]
pub(crate) struct ObservationBuffer {
    cameras: Vec<SdkCameraInfo>,
    sensors: Vec<SdkSensorInfo>,
    names: Arc<[Name]>,
    readings: Mutex<Vec<Option<OwnReading>>>,
    buffer: Mutex<SdkBuffer>,
}

impl ObservationBuffer {
    /// Returns the cameras of this buffer.
    pub(crate) fn cameras(&self) -> &[SdkCameraInfo] {
        &self.cameras
    }

    /// Returns the sensors of this buffer.
    pub(crate) fn sensors(&self) -> &[SdkSensorInfo] {
        &self.sensors
    }

    /// Calls `f` with the bytes.
    pub(crate) fn with_bytes<T>(&self, f: impl FnOnce(&[u8]) -> T) -> T {
        f(self.buffer.lock().unwrap_or_else(PoisonError::into_inner).as_bytes())
    }
}

#[pymethods]
impl ObservationBuffer {
    #[new]
    #[pyo3(signature = (cameras, sensors = Vec::new()))]
    fn make(cameras: Vec<CameraInfo>, sensors: Vec<SensorInfo>) -> Self {
        let cameras: Vec<_> = cameras.into_iter().map(|camera| camera.0).collect();
        let sensors: Vec<_> = sensors.into_iter().map(|sensor| sensor.0).collect();
        let names = cameras.iter().map(|camera| camera.name.clone()).collect();
        let mut buffer = SdkBuffer::with_sensors(&cameras, &sensors);
        // The list of sensors is available before the first reading.
        buffer.set_readings(&sensors.iter().map(|_| None).collect::<Vec<_>>());
        let readings = Mutex::new(sensors.iter().map(|_| None).collect());
        Self { cameras, sensors, names, readings, buffer: Mutex::new(buffer) }
    }

    /// Removes all content and sets the number of the observation.
    #[pyo3(signature = (seq = 0))]
    fn clear(&self, seq: u64) {
        self.buffer.lock().unwrap_or_else(PoisonError::into_inner).clear(seq);
    }

    /// Sets the state of the vehicle.
    fn set_vehicle(&self, vehicle: Vehicle) {
        self.buffer.lock().unwrap_or_else(PoisonError::into_inner).set_vehicle(&vehicle.0);
    }

    /// Sets the state of the battery.
    fn set_battery(&self, battery: Battery) {
        self.buffer.lock().unwrap_or_else(PoisonError::into_inner).set_battery(&battery.0);
    }

    /// Sets the newest IMU samples, oldest first. A plugin receives each stamp only once.
    fn set_imu(&self, samples: Vec<ImuSample>) {
        let samples: Vec<_> = samples.into_iter().map(|sample| sample.0).collect();
        self.buffer.lock().unwrap_or_else(PoisonError::into_inner).set_imu(&samples);
    }

    /// Sets a camera's image: `rgb` (H, W, 3) uint8, `depth_mm` (H, W) uint16. The default is black, without
    /// returns. Stamps are `time.monotonic_ns()`. [ns]
    #[pyo3(signature = (name, rgb = None, depth_mm = None, *, seq = 0, stamp_ns = 0, ready_ns = None))]
    #[allow(clippy::too_many_arguments)] // Why: most are Python keywords.
    fn set_image(
        &self,
        name: &str,
        rgb: Option<&Bound<'_, PyAny>>,
        depth_mm: Option<&Bound<'_, PyAny>>,
        seq: u64,
        stamp_ns: u64,
        ready_ns: Option<u64>,
    ) -> PyResult<()> {
        let index = self.cameras.iter().position(|camera| camera.name == name);
        let index = index.ok_or_else(|| {
            PyLookupError::new_err(format!("this buffer was made without a camera '{name}'"))
        })?;
        let k = &self.cameras[index].intrinsics;
        let (height, width) = (k.height_px as usize, k.width_px as usize);
        let rgb = rgb.map(|given| rgb_plane(given, height, width)).transpose()?;
        let depth = depth_mm.map(|given| depth_plane(given, height, width)).transpose()?;
        let stamps = ImageStamps {
            seq,
            pose: HostTime::from_ns(stamp_ns),
            ready: HostTime::from_ns(ready_ns.unwrap_or(stamp_ns)),
            ahead_ns: 0,
        };
        let mut buffer = self.buffer.lock().unwrap_or_else(PoisonError::into_inner);
        buffer.set_image(index, stamps, |planes| {
            match rgb {
                Some(rgb) => planes.rgb.copy_from_slice(&rgb),
                None => planes.rgb.fill(0),
            }
            match depth {
                Some(depth) => planes.depth_mm.copy_from_slice(&depth),
                None => planes.depth_mm.fill(0),
            }
        });
        Ok(())
    }

    /// Sets the pose of the body at the instant that a camera's image shows.
    fn set_pose_at_image(&self, name: &str, world_from_body: Pose) -> PyResult<()> {
        let index = self.cameras.iter().position(|camera| camera.name == name);
        let index = index.ok_or_else(|| {
            PyLookupError::new_err(format!("this buffer was made without a camera '{name}'"))
        })?;
        let pose = world_from_body.typed("world", "body")?;
        self.buffer.lock().unwrap_or_else(PoisonError::into_inner).set_pose_at_image(index, &pose);
        Ok(())
    }

    /// Sets a sensor's reading: `records` as bytes, or as an array with the layout of `SensorReading.records`.
    /// `pose_at_reading` is the pose of the body. Stamps are `time.monotonic_ns()`. [ns]
    #[pyo3(signature = (name, records, *, seq = 1, stamp_ns = 0, pose_at_reading = None))]
    fn set_reading(
        &self,
        name: &str,
        records: &Bound<'_, PyAny>,
        seq: u64,
        stamp_ns: u64,
        pose_at_reading: Option<Pose>,
    ) -> PyResult<()> {
        let index = self.sensors.iter().position(|sensor| sensor.name == name);
        let index = index.ok_or_else(|| {
            PyLookupError::new_err(format!("this buffer was made without a sensor '{name}'"))
        })?;
        let bytes: Vec<u8> = match records.extract::<Vec<u8>>() {
            Ok(bytes) => bytes,
            Err(_) => records.call_method0("tobytes")?.extract()?,
        };
        let world_from_body =
            pose_at_reading.map(|pose| pose.typed("world", "body")).transpose()?;
        let mut readings = self.readings.lock().unwrap_or_else(PoisonError::into_inner);
        readings[index] = Some(OwnReading { seq, stamp_ns, world_from_body, bytes });
        let given: Vec<_> = readings
            .iter()
            .zip(&self.sensors)
            .map(|(reading, sensor)| reading.as_ref().map(|own| own.given(sensor)))
            .collect();
        self.buffer.lock().unwrap_or_else(PoisonError::into_inner).set_readings(&given);
        Ok(())
    }

    /// Returns the observation that a plugin would receive.
    fn observation(&self, py: Python<'_>) -> PyResult<Observation> {
        let memory = self.with_bytes(|bytes| Memory::copied(bytes, Arc::clone(&self.names)));
        Observation::new(py, memory, HostTime::ZERO)
    }
}

/// Reading set by hand.
struct OwnReading {
    seq: u64,
    stamp_ns: u64,
    world_from_body: Option<SdkPose<World, Body>>,
    bytes: Vec<u8>,
}

impl OwnReading {
    fn given(&self, sensor: &SdkSensorInfo) -> GivenReading<'_> {
        let stamp = HostTime::from_ns(self.stamp_ns);
        GivenReading {
            seq: self.seq,
            pose: stamp,
            shown: stamp,
            ready: stamp,
            body_from_sensor: sensor.body_from_sensor,
            world_from_body: self.world_from_body,
            records: &self.bytes,
        }
    }
}

fn rgb_plane(given: &Bound<'_, PyAny>, height: usize, width: usize) -> PyResult<Vec<u8>> {
    let wanted = format!("a uint8 array of shape ({height}, {width}, 3)");
    let array: PyReadonlyArray3<'_, u8> =
        given.extract().map_err(|_| wrong_type(given, "rgb", &wanted))?;
    if array.shape() != [height, width, 3] {
        return Err(wrong_type(given, "rgb", &wanted));
    }
    Ok(array.as_array().iter().copied().collect())
}

fn depth_plane(given: &Bound<'_, PyAny>, height: usize, width: usize) -> PyResult<Vec<u16>> {
    let wanted = format!("a uint16 array of shape ({height}, {width}), in millimetres");
    let array: PyReadonlyArray2<'_, u16> =
        given.extract().map_err(|_| wrong_type(given, "depth_mm", &wanted))?;
    if array.shape() != [height, width] {
        return Err(wrong_type(given, "depth_mm", &wanted));
    }
    Ok(array.as_array().iter().copied().collect())
}
