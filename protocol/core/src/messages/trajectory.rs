//! Trajectories that the runtime follows for the plugin.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::setpoint::{Axes, InvalidSetpoint, YawTarget};

/// Maximum number of waypoints in a trajectory.
pub const MAX_WAYPOINTS: usize = 32;
/// Maximum number of polynomial pieces in a trajectory.
pub const MAX_PIECES: usize = 8;
/// Number of coefficients of a piece: degree 7, as in minimum-snap planners.
pub const COEFFICIENTS: usize = 8;

/// Path to follow from the time at which the runtime receives it to its end, where the vehicle stays.
///
/// A trajectory stays active without being sent again, while the plugin answers images with `None` or with the same
/// trajectory. Any other setpoint or a trajectory with another `id` ends it. If the guard slows the vehicle down, the
/// path waits for it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Trajectory {
    /// Number chosen by the plugin. The same number continues the flight along the path, another one starts a new
    /// flight.
    pub id: u32,
    /// Axes of the points. With [`Axes::Heading`] and [`Axes::Body`], they are relative to the vehicle's position and
    /// orientation when the runtime receives the trajectory.
    pub axes: Axes,
    /// Shape of the path.
    pub path: Path,
    /// Yaw along the path.
    pub yaw: PathYaw,
}

/// Shape of a [`Trajectory`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(clippy::large_enum_variant)] // Why: there is no heap here to box it on.
pub enum Path {
    /// Straight lines between the points, slower at corners, with a stop at the last point.
    Waypoints(heapless::Vec<Waypoint, MAX_WAYPOINTS>),
    /// Polynomial pieces in sequence, each with its own duration.
    Polynomial(heapless::Vec<Piece, MAX_PIECES>),
}

impl Default for Path {
    fn default() -> Self {
        Self::Waypoints(heapless::Vec::new())
    }
}

/// Point to pass, with a maximum speed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Waypoint {
    /// Position. [m, axes of the trajectory]
    pub p_m: DVec3,
    /// Maximum speed on the way to this point. [m/s]
    pub speed_mps: f64,
}

/// Polynomial in time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Piece {
    /// Duration. [s]
    pub seconds: f64,
    /// Coefficients: the position `t` seconds after the start of this piece is the sum of `coefficients[k] * t^k`.
    /// [m/s^k, axes of the trajectory]
    pub coefficients: [DVec3; COEFFICIENTS],
}

impl Piece {
    /// Returns the position `t_s` seconds after the start of this piece. [m, axes of the trajectory]
    pub fn position_m(&self, t_s: f64) -> DVec3 {
        self.coefficients.iter().rev().fold(DVec3::ZERO, |sum, &c| sum * t_s + c)
    }

    /// Returns the velocity `t_s` seconds after the start of this piece. [m/s, axes of the trajectory]
    pub fn velocity_mps(&self, t_s: f64) -> DVec3 {
        let derivative = self.coefficients.iter().enumerate().skip(1).rev();
        derivative.fold(DVec3::ZERO, |sum, (k, &c)| sum * t_s + c * k as f64)
    }
}

/// Yaw along a [`Trajectory`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PathYaw {
    /// In the direction of travel, so that the front camera sees the path ahead.
    #[default]
    Ahead,
    /// A yaw target, as for other setpoints.
    Target(YawTarget),
}

impl Trajectory {
    /// Checks that the trajectory is valid.
    ///
    /// # Errors
    /// Returns the first error found.
    pub fn check(&self) -> Result<(), InvalidSetpoint> {
        let finite = |is: bool| if is { Ok(()) } else { Err(InvalidSetpoint::NotFinite) };
        if let PathYaw::Target(yaw) = self.yaw {
            finite(yaw.is_finite())?;
        }
        match &self.path {
            Path::Waypoints(points) => {
                for point in points {
                    finite(point.p_m.is_finite() && point.speed_mps.is_finite())?;
                    if !(point.speed_mps > 0.0) {
                        return Err(InvalidSetpoint::Speed(point.speed_mps));
                    }
                }
                if points.is_empty() { Err(InvalidSetpoint::Empty) } else { Ok(()) }
            }
            Path::Polynomial(pieces) => {
                for piece in pieces {
                    let numbers = piece.coefficients.iter().all(|c| c.is_finite());
                    finite(numbers && piece.seconds.is_finite())?;
                    if !(piece.seconds > 0.0) {
                        return Err(InvalidSetpoint::Duration(piece.seconds));
                    }
                }
                if pieces.is_empty() { Err(InvalidSetpoint::Empty) } else { Ok(()) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evaluates_a_polynomial_piece() {
        // x = 1 + 2 t + 3 t^2, z = t^7.
        let mut piece = Piece { seconds: 2.0, ..Piece::default() };
        piece.coefficients[0] = DVec3::X;
        piece.coefficients[1] = DVec3::X * 2.0;
        piece.coefficients[2] = DVec3::X * 3.0;
        piece.coefficients[7] = DVec3::Z;
        assert_eq!(piece.position_m(2.0), DVec3::new(17.0, 0.0, 128.0));
        assert_eq!(piece.velocity_mps(2.0), DVec3::new(14.0, 0.0, 448.0));
    }

    #[test]
    fn rejects_invalid_trajectories() {
        let way = |p_m, speed_mps| Trajectory {
            path: Path::Waypoints([Waypoint { p_m, speed_mps }].into_iter().collect()),
            ..Trajectory::default()
        };
        assert_eq!(way(DVec3::ONE, 1.0).check(), Ok(()));
        assert_eq!(way(DVec3::NAN, 1.0).check(), Err(InvalidSetpoint::NotFinite));
        assert_eq!(way(DVec3::ONE, 0.0).check(), Err(InvalidSetpoint::Speed(0.0)));
        assert_eq!(Trajectory::default().check(), Err(InvalidSetpoint::Empty));
        let piece = |seconds| Trajectory {
            path: Path::Polynomial([Piece { seconds, ..Piece::default() }].into_iter().collect()),
            ..Trajectory::default()
        };
        assert_eq!(piece(1.0).check(), Ok(()));
        assert_eq!(piece(-1.0).check(), Err(InvalidSetpoint::Duration(-1.0)));
        let turned =
            Trajectory { yaw: PathYaw::Target(YawTarget::Angle(f64::NAN)), ..way(DVec3::ONE, 1.0) };
        assert_eq!(turned.check(), Err(InvalidSetpoint::NotFinite));
    }
}
