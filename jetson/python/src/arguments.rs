//! Arguments from Python: accepts all values that convert to numbers, and reports others in one sentence with
//! their name.

use numpy::{AllowTypeChange, PyArray1, PyArrayDyn, PyArrayLikeDyn, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use vizflyt_sdk::glam::{DQuat, DVec3};

pyo3::create_exception!(
    vizflyt,
    NotFiniteError,
    PyValueError,
    "A NaN or an infinity where a number must be finite. Raised by `on_image`, it counts as a reply that the\n\
     runtime rejects: the vehicle holds after 0.5 s and lands after 2 s without a valid one."
);

/// Returns three finite numbers from a list, tuple, array or tensor called `name`.
pub(crate) fn vector(value: &Bound<'_, PyAny>, name: &str) -> PyResult<DVec3> {
    let wanted = "three numbers [x, y, z]";
    let numbers = numbers(value, name, wanted)?;
    if numbers.shape() != [3] {
        return Err(wrong_shape(value, name, wanted));
    }
    let vector = DVec3::from_slice(&numbers.as_array().iter().copied().collect::<Vec<_>>());
    if vector.is_finite() { Ok(vector) } else { Err(not_finite(name, &vector.to_array())) }
}

/// Returns a unit quaternion, xyzw.
pub(crate) fn quaternion(value: &Bound<'_, PyAny>, name: &str) -> PyResult<DQuat> {
    let wanted = "four numbers [x, y, z, w]";
    let numbers = numbers(value, name, wanted)?;
    if numbers.shape() != [4] {
        return Err(wrong_shape(value, name, wanted));
    }
    let xyzw: Vec<f64> = numbers.as_array().iter().copied().collect();
    let rotation = DQuat::from_slice(&xyzw);
    if !rotation.is_finite() {
        return Err(not_finite(name, &xyzw));
    }
    if (rotation.length() - 1.0).abs() > 1e-3 {
        return Err(PyValueError::new_err(format!(
            "{name} is {xyzw:?}, of length {:.4}: a rotation is a quaternion [x, y, z, w] of length 1",
            rotation.length()
        )));
    }
    Ok(rotation.normalize())
}

/// One point or many points, with results in the same form.
pub(crate) struct Points {
    pub(crate) points: Vec<DVec3>,
    single: bool,
}

impl Points {
    /// Takes a point of shape (3,) or points of shape (N, 3).
    pub(crate) fn take(value: &Bound<'_, PyAny>, name: &str) -> PyResult<Self> {
        let wanted = "a point [x, y, z] or points of shape (N, 3)";
        let numbers = numbers(value, name, wanted)?;
        let single = match *numbers.shape() {
            [3] => true,
            [_, 3] => false,
            _ => return Err(wrong_shape(value, name, wanted)),
        };
        let flat: Vec<f64> = numbers.as_array().iter().copied().collect();
        Ok(Self { points: flat.chunks_exact(3).map(DVec3::from_slice).collect(), single })
    }

    /// Returns whether the input was a single point, not an array of one.
    pub(crate) fn is_single(&self) -> bool {
        self.single
    }

    /// Returns one vector per point: shape (3,) or (N, 3).
    pub(crate) fn vectors<'py>(
        &self,
        py: Python<'py>,
        of: impl Fn(DVec3) -> DVec3,
    ) -> PyResult<Bound<'py, PyAny>> {
        let flat: Vec<f64> = self.points.iter().flat_map(|&p| of(p).to_array()).collect();
        let shape = if self.single { vec![3] } else { vec![self.points.len(), 3] };
        array_of(py, &flat, shape)
    }

    /// Returns one number per point: a float or shape (N,).
    pub(crate) fn scalars<'py>(
        &self,
        py: Python<'py>,
        of: impl Fn(DVec3) -> f64,
    ) -> PyResult<Bound<'py, PyAny>> {
        let values: Vec<f64> = self.points.iter().map(|&p| of(p)).collect();
        if self.single {
            return Ok(values[0].into_pyobject(py)?.into_any());
        }
        Ok(PyArray1::from_vec(py, values).into_any())
    }
}

/// Returns an array of `shape` from its numbers in row-major order.
pub(crate) fn array_of<'py>(
    py: Python<'py>,
    flat: &[f64],
    shape: Vec<usize>,
) -> PyResult<Bound<'py, PyAny>> {
    let array = numpy::ndarray::ArrayD::from_shape_vec(shape, flat.to_vec())
        .map_err(|error| PyValueError::new_err(error.to_string()))?;
    Ok(PyArrayDyn::from_owned_array(py, array).into_any())
}

/// Returns a vector as an array of shape (3,).
pub(crate) fn array3(py: Python<'_>, vector: DVec3) -> Bound<'_, PyArray1<f64>> {
    PyArray1::from_slice(py, &vector.to_array())
}

/// Returns a finite number called `name`.
pub(crate) fn scalar(value: &Bound<'_, PyAny>, name: &str, wanted: &str) -> PyResult<f64> {
    let number: f64 = value.extract().map_err(|_| wrong_type(value, name, wanted))?;
    if number.is_finite() { Ok(number) } else { Err(not_finite(name, &[number])) }
}

/// Returns the numbers of a value called `name`, of any shape.
pub(crate) fn numbers<'py>(
    value: &Bound<'py, PyAny>,
    name: &str,
    wanted: &str,
) -> PyResult<PyArrayLikeDyn<'py, f64, AllowTypeChange>> {
    if value.is_none() {
        // numpy would convert None to NaN.
        return Err(wrong_type(value, name, wanted));
    }
    value.extract().map_err(|error: PyErr| {
        let clear = wrong_type(value, name, wanted);
        clear.set_cause(value.py(), Some(error));
        clear
    })
}

/// Returns the error for an argument of an unsupported type.
pub(crate) fn wrong_type(value: &Bound<'_, PyAny>, name: &str, wanted: &str) -> PyErr {
    PyTypeError::new_err(format!("{name} must be {wanted}, not {}", describe(value)))
}

/// Returns the error for an array of an unsupported shape.
pub(crate) fn wrong_shape(value: &Bound<'_, PyAny>, name: &str, wanted: &str) -> PyErr {
    PyValueError::new_err(format!("{name} must be {wanted}, not {}", describe(value)))
}

fn not_finite(name: &str, numbers: &[f64]) -> PyErr {
    let shown = if let [number] = numbers { format!("{number}") } else { format!("{numbers:?}") };
    NotFiniteError::new_err(format!(
        "{name} is {shown}: every number must be finite; look for a division by zero or the mean of \
         an empty array"
    ))
}

/// Describes a value for an error message: `a numpy.ndarray of shape (2,) and dtype int64`.
pub(crate) fn describe(value: &Bound<'_, PyAny>) -> String {
    let class = value.get_type();
    if value.is_none() {
        return "None".to_owned();
    }
    let name = class.name().map_or_else(|_| "object".to_owned(), |name| name.to_string());
    let module = class.module().map_or_else(|_| String::new(), |module| module.to_string());
    let full = match module.as_str() {
        "" | "builtins" | "__main__" => name,
        module => format!("{module}.{name}"),
    };
    let shape = value.getattr("shape").ok().and_then(|shape| shape.str().ok());
    let dtype = value.getattr("dtype").ok().and_then(|dtype| dtype.str().ok());
    match (shape, dtype) {
        (Some(shape), Some(dtype)) => format!("a {full} of shape {shape} and dtype {dtype}"),
        _ => match value.len() {
            Ok(len) if full == "list" || full == "tuple" => format!("a {full} of {len}"),
            _ => format!("a {full}"),
        },
    }
}
