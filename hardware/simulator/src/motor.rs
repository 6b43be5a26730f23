//! Motor with propeller: command in, thrust and torque out, with lag.

use glam::DVec3;

use crate::airframe::{GRAVITY_MPS2, MASS_KG};

/// Thrust of all four motors at full throttle, divided by weight; value of the published vehicle.
pub const THRUST_TO_WEIGHT: f64 = 6.26;
/// Thrust of one motor at full throttle [N].
pub const MAX_THRUST_N: f64 = THRUST_TO_WEIGHT * MASS_KG * GRAVITY_MPS2 / 4.0;
/// First-order lag of rotor speed behind its command [s]: 4-inch propellers on 1400-size motors respond in 30-40 ms.
pub const TIME_CONSTANT_S: f64 = 0.035;
/// Reaction torque per thrust [m]. For a propeller of diameter D it is D C_P / (2 pi C_T); with C_P/C_T = 0.6 (4x3
/// propellers, UIUC propeller data) and D = 0.102 m: 0.0097.
pub const TORQUE_PER_THRUST_M: f64 = 0.01;
/// Moment of inertia of rotor and propeller [kg m^2]: a 3 g, 102 mm blade pair as a rod (m L^2 / 12 = 2.6e-6) plus an 8
/// g bell of 9 mm radius (m r^2 = 0.6e-6).
pub const ROTOR_INERTIA_KGM2: f64 = 3.2e-6;
/// Rotor speed at full throttle [rad/s]: thrust = C_T rho (n)^2 D^4 with C_T = 0.12 gives n = 620 1/s at 6.1 N.
pub const MAX_SPEED_RADPS: f64 = 3900.0;

/// Distance of a motor from the centre along each of x and y [m]: half of a 160 mm diagonal, at 45 degrees.
pub const ARM_M: f64 = 0.080 * std::f64::consts::FRAC_1_SQRT_2;

/// Position and direction of rotation of a motor.
#[derive(Clone, Copy, Debug)]
pub struct Mount {
    /// Position of the propeller [m, body].
    pub p_body_m: DVec3,
    /// Direction of rotation seen from above: +1 counter-clockwise, -1 clockwise.
    pub spin: f64,
}

const fn mount(x: f64, y: f64, spin: f64) -> Mount {
    Mount { p_body_m: DVec3::new(x * ARM_M, y * ARM_M, 0.03), spin }
}

/// Motors in ArduCopter's "quad X" order: front right, rear left (both counter-clockwise), front left, rear right (both
/// clockwise).
pub const MOUNTS: [Mount; 4] =
    [mount(1.0, -1.0, 1.0), mount(-1.0, 1.0, 1.0), mount(1.0, 1.0, -1.0), mount(-1.0, -1.0, -1.0)];

/// Returns the thrust [N] at a rotor speed, given as a fraction of full speed.
pub fn thrust_n(speed: f64) -> f64 {
    MAX_THRUST_N * speed * speed
}

/// Returns the rate of change of the rotor speed [1/s]; speed and command are fractions of full speed.
pub fn speed_rate(speed: f64, command: f64) -> f64 {
    (command - speed) / TIME_CONSTANT_S
}
