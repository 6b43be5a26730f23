//! Events of the flight.

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use serde_json::Value;
use vizflyt_sdk::Event as SdkEvent;

/// One event of the flight.
///
/// `Event(kind, text, stamp_ns=0, **details)` creates one for tests.
#[pyclass(frozen, module = "vizflyt")]
pub(crate) struct Event {
    kind: String,
    details: Py<PyDict>,
    /// Description in words.
    #[pyo3(get)]
    text: String,
    /// Time on the server's clock. [ns]
    #[pyo3(get)]
    stamp_ns: u64,
}

impl Event {
    /// Converts an event of the SDK. The kind's fields become `details` under their own names.
    pub(crate) fn new(py: Python<'_>, event: &SdkEvent) -> PyResult<Self> {
        let kind = serde_json::to_value(&event.kind)
            .map_err(|error| PyValueError::new_err(error.to_string()))?;
        let details = PyDict::new(py);
        let name = match kind {
            Value::Object(fields) => {
                let (name, content) = fields.into_iter().next().unwrap_or_default();
                match content {
                    Value::Object(content) => {
                        for (key, value) in &content {
                            details.set_item(key, plain(py, value)?)?;
                        }
                    }
                    content => details.set_item(&name, plain(py, &content)?)?,
                }
                name
            }
            Value::String(name) => name,
            other => other.to_string(),
        };
        Ok(Self {
            kind: name,
            details: details.unbind(),
            text: event.text.to_string(),
            stamp_ns: event.stamp.as_ns(),
        })
    }
}

#[pymethods]
impl Event {
    #[new]
    #[pyo3(signature = (kind, text = "", *, stamp_ns = 0, **details))]
    fn make(
        py: Python<'_>,
        kind: String,
        text: &str,
        stamp_ns: u64,
        details: Option<&Bound<'_, PyDict>>,
    ) -> Self {
        let details = details.map_or_else(|| PyDict::new(py), Clone::clone).unbind();
        Self { kind, details, text: text.to_owned(), stamp_ns }
    }

    /// Kind of event: 'collision', 'geofence', 'stage', 'finished', 'time_limit', 'pose_lost', 'pose_regained',
    /// 'emergency_stop', 'phase', 'ended', 'note', 'start' or 'land'. The documentation lists them in 'Events'.
    #[getter]
    fn kind(&self) -> &str {
        &self.kind
    }

    /// Fields of the kind by name: `{'seconds': 12.4}` for 'finished', `{'phase': 'flying'}` for 'phase',
    /// `{'index': 0, 'name': 'gate'}` for 'stage', `{'p_world_m': [...], 'clearance_m': ...}` for 'collision'.
    #[getter]
    fn details(&self, py: Python<'_>) -> Py<PyDict> {
        self.details.clone_ref(py)
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        let details = self.details.bind(py).repr()?;
        Ok(format!("Event({:?}, {:?}, details={details})", self.kind, self.text))
    }
}

/// Converts a JSON value to a Python object.
fn plain<'py>(py: Python<'py>, value: &Value) -> PyResult<Bound<'py, PyAny>> {
    Ok(match value {
        Value::Null => py.None().into_bound(py),
        Value::Bool(truth) => truth.into_pyobject(py)?.to_owned().into_any(),
        Value::Number(number) => match number.as_i64() {
            Some(whole) => whole.into_pyobject(py)?.into_any(),
            None => number.as_f64().unwrap_or(f64::NAN).into_pyobject(py)?.into_any(),
        },
        Value::String(text) => text.into_pyobject(py)?.into_any(),
        Value::Array(values) => {
            let values: Vec<_> =
                values.iter().map(|value| plain(py, value)).collect::<PyResult<_>>()?;
            PyList::new(py, values)?.into_any()
        }
        Value::Object(fields) => {
            let dict = PyDict::new(py);
            for (key, value) in fields {
                dict.set_item(key, plain(py, value)?)?;
            }
            dict.into_any()
        }
    })
}
