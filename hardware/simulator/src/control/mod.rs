//! The autopilot's control cascade, 400 Hz: demand -> [`shape`] (limits acceleration and jerk) ->
//! [`position`] (velocity and position feedback -> acceleration) -> [`attitude`] (tilt limit,
//! attitude and rate feedback -> torque) -> [`mixer`] (four motors). No state outlives a disarm.

pub mod attitude;
pub mod mixer;
pub mod position;
pub mod shape;

/// Limits that parameters set.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Largest horizontal acceleration asked for. [m/s^2]
    pub horizontal_mps2: f64,
    /// Largest vertical acceleration asked for. [m/s^2]
    pub vertical_mps2: f64,
    /// Largest horizontal jerk. [m/s^3]
    pub horizontal_mps3: f64,
    /// Largest vertical jerk. [m/s^3]
    pub vertical_mps3: f64,
    /// Largest tilt. [rad]
    pub tilt_rad: f64,
}
