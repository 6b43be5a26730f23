//! Setpoints that a plugin returns.

use numpy::ndarray::ArrayViewD;
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::protocol::messages::{COEFFICIENTS, InvalidSetpoint, MAX_PIECES, MAX_WAYPOINTS};
use vizflyt_sdk::{
    Axes, Path, PathYaw, Piece, Setpoint as SdkSetpoint, Trajectory, Waypoint, YawTarget,
};

use crate::arguments::{NotFiniteError, Points, numbers, scalar, vector, wrong_shape, wrong_type};

/// Requested motion of the vehicle. The newest setpoint stays in force until the guard's deadline of 0.5 s.
///
/// `yaw` is the direction of the nose: an angle from world x, counter-clockwise [rad]. `yaw_rate` is the rate of
/// turn, counter-clockwise [rad/s]. Without either, the heading does not change; on a path the nose points in
/// the direction of travel.
///
/// `axes` are the axes of a vector: 'world' (x east, y north, z up), 'heading' (x along the nose, y left, z up,
/// level: forward never points at the floor) or 'body' (x forward, y left, z up, with the vehicle's current
/// tilt).
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
            "create a Setpoint with one of: Setpoint.velocity([x, y, z]), .position, .offset, \
             .acceleration, .waypoints, .hold() or .land()",
        ))
    }

    /// Stop and stay.
    #[staticmethod]
    fn hold() -> Self {
        Self(SdkSetpoint::Hold)
    }

    /// Land here and disarm.
    #[staticmethod]
    fn land() -> Self {
        Self(SdkSetpoint::Land)
    }

    /// Climb or descend vertically to the height at which the plugin got control after take-off. (The runtime
    /// takes off automatically as soon as the plugin replies to images.)
    #[staticmethod]
    fn take_off() -> Self {
        Self(SdkSetpoint::TakeOff)
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

    /// Fly to a point (3,) relative to the vehicle's position at the time when the runtime takes the setpoint,
    /// and stay: for plugins that do not have their position. [m, axes]
    #[staticmethod]
    #[pyo3(signature = (d_m, *, axes = None, yaw = None, yaw_rate = None))]
    fn offset(
        d_m: &Bound<'_, PyAny>,
        axes: Given<'_, '_>,
        yaw: Given<'_, '_>,
        yaw_rate: Given<'_, '_>,
    ) -> PyResult<Self> {
        let (d_m, axes) = (vector(d_m, "d_m")?, axes_of(axes)?);
        Ok(Self(SdkSetpoint::Offset { d_m, axes, yaw: yaw_target(yaw, yaw_rate)? }))
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

    /// Accelerate (3,). Gravity is compensated: zero keeps the velocity. [m/s^2, axes]
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

    /// Turn at body rates (3,) [rad/s, body] with a thrust of all motors, relative to the vehicle's weight: 1
    /// carries the level vehicle. Only if the course allows it (`ArenaInfo.attitude_rate`).
    #[staticmethod]
    fn attitude_rate(
        omega_body_radps: &Bound<'_, PyAny>,
        thrust: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let omega_body_radps = vector(omega_body_radps, "omega_body_radps")?;
        let thrust = scalar(thrust, "thrust", "a number, 1 being the vehicle's weight")?;
        Ok(Self(SdkSetpoint::AttitudeRate { omega_body_radps, thrust }))
    }

    /// Follow straight lines through up to 32 points (N, 3) [m, axes], with a maximum speed of `speed_mps` (one
    /// number, or one per point for the way to it) [m/s], and stay at the last point.
    ///
    /// The runtime follows the path as long as the plugin replies to images, with None or the same path. A path
    /// with another `id` starts from its first point. With axes 'heading' or 'body', the points are relative to
    /// the vehicle's position at the time when the runtime takes the path.
    #[staticmethod]
    #[pyo3(signature = (
        points_m, speed_mps = None, *, id = 0, axes = None, yaw = None, yaw_rate = None
    ))]
    fn waypoints(
        points_m: &Bound<'_, PyAny>,
        speed_mps: Given<'_, '_>,
        id: u32,
        axes: Given<'_, '_>,
        yaw: Given<'_, '_>,
        yaw_rate: Given<'_, '_>,
    ) -> PyResult<Self> {
        let points = Points::take(points_m, "points_m")?.points;
        if points.len() > MAX_WAYPOINTS {
            return Err(too_many("points_m", "points", points.len(), MAX_WAYPOINTS));
        }
        let speeds_mps = match speed_mps {
            None => vec![WAYPOINT_MPS; points.len()],
            Some(given) => one_or_each(given, "speed_mps", points.len(), "point")?,
        };
        let waypoints = points.iter().zip(speeds_mps);
        let path = waypoints.map(|(&p_m, speed_mps)| Waypoint { p_m, speed_mps }).collect();
        trajectory(id, axes, Path::Waypoints(path), yaw, yaw_rate)
    }

    /// Follow up to 8 polynomial pieces, one after the other. Piece i takes `seconds[i]` [s]; t seconds after
    /// its start, the position is the sum of `coefficients[i, k] * t**k`. `coefficients` has the shape (pieces,
    /// up to 8, 3). [m/s^k, axes]
    ///
    /// Otherwise as `waypoints`.
    #[staticmethod]
    #[pyo3(signature = (
        seconds, coefficients, *, id = 0, axes = None, yaw = None, yaw_rate = None
    ))]
    fn polynomial(
        seconds: &Bound<'_, PyAny>,
        coefficients: &Bound<'_, PyAny>,
        id: u32,
        axes: Given<'_, '_>,
        yaw: Given<'_, '_>,
        yaw_rate: Given<'_, '_>,
    ) -> PyResult<Self> {
        let wanted = "an array of shape (pieces, up to 8, 3)";
        let array = numbers(coefficients, "coefficients", wanted)?;
        let array: ArrayViewD<'_, f64> = array.as_array();
        let &[count, terms, 3] = array.shape() else {
            return Err(wrong_shape(coefficients, "coefficients", wanted));
        };
        if terms > COEFFICIENTS || terms == 0 {
            return Err(wrong_shape(coefficients, "coefficients", wanted));
        }
        if count > MAX_PIECES {
            return Err(too_many("coefficients", "pieces", count, MAX_PIECES));
        }
        let seconds = one_or_each(seconds, "seconds", count, "piece")?;
        let pieces = seconds.into_iter().enumerate().map(|(at, seconds)| {
            let mut piece = Piece { seconds, ..Piece::default() };
            for (k, coefficient) in piece.coefficients[..terms].iter_mut().enumerate() {
                *coefficient = DVec3::new(array[[at, k, 0]], array[[at, k, 1]], array[[at, k, 2]]);
            }
            piece
        });
        trajectory(id, axes, Path::Polynomial(pieces.collect()), yaw, yaw_rate)
    }

    /// Kind of setpoint: 'hold', 'land', 'take_off', 'position', 'offset', 'velocity', 'acceleration',
    /// 'attitude_rate' or 'trajectory'.
    #[getter]
    fn kind(&self) -> &'static str {
        match self.0 {
            SdkSetpoint::Hold => "hold",
            SdkSetpoint::Land => "land",
            SdkSetpoint::TakeOff => "take_off",
            SdkSetpoint::Position { .. } => "position",
            SdkSetpoint::Offset { .. } => "offset",
            SdkSetpoint::Velocity { .. } => "velocity",
            SdkSetpoint::Acceleration { .. } => "acceleration",
            SdkSetpoint::AttitudeRate { .. } => "attitude_rate",
            SdkSetpoint::Trajectory(_) => "trajectory",
        }
    }

    fn __eq__(&self, other: &Self) -> bool {
        self == other
    }

    fn __repr__(&self) -> String {
        let with = |name: &str, v: DVec3, axes: Axes, yaw: YawTarget| {
            format!("Setpoint.{name}({:?}{}{})", v.to_array(), axes_text(axes), yaw_text(yaw))
        };
        match &self.0 {
            SdkSetpoint::Hold => "Setpoint.hold()".to_owned(),
            SdkSetpoint::Land => "Setpoint.land()".to_owned(),
            SdkSetpoint::TakeOff => "Setpoint.take_off()".to_owned(),
            &SdkSetpoint::Position { p_world_m, yaw } => {
                with("position", p_world_m, Axes::World, yaw)
            }
            &SdkSetpoint::Offset { d_m, axes, yaw } => with("offset", d_m, axes, yaw),
            &SdkSetpoint::Velocity { v_mps, axes, yaw } => with("velocity", v_mps, axes, yaw),
            &SdkSetpoint::Acceleration { a_mps2, axes, yaw } => {
                with("acceleration", a_mps2, axes, yaw)
            }
            SdkSetpoint::AttitudeRate { omega_body_radps, thrust } => {
                format!("Setpoint.attitude_rate({:?}, {thrust})", omega_body_radps.to_array())
            }
            SdkSetpoint::Trajectory(trajectory) => trajectory_text(trajectory),
        }
    }
}

/// Default speed on a path: walking speed. [m/s]
const WAYPOINT_MPS: f64 = 1.0;

fn trajectory(
    id: u32,
    axes: Given<'_, '_>,
    path: Path,
    yaw: Given<'_, '_>,
    yaw_rate: Given<'_, '_>,
) -> PyResult<Setpoint> {
    let axes = axes_of(axes)?;
    let yaw = match yaw_target(yaw, yaw_rate)? {
        YawTarget::Keep => PathYaw::Ahead,
        target => PathYaw::Target(target),
    };
    let trajectory = Trajectory { id, axes, path, yaw };
    trajectory.check().map_err(|error| match error {
        InvalidSetpoint::NotFinite => NotFiniteError::new_err(error.to_string()),
        error => PyValueError::new_err(error.to_string()),
    })?;
    Ok(Setpoint(SdkSetpoint::Trajectory(trajectory)))
}

fn trajectory_text(trajectory: &Trajectory) -> String {
    let yaw = match trajectory.yaw {
        PathYaw::Ahead => String::new(),
        PathYaw::Target(yaw) => yaw_text(yaw),
    };
    let end = format!(", id={}{}{yaw})", trajectory.id, axes_text(trajectory.axes));
    match &trajectory.path {
        Path::Waypoints(points) => {
            let speeds_mps: Vec<f64> = points.iter().map(|point| point.speed_mps).collect();
            let points: Vec<_> = points.iter().map(|point| point.p_m.to_array()).collect();
            format!("Setpoint.waypoints({points:?}, {speeds_mps:?}{end}")
        }
        Path::Polynomial(pieces) => {
            let seconds: Vec<f64> = pieces.iter().map(|piece| piece.seconds).collect();
            let pieces: Vec<_> =
                pieces.iter().map(|p| p.coefficients.map(|c| c.to_array())).collect();
            format!("Setpoint.polynomial({seconds:?}, {pieces:?}{end}")
        }
    }
}

fn one_or_each(
    given: &Bound<'_, PyAny>,
    name: &str,
    count: usize,
    what: &str,
) -> PyResult<Vec<f64>> {
    let wanted = format!("one number, or {count}: one per {what}");
    let array = numbers(given, name, &wanted)?;
    let array: ArrayViewD<'_, f64> = array.as_array();
    match *array.shape() {
        [] => Ok(vec![array.iter().copied().next().unwrap_or(f64::NAN); count]),
        [len] if len == count => Ok(array.iter().copied().collect()),
        _ => Err(wrong_shape(given, name, &wanted)),
    }
}

fn too_many(name: &str, what: &str, found: usize, most: usize) -> PyErr {
    PyValueError::new_err(format!(
        "{name} has {found} {what}, but a path has at most {most}: send the rest, under another id, when \
         the vehicle is near its end"
    ))
}

fn axes_text(axes: Axes) -> &'static str {
    match axes {
        Axes::World => "",
        Axes::Heading => ", axes='heading'",
        Axes::Body => ", axes='body'",
    }
}

fn yaw_text(yaw: YawTarget) -> String {
    match yaw {
        YawTarget::Keep => String::new(),
        YawTarget::Angle(angle_rad) => format!(", yaw={angle_rad}"),
        YawTarget::Rate(rate_radps) => format!(", yaw_rate={rate_radps}"),
    }
}

fn axes_of(axes: Given<'_, '_>) -> PyResult<Axes> {
    let Some(given) = axes else { return Ok(Axes::World) };
    let wanted = "'world' (x east, y north, z up), 'heading' (x ahead, y left, z up) or 'body' (x \
                  forward, y left, z up, tilted)";
    let name: String = given.extract().map_err(|_| wrong_type(given, "axes", wanted))?;
    match name.as_str() {
        "world" => Ok(Axes::World),
        "heading" => Ok(Axes::Heading),
        "body" => Ok(Axes::Body),
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
