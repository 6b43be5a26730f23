//! What a plugin asks of the vehicle.

use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::{Axes, Setpoint as SdkSetpoint, YawTarget};

use crate::arguments::{scalar, vector, wrong_type};

/// What a plugin asks of the vehicle; the newest one holds until the guard's deadline of 0.5 s.
///
/// `yaw` is where the nose shall point: an angle from world x, counter-clockwise [rad]. `yaw_rate` is how
/// fast it shall turn, counter-clockwise [rad/s]. Without either the heading stays.
///
/// `axes` are those in which a vector is given: 'world' (x east, y north, z up) or 'heading' (x along the
/// nose, y left, z up, levelled: ahead never means into the floor).
#[pyclass(frozen, module = "vizflyt", from_py_object)]
#[derive(Clone, PartialEq)]
pub(crate) struct Setpoint(pub(crate) SdkSetpoint);

type Given<'a, 'py> = Option<&'a Bound<'py, PyAny>>;

#[pymethods]
impl Setpoint {
    #[new]
    #[pyo3(signature = (*_args, **_kwargs))]
    fn make(_args: &Bound<'_, PyAny>, _kwargs: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        Err(PyTypeError::new_err(
            "a Setpoint is made by what it asks for: Setpoint.velocity([x, y, z]), .position, \
             .acceleration, .hold() or .land()",
        ))
    }

    /// Stop and stay.
    #[staticmethod]
    fn hold() -> Self {
        Self(SdkSetpoint::Hold)
    }

    /// Come down here and disarm.
    #[staticmethod]
    fn land() -> Self {
        Self(SdkSetpoint::Land)
    }

    /// Fly to a point (3,) and stay. [m, world]
    #[staticmethod]
    #[pyo3(signature = (p_world_m, *, yaw = None, yaw_rate = None))]
    fn position(
        p_world_m: &Bound<'_, PyAny>,
        yaw: Given<'_, '_>,
        yaw_rate: Given<'_, '_>,
    ) -> PyResult<Self> {
        let p_world_m = vector(p_world_m, "p_world_m")?;
        Ok(Self(SdkSetpoint::Position { p_world_m, yaw: yaw_target(yaw, yaw_rate)? }))
    }

    /// Fly at a velocity (3,). [m/s, axes]
    #[staticmethod]
    #[pyo3(signature = (v_mps, *, axes = None, yaw = None, yaw_rate = None))]
    fn velocity(
        v_mps: &Bound<'_, PyAny>,
        axes: Given<'_, '_>,
        yaw: Given<'_, '_>,
        yaw_rate: Given<'_, '_>,
    ) -> PyResult<Self> {
        let (v_mps, axes) = (vector(v_mps, "v_mps")?, axes_of(axes)?);
        Ok(Self(SdkSetpoint::Velocity { v_mps, axes, yaw: yaw_target(yaw, yaw_rate)? }))
    }

    /// Accelerate (3,), gravity already compensated: zero keeps the velocity. [m/s^2, axes]
    #[staticmethod]
    #[pyo3(signature = (a_mps2, *, axes = None, yaw = None, yaw_rate = None))]
    fn acceleration(
        a_mps2: &Bound<'_, PyAny>,
        axes: Given<'_, '_>,
        yaw: Given<'_, '_>,
        yaw_rate: Given<'_, '_>,
    ) -> PyResult<Self> {
        let (a_mps2, axes) = (vector(a_mps2, "a_mps2")?, axes_of(axes)?);
        Ok(Self(SdkSetpoint::Acceleration { a_mps2, axes, yaw: yaw_target(yaw, yaw_rate)? }))
    }

    /// What it asks for: 'hold', 'velocity', ...
    #[getter]
    fn kind(&self) -> &'static str {
        match self.0 {
            SdkSetpoint::Hold => "hold",
            SdkSetpoint::Land => "land",
            SdkSetpoint::Position { .. } => "position",
            SdkSetpoint::Velocity { .. } => "velocity",
            SdkSetpoint::Acceleration { .. } => "acceleration",
        }
    }

    fn __eq__(&self, other: &Self) -> bool {
        self == other
    }

    fn __repr__(&self) -> String {
        let with = |name: &str, v: DVec3, axes: &str, yaw: YawTarget| {
            let yaw = match yaw {
                YawTarget::Keep => String::new(),
                YawTarget::Angle(angle_rad) => format!(", yaw={angle_rad}"),
                YawTarget::Rate(rate_radps) => format!(", yaw_rate={rate_radps}"),
            };
            format!("Setpoint.{name}({:?}{axes}{yaw})", v.to_array())
        };
        match self.0 {
            SdkSetpoint::Hold => "Setpoint.hold()".to_owned(),
            SdkSetpoint::Land => "Setpoint.land()".to_owned(),
            SdkSetpoint::Position { p_world_m, yaw } => with("position", p_world_m, "", yaw),
            SdkSetpoint::Velocity { v_mps, axes, yaw } => {
                with("velocity", v_mps, axes_text(axes), yaw)
            }
            SdkSetpoint::Acceleration { a_mps2, axes, yaw } => {
                with("acceleration", a_mps2, axes_text(axes), yaw)
            }
        }
    }
}

fn axes_text(axes: Axes) -> &'static str {
    match axes {
        Axes::World => "",
        Axes::Heading => ", axes='heading'",
    }
}

fn axes_of(axes: Given<'_, '_>) -> PyResult<Axes> {
    let Some(given) = axes else { return Ok(Axes::World) };
    let wanted = "'world' (x east, y north, z up) or 'heading' (x ahead, y left, z up)";
    let name: String = given.extract().map_err(|_| wrong_type(given, "axes", wanted))?;
    match name.as_str() {
        "world" => Ok(Axes::World),
        "heading" => Ok(Axes::Heading),
        _ => Err(PyValueError::new_err(format!("axes must be {wanted}, not '{name}'"))),
    }
}

fn yaw_target(yaw: Given<'_, '_>, yaw_rate: Given<'_, '_>) -> PyResult<YawTarget> {
    match (yaw, yaw_rate) {
        (None, None) => Ok(YawTarget::Keep),
        (Some(yaw), None) => {
            let wanted = "an angle from world x, counter-clockwise, in radians";
            Ok(YawTarget::Angle(scalar(yaw, "yaw", wanted)?))
        }
        (None, Some(rate)) => {
            let wanted = "a rate, counter-clockwise, in radians per second";
            Ok(YawTarget::Rate(scalar(rate, "yaw_rate", wanted)?))
        }
        (Some(_), Some(_)) => Err(PyTypeError::new_err(
            "give yaw (where to look) or yaw_rate (how fast to turn), not both",
        )),
    }
}
