//! A path that the runtime follows on the plugin's behalf.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::setpoint::{Axes, InvalidSetpoint, YawTarget};

/// Most waypoints of one trajectory.
pub const MAX_WAYPOINTS: usize = 32;
/// Most polynomial pieces of one trajectory.
pub const MAX_PIECES: usize = 8;
/// Coefficients of a piece: degree 7, as minimum-snap planners make.
pub const COEFFICIENTS: usize = 8;

/// A path to follow from the moment the runtime takes it, to its end, where the vehicle stays.
///
/// It is in force, without being sent again, as long as the plugin answers images at all, with
/// `None` or with the same trajectory; any other setpoint ends it, and so does a trajectory of
/// another `id`. A vehicle that the guard slows down does not lose its path: the path waits.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Trajectory {
    /// The plugin's own number for it: the same one goes on, another one starts a new flight along it.
    pub id: u32,
    /// Axes of the points. With [`Axes::Heading`] and [`Axes::Body`] they count from where the
    /// vehicle is, and along how it points, when the runtime takes the trajectory.
    pub axes: Axes,
    /// The points.
    pub path: Path,
    /// Where the nose shall point on the way.
    pub yaw: PathYaw,
}

/// The shape of a [`Trajectory`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(clippy::large_enum_variant)] // Why: there is no heap here to box it on.
pub enum Path {
    /// Straight from each point to the next, slower at corners, stopping at the last.
    Waypoints(heapless::Vec<Waypoint, MAX_WAYPOINTS>),
    /// One piece after the other, each in its time.
    Polynomial(heapless::Vec<Piece, MAX_PIECES>),
}

impl Default for Path {
    fn default() -> Self {
        Self::Waypoints(heapless::Vec::new())
    }
}

/// A point to pass, and how fast to fly there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Waypoint {
    /// Where. [m, axes of the trajectory]
    pub p_m: DVec3,
    /// Greatest speed on the way to it. [m/s]
    pub speed_mps: f64,
}

/// A polynomial in time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Piece {
    /// How long it lasts. [s]
    pub seconds: f64,
    /// Position after `t` seconds of this piece is the sum of `coefficients[k] * t^k`.
    /// [m/s^k, axes of the trajectory]
    pub coefficients: [DVec3; COEFFICIENTS],
}

impl Piece {
    /// Returns the position after `t_s` seconds of this piece. [m, axes of the trajectory]
    pub fn position_m(&self, t_s: f64) -> DVec3 {
        self.coefficients.iter().rev().fold(DVec3::ZERO, |sum, &c| sum * t_s + c)
    }

    /// Returns the velocity after `t_s` seconds of this piece. [m/s, axes of the trajectory]
    pub fn velocity_mps(&self, t_s: f64) -> DVec3 {
        let derivative = self.coefficients.iter().enumerate().skip(1).rev();
        derivative.fold(DVec3::ZERO, |sum, (k, &c)| sum * t_s + c * k as f64)
    }
}

/// Where the nose points on a [`Trajectory`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PathYaw {
    /// Into the direction of travel, so that the front camera sees what comes.
    #[default]
    Ahead,
    /// As for other setpoints.
    Target(YawTarget),
}

impl Trajectory {
    /// Checks that it can be followed.
    ///
    /// # Errors
    /// The first fault found.
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
    fn a_piece_is_its_polynomial() {
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
    fn invalid_trajectories_are_refused() {
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
