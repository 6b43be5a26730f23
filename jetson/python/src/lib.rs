//! The Python face of the SDK: `vizflyt._vizflyt`, which the package `vizflyt` re-exports.
//!
//! Conversion only: what a plugin sees and answers is defined by `vizflyt-sdk`, and stays there.
//! Images are read-only numpy arrays that lie in the runtime's shared memory; see
//! [`shared_memory`]. The main loop, which calls the student's methods, is Python itself
//! (`python/vizflyt/_run.py`), so that debuggers and tracebacks see nothing strange.

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

/// Everything of the package `vizflyt` that is compiled.
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
