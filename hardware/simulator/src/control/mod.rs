//! The autopilot's control cascade, 400 Hz: demand -> [`shape`] (limits acceleration and jerk) -> [`position`]
//! (velocity and position feedback -> acceleration) -> [`attitude`] (tilt limit, attitude and rate feedback -> torque)
//! -> [`mixer`] (four motors). All state is reset at disarm.

pub mod attitude;
pub mod mixer;
pub mod position;
pub mod shape;

/// Limits, set by parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Maximum horizontal acceleration target [m/s^2].
    pub horizontal_mps2: f64,
    /// Maximum vertical acceleration target [m/s^2].
    pub vertical_mps2: f64,
    /// Maximum horizontal jerk [m/s^3].
    pub horizontal_mps3: f64,
    /// Maximum vertical jerk [m/s^3].
    pub vertical_mps3: f64,
    /// Maximum tilt [rad].
    pub tilt_rad: f64,
}
