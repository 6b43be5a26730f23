//! The plugin's end of the shared memory, for the main loop.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use pyo3::exceptions::{PyConnectionError, PyRuntimeError};
use pyo3::prelude::*;
use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::host_now;
use vizflyt_sdk::ipc::{IpcError, PluginEnd as SdkPluginEnd};
use vizflyt_sdk::protocol::messages::{FromPlugin, Name, ToPlugin, bounded};
use vizflyt_sdk::{HostTime, Setpoint as SdkSetpoint, YawTarget};

use crate::arena::ArenaInfo;
use crate::event::Event;
use crate::observation::Observation;
use crate::setpoint::Setpoint;
use crate::shared_memory::Lender;

/// Not for plugins: connection to the runtime, used by `vizflyt.run`.
#[pyclass(frozen, module = "vizflyt._vizflyt")]
pub(crate) struct PluginEnd {
    end: SdkPluginEnd,
    lender: Lender,
    names: Mutex<Arc<[Name]>>,
    /// Stamp of the newest IMU sample that the plugin has received. [ns, host]
    imu_had: AtomicU64,
}

#[pymethods]
impl PluginEnd {
    /// Attaches to the runtime at `service`.
    #[new]
    fn open(py: Python<'_>, service: &str) -> PyResult<Self> {
        let end =
            py.detach(|| SdkPluginEnd::open(service)).map_err(|error| not_attached(&error))?;
        let names = Mutex::new(Arc::from(Vec::new()));
        Ok(Self { end, lender: Lender::default(), names, imu_had: AtomicU64::default() })
    }

    /// Waits for a message or an observation, at most `timeout_s`; returns whether there is one.
    fn wait(&self, py: Python<'_>, timeout_s: f64) -> PyResult<bool> {
        let timeout = Duration::try_from_secs_f64(timeout_s).unwrap_or_default();
        let woken = py.detach(|| self.end.wait(timeout)).map_err(|error| lost(&error))?;
        py.check_signals()?;
        Ok(woken)
    }

    /// Returns the runtime's next message: ("start", `ArenaInfo`), ("event", Event) or ("stop", None). None if
    /// no message is waiting; ("gone", None) after the runtime has ended.
    fn receive(&self, py: Python<'_>) -> PyResult<Option<(&'static str, Py<PyAny>)>> {
        let message = match self.end.receive() {
            Err(IpcError::Gone(_)) => return Ok(Some(("gone", py.None()))),
            message => message.map_err(|error| lost(&error))?,
        };
        Ok(match message {
            None => None,
            Some(ToPlugin::Start(info)) => {
                *self.names.lock().unwrap_or_else(PoisonError::into_inner) =
                    info.cameras.iter().map(|camera| camera.name.clone()).collect();
                Some(("start", Py::new(py, ArenaInfo(info))?.into_any()))
            }
            Some(ToPlugin::Event(event)) => {
                Some(("event", Py::new(py, Event::new(py, &event)?)?.into_any()))
            }
            Some(ToPlugin::Stop) => Some(("stop", py.None())),
        })
    }

    /// Returns the newest observation, unless it was returned before.
    fn observation(&self, py: Python<'_>) -> PyResult<Option<Observation>> {
        let Some(sample) = self.end.observation().map_err(|error| lost(&error))? else {
            return Ok(None);
        };
        let names = Arc::clone(&self.names.lock().unwrap_or_else(PoisonError::into_inner));
        let memory = py.detach(|| self.lender.take(sample, names));
        let imu_had = HostTime::from_ns(self.imu_had.load(Ordering::Relaxed));
        // An invalid observation is a bug of the runtime and is skipped.
        let Ok(observation) = Observation::new(py, memory, imu_had) else { return Ok(None) };
        if let Some(newest) = observation.newest_imu() {
            self.imu_had.store(newest.as_ns(), Ordering::Relaxed);
        }
        Ok(Some(observation))
    }

    /// Reports that `on_start` has returned.
    fn ready(&self, name: &str) -> PyResult<()> {
        self.send(&FromPlugin::Ready { name: bounded(name) })
    }

    /// Sends the reply to one observation.
    #[pyo3(signature = (seq, entered_ns, setpoint))]
    fn answer(&self, seq: u64, entered_ns: u64, setpoint: Option<Setpoint>) -> PyResult<()> {
        for odometry in vizflyt_sdk::take_odometry() {
            self.send(&FromPlugin::Odometry(odometry))?;
        }
        self.send(&FromPlugin::Reply {
            seq,
            entered: HostTime::from_ns(entered_ns),
            returned: host_now(),
            setpoint: setpoint.map(|setpoint| setpoint.0),
        })
    }

    /// Replies to one observation with a setpoint that is not finite, so that the runtime rejects it with this
    /// reason.
    fn answer_not_finite(&self, seq: u64, entered_ns: u64) -> PyResult<()> {
        let setpoint = SdkSetpoint::velocity(DVec3::NAN, YawTarget::Keep);
        self.answer(seq, entered_ns, Some(Setpoint(setpoint)))
    }

    /// Reports that the plugin has failed, with the reason.
    fn failed(&self, reason: &str) -> PyResult<()> {
        self.send(&FromPlugin::Failed { reason: bounded(reason) })
    }
}

impl PluginEnd {
    fn send(&self, message: &FromPlugin) -> PyResult<()> {
        self.end.send(message).map_err(|error| lost(&error))
    }
}

fn not_attached(error: &IpcError) -> PyErr {
    PyConnectionError::new_err(error.to_string())
}

fn lost(error: &IpcError) -> PyErr {
    PyRuntimeError::new_err(error.to_string())
}

/// Returns the services of this user's runtimes that wait for a plugin, the longest waiting first.
#[pyfunction]
pub(crate) fn waiting_services() -> Vec<String> {
    vizflyt_sdk::ipc::offers()
}
