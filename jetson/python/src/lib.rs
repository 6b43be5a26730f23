//! Python bindings of the SDK: `vizflyt._vizflyt`, which the package `vizflyt` re-exports.
//!
//! This crate only converts types; `vizflyt-sdk` defines observations and setpoints. Images are read-only numpy
//! arrays in the runtime's shared memory; see [`shared_memory`]. The main loop, which calls the student's
//! methods, is written in Python (`python/vizflyt/_run.py`), so that debuggers and tracebacks work as usual.

mod arena;
mod arguments;
mod buffer;
mod event;
mod geometry;
mod log;
mod observation;
mod odometry;
mod plugin_end;
mod rehearsal;
mod sensor;
mod setpoint;
mod shared_memory;

use pyo3::prelude::*;

/// All compiled parts of the package `vizflyt`.
#[pymodule]
mod _vizflyt {
    #[pymodule_export]
    use crate::arena::{ArenaInfo, CameraInfo, Limits, course_map};
    #[pymodule_export]
    use crate::buffer::ObservationBuffer;
    #[pymodule_export]
    use crate::event::Event;
    #[pymodule_export]
    use crate::geometry::{Intrinsics, Pose, Volume};
    #[pymodule_export]
    use crate::log::decode_image;
    #[pymodule_export]
    use crate::observation::{Battery, CameraImage, ImuSample, Observation, Vehicle};
    #[pymodule_export]
    use crate::odometry::publish_odometry;
    #[pymodule_export]
    use crate::plugin_end::{PluginEnd, waiting_services};
    #[pymodule_export]
    use crate::rehearsal::Rehearsal;
    #[pymodule_export]
    use crate::sensor::{SensorInfo, SensorReading};
    #[pymodule_export]
    use crate::setpoint::Setpoint;

    use super::{Bound, PyModule, PyModuleMethods, PyResult};
    use crate::arguments::NotFiniteError;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))?;
        module.add("NotFiniteError", module.py().get_type::<NotFiniteError>())?;
        module.add("PROTOCOL_VERSION", vizflyt_sdk::protocol::PROTOCOL_VERSION)
    }
}
