//! A runtime without a flight, for tests and notebooks.

use std::time::Duration;

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use vizflyt_sdk::ipc::{IpcError, Offer, RuntimeEnd};
use vizflyt_sdk::protocol::messages::{
    Event as SdkEvent, EventKind, FromPlugin, Odometry, ToPlugin, bounded,
};
use vizflyt_sdk::protocol::time::ServerTime;
use vizflyt_sdk::{ObservationWriter, host_now};

use crate::arena::{ArenaInfo, CameraInfo};
use crate::buffer::ObservationBuffer;
use crate::geometry::Pose;
use crate::setpoint::Setpoint;

/// A runtime without a flight, for a plugin that runs on another thread or in another process, attached to
/// `service`. With `waiting`, `vizflyt.run` finds it automatically.
#[pyclass(frozen, module = "vizflyt")]
pub(crate) struct Rehearsal {
    end: RuntimeEnd,
    /// Withdrawn when this is dropped.
    offer: Offer,
}

/// A message of a plugin: (kind, number of the observation, setpoint or text, entered [ns]).
type PluginMessage = (&'static str, u64, Py<PyAny>, u64);

#[pymethods]
impl Rehearsal {
    #[new]
    #[pyo3(signature = (cameras, *, waiting = false))]
    fn make(cameras: Vec<CameraInfo>, waiting: bool) -> PyResult<Self> {
        let cameras: Vec<_> = cameras.into_iter().map(|camera| camera.0).collect();
        let end = RuntimeEnd::new(ObservationWriter::len_for(&cameras));
        let offer = if waiting { end.offer() } else { end.offer_unlisted() };
        Ok(Self { offer: offer.map_err(|error| failed(&error))?, end })
    }

    /// Service that the plugin attaches to: `vizflyt.run(MyPlugin, service=...)`.
    #[getter]
    fn service(&self) -> String {
        self.offer.service()
    }

    /// Whether a plugin is attached, so that messages reach it.
    #[getter]
    fn is_attached(&self) -> bool {
        self.end.plugin_attached()
    }

    /// Sends the description of the arena to the plugin.
    fn start(&self, info: &ArenaInfo) -> PyResult<()> {
        self.send(&ToPlugin::Start(info.0.clone()))
    }

    /// Sends an event of kind 'note'.
    fn note(&self, text: &str) -> PyResult<()> {
        let stamp = ServerTime::from_ns(host_now().as_ns());
        self.send(&ToPlugin::Event(SdkEvent { stamp, kind: EventKind::Note, text: bounded(text) }))
    }

    /// Sends the event that the goal was reached after this time. [s]
    fn finish(&self, seconds: f64) -> PyResult<()> {
        let stamp = ServerTime::from_ns(host_now().as_ns());
        let kind = EventKind::Finished { seconds };
        self.send(&ToPlugin::Event(SdkEvent { stamp, kind, text: bounded("finished") }))
    }

    /// Requests the plugin to stop.
    fn stop(&self) -> PyResult<()> {
        self.send(&ToPlugin::Stop)
    }

    /// Publishes the buffer's images through shared memory.
    fn publish(&self, buffer: &ObservationBuffer) -> PyResult<()> {
        let mut loan = self
            .end
            .loan(
                ObservationWriter::len_for(buffer.cameras())
                    + ObservationWriter::sensors_len(buffer.sensors()),
            )
            .map_err(|error| failed(&error))?;
        buffer.with_bytes(|bytes| {
            let memory = loan.memory();
            let len = memory.len().min(bytes.len());
            memory[..len].copy_from_slice(&bytes[..len]);
        });
        self.end.publish(loan).map_err(|error| failed(&error))
    }

    /// Waits for a message of the plugin: ('ready', 0, name, 0), ('odometry', 0, pose, stamp_ns), ('answer',
    /// seq, setpoint, entered_ns) or ('failed', 0, reason, 0). None after a timeout. [s]
    #[pyo3(signature = (timeout_s = 10.0))]
    fn receive(&self, py: Python<'_>, timeout_s: f64) -> PyResult<Option<PluginMessage>> {
        let deadline =
            std::time::Instant::now() + Duration::try_from_secs_f64(timeout_s).unwrap_or_default();
        loop {
            if let Some(message) = self.end.receive().map_err(|error| failed(&error))? {
                return to_python(py, message).map(Some);
            }
            let left = deadline.saturating_duration_since(std::time::Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            // Short, so that Ctrl-C takes effect.
            let wait = left.min(Duration::from_millis(200));
            py.detach(|| self.end.wait(wait)).map_err(|error| failed(&error))?;
            py.check_signals()?;
        }
    }
}

impl Rehearsal {
    fn send(&self, message: &ToPlugin) -> PyResult<()> {
        self.end.send(message).map_err(|error| failed(&error))
    }
}

fn to_python(py: Python<'_>, message: FromPlugin) -> PyResult<PluginMessage> {
    Ok(match message {
        FromPlugin::Ready { name } => ("ready", 0, name.into_pyobject(py)?.into_any().unbind(), 0),
        FromPlugin::Reply { seq, entered, setpoint, .. } => {
            let setpoint = match setpoint {
                Some(setpoint) => Py::new(py, Setpoint(setpoint))?.into_any(),
                None => py.None(),
            };
            ("answer", seq, setpoint, entered.as_ns())
        }
        FromPlugin::Odometry(Odometry { stamp, odom_from_body }) => {
            let pose = Py::new(py, Pose::new("odom", "body", &odom_from_body))?.into_any();
            ("odometry", 0, pose, stamp.as_ns())
        }
        FromPlugin::Failed { reason } => {
            ("failed", 0, reason.into_pyobject(py)?.into_any().unbind(), 0)
        }
    })
}

fn failed(error: &IpcError) -> PyErr {
    PyRuntimeError::new_err(error.to_string())
}
