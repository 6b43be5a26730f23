//! The vehicle as a rigid body: motor commands in, pose, twist and specific force out.
//!
//! Fourth-order Runge-Kutta, 800 steps a second, world frame z up. Forces: four rotors with lag (see [`crate::motor`]),
//! gravity, linear and quadratic drag against the wind, gyroscopic torque of the rotors, and the floor as springs under
//! eight corners. The origin of `body` lies between the soles, so that its z is the floor's height when the vehicle
//! stands.

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};

use crate::motor::{
    ARM_M, MAX_SPEED_RADPS, MOUNTS, ROTOR_INERTIA_KGM2, TORQUE_PER_THRUST_M, speed_rate, thrust_n,
};

/// Standard gravity [m/s^2].
pub const GRAVITY_MPS2: f64 = 9.80665;
/// Mass ready to fly [kg]; value of the published vehicle.
pub const MASS_KG: f64 = 0.4;

/// Principal moments of inertia [kg m^2, body]. Derived: four motors with propellers of 20 g each at +-0.0566 m (4 m
/// d^2 = 2.56e-4 about x and y, 5.12e-4 about z), and 0.32 kg of battery, computer and frame as a box of 120 x 60 x 50
/// mm (m (b^2 + c^2) / 12 = 1.63e-4, 4.51e-4, 4.80e-4).
pub const INERTIA_KGM2: DVec3 = DVec3::new(4.2e-4, 7.1e-4, 9.9e-4);

/// Rotor drag, linear in airspeed [N s/m, body]: 0.2 per second in the rotor plane is typical of quadrotors of this
/// size (Faessler, Franchi, Scaramuzza, RA-L 2018, table II), less along the axis.
const LINEAR_DRAG: DVec3 = DVec3::new(0.08, 0.08, 0.04);
/// Frame drag, quadratic [N s^2/m^2, body]: rho C_d A / 2 with C_d = 1.1 and 100-150 cm^2 of frontal area.
const QUADRATIC_DRAG: DVec3 = DVec3::new(0.0070, 0.0080, 0.0120);

/// Stiffness of all soles together [N/m]: they sink [`SINK_M`] under the weight.
const FLOOR_STIFFNESS: f64 = MASS_KG * GRAVITY_MPS2 / SINK_M;
/// Compression of the soles when the vehicle stands [m].
const SINK_M: f64 = 0.004;
/// Damping of all soles together, critical for the mass: 2 sqrt(k m) [N s/m].
const FLOOR_DAMPING: f64 = 40.0;
/// Coefficient of friction of rubber on a gym mat.
const FRICTION: f64 = 0.8;
/// Creep speed up to which friction grows linearly, to keep the force smooth [m/s].
const CREEP_MPS: f64 = 0.02;
/// Maximum depth of the soles below the floor [m]; the vehicle is reset to it after any impact.
const DEEPEST_M: f64 = 0.05;
/// Maximum turn rate that the integrator follows at 800 Hz [rad/s]; crashes are limited to it.
const FASTEST_RADPS: f64 = 60.0;

/// Contact points: the four soles, and four points of the propeller plane for a vehicle on its back.
const CONTACTS: [DVec3; 8] = [
    DVec3::new(ARM_M, ARM_M, 0.0),
    DVec3::new(ARM_M, -ARM_M, 0.0),
    DVec3::new(-ARM_M, ARM_M, 0.0),
    DVec3::new(-ARM_M, -ARM_M, 0.0),
    DVec3::new(ARM_M, ARM_M, 0.05),
    DVec3::new(ARM_M, -ARM_M, 0.05),
    DVec3::new(-ARM_M, ARM_M, 0.05),
    DVec3::new(-ARM_M, -ARM_M, 0.05),
];

/// State of the integration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AirframeState {
    /// Position of the body's origin [m, world].
    pub p_world_m: DVec3,
    /// Velocity [m/s, world].
    pub v_world_mps: DVec3,
    /// Attitude, body to world.
    pub world_from_body: DQuat,
    /// Angular velocity [rad/s, body].
    pub omega_body_radps: DVec3,
    /// Rotor speeds as fractions of full speed.
    pub rotor_speed: [f64; 4],
}

impl AirframeState {
    /// Returns the pose.
    pub fn pose(&self) -> Pose<World, Body> {
        Pose::new(self.p_world_m, self.world_from_body)
    }
}

/// Time derivative of an [`AirframeState`].
#[derive(Clone, Copy)]
struct Derivative {
    p: DVec3,
    v: DVec3,
    q: DQuat,
    omega: DVec3,
    rotor: [f64; 4],
}

/// Simulated vehicle.
#[derive(Clone, Debug)]
pub struct Airframe {
    state: AirframeState,
    floor_z_m: f64,
    wind_world_mps: DVec3,
    /// Share of its nominal thrust that each rotor gives.
    soundness: [f64; 4],
    specific_force_body: DVec3,
}

impl Airframe {
    /// Places the vehicle on the floor at `p_world_m` [m, world], whose z is the floor's height.
    pub fn standing(p_world_m: DVec3, yaw_rad: f64) -> Self {
        Self {
            state: AirframeState {
                p_world_m,
                v_world_mps: DVec3::ZERO,
                world_from_body: DQuat::from_rotation_z(yaw_rad),
                omega_body_radps: DVec3::ZERO,
                rotor_speed: [0.0; 4],
            },
            floor_z_m: p_world_m.z,
            wind_world_mps: DVec3::ZERO,
            soundness: [1.0; 4],
            specific_force_body: DVec3::Z * GRAVITY_MPS2,
        }
    }

    /// Places the vehicle in the air [m, world]: level, at rest, with rotors carrying its weight.
    pub fn hovering(p_world_m: DVec3, yaw_rad: f64, floor_z_m: f64) -> Self {
        let standing = Self::standing(p_world_m, yaw_rad);
        let rotor_speed = [(MASS_KG * GRAVITY_MPS2 / 4.0 / thrust_n(1.0)).sqrt(); 4];
        Self { state: AirframeState { rotor_speed, ..standing.state }, floor_z_m, ..standing }
    }

    pub fn state(&self) -> &AirframeState {
        &self.state
    }

    /// Returns the floor's height [m, world].
    pub fn floor_z_m(&self) -> f64 {
        self.floor_z_m
    }

    /// Sets the wind [m/s, world].
    pub fn set_wind(&mut self, wind_world_mps: DVec3) {
        self.wind_world_mps = wind_world_mps;
    }

    /// Reduces the thrust of a motor (ArduCopter's order, from 0) to this share from now on.
    pub fn break_motor(&mut self, motor: usize, share: f64) {
        self.soundness[motor] = share.clamp(0.0, 1.0);
    }

    /// Returns the mean specific force over the last tick [m/s^2, body], as an ideal accelerometer measures it.
    pub fn specific_force_body_mps2(&self) -> DVec3 {
        self.specific_force_body
    }

    /// Whether a sole or a propeller touches the floor.
    pub fn touches_floor(&self) -> bool {
        CONTACTS.iter().any(|&corner| {
            let p = self.state.pose().transform_point(corner);
            p.z < self.floor_z_m + SINK_M
        })
    }

    /// Simulates `dt_s` with motor commands: fractions of full speed, in ArduCopter's order. `dt_s` must be at most 2.5
    /// ms, because of the floor's springs.
    pub fn tick(&mut self, commands: [f64; 4], dt_s: f64) {
        let commands = commands.map(|c| if c >= 0.0 { c.min(1.0) } else { 0.0 });
        let before = self.state;
        let k1 = self.derivative(&before, commands);
        let k2 = self.derivative(&advance(&before, &k1, dt_s / 2.0), commands);
        let k3 = self.derivative(&advance(&before, &k2, dt_s / 2.0), commands);
        let k4 = self.derivative(&advance(&before, &k3, dt_s), commands);
        let blend = |a: DVec3, b: DVec3, c: DVec3, d: DVec3| (a + 2.0 * b + 2.0 * c + d) / 6.0;
        let mean = Derivative {
            p: blend(k1.p, k2.p, k3.p, k4.p),
            v: blend(k1.v, k2.v, k3.v, k4.v),
            q: (k1.q + k2.q * 2.0 + k3.q * 2.0 + k4.q) * (1.0 / 6.0),
            omega: blend(k1.omega, k2.omega, k3.omega, k4.omega),
            rotor: std::array::from_fn(|i| {
                (k1.rotor[i] + 2.0 * k2.rotor[i] + 2.0 * k3.rotor[i] + k4.rotor[i]) / 6.0
            }),
        };
        let mut after = advance(&before, &mean, dt_s);
        after.world_from_body = after.world_from_body.normalize();
        after.omega_body_radps = after.omega_body_radps.clamp_length_max(FASTEST_RADPS);
        let depth_m = self.floor_z_m - DEEPEST_M - after.p_world_m.z;
        if depth_m > 0.0 {
            after.p_world_m.z += depth_m;
            after.v_world_mps.z = after.v_world_mps.z.max(0.0);
        }
        // Computed from the velocities, so that it includes every force, also contact.
        let a_world = (after.v_world_mps - before.v_world_mps) / dt_s;
        let midway =
            (before.world_from_body + after.world_from_body * sign(&before, &after)).normalize();
        self.specific_force_body = midway.conjugate() * (a_world + DVec3::Z * GRAVITY_MPS2);
        self.state = after;
    }

    fn derivative(&self, s: &AirframeState, commands: [f64; 4]) -> Derivative {
        let thrusts: [f64; 4] =
            std::array::from_fn(|i| thrust_n(s.rotor_speed[i]) * self.soundness[i]);
        let mut torque = DVec3::ZERO;
        let mut rotor_momentum = 0.0;
        for ((mount, thrust), speed) in MOUNTS.iter().zip(thrusts).zip(s.rotor_speed) {
            torque += mount.p_body_m.cross(DVec3::Z * thrust);
            // A propeller that turns counter-clockwise drags the frame clockwise.
            torque.z -= mount.spin * TORQUE_PER_THRUST_M * thrust;
            rotor_momentum += mount.spin * ROTOR_INERTIA_KGM2 * MAX_SPEED_RADPS * speed;
        }
        torque -= s.omega_body_radps.cross(DVec3::Z * rotor_momentum);
        torque -= s.omega_body_radps.cross(INERTIA_KGM2 * s.omega_body_radps);

        let air_body = s.world_from_body.conjugate() * (s.v_world_mps - self.wind_world_mps);
        let drag_body = -(LINEAR_DRAG * air_body + QUADRATIC_DRAG * air_body * air_body.abs());
        let lift_body = DVec3::Z * thrusts.iter().sum::<f64>();
        let mut force_world = s.world_from_body * (lift_body + drag_body);

        if s.p_world_m.z < self.floor_z_m + 0.2 {
            let (contact_force, contact_torque) = self.floor_reaction(s);
            force_world += contact_force;
            torque += contact_torque;
        }
        let omega = s.omega_body_radps;
        Derivative {
            p: s.v_world_mps,
            v: force_world / MASS_KG - DVec3::Z * GRAVITY_MPS2,
            q: s.world_from_body * DQuat::from_xyzw(omega.x, omega.y, omega.z, 0.0) * 0.5,
            omega: torque / INERTIA_KGM2,
            rotor: std::array::from_fn(|i| speed_rate(s.rotor_speed[i], commands[i])),
        }
    }

    /// Returns force [N, world] and torque [N m, body] of the floor.
    fn floor_reaction(&self, s: &AirframeState) -> (DVec3, DVec3) {
        let (mut force, mut torque) = (DVec3::ZERO, DVec3::ZERO);
        for corner in CONTACTS {
            let arm_world = s.world_from_body * corner;
            let sunk_m = self.floor_z_m + SINK_M - (s.p_world_m.z + arm_world.z);
            if !(sunk_m > 0.0) {
                continue;
            }
            let v = s.v_world_mps + s.world_from_body * s.omega_body_radps.cross(corner);
            // A quarter for each sole; a floor only pushes.
            let normal = (FLOOR_STIFFNESS * sunk_m - FLOOR_DAMPING * v.z).max(0.0) / 4.0;
            let slip = DVec3::new(v.x, v.y, 0.0);
            let friction = -slip * (FRICTION * normal / slip.length().max(CREEP_MPS));
            let push = friction + DVec3::Z * normal;
            force += push;
            torque += s.world_from_body.conjugate() * arm_world.cross(push);
        }
        (force, torque)
    }
}

fn advance(s: &AirframeState, d: &Derivative, dt_s: f64) -> AirframeState {
    AirframeState {
        p_world_m: s.p_world_m + d.p * dt_s,
        v_world_mps: s.v_world_mps + d.v * dt_s,
        world_from_body: s.world_from_body + d.q * dt_s,
        omega_body_radps: s.omega_body_radps + d.omega * dt_s,
        rotor_speed: std::array::from_fn(|i| {
            (s.rotor_speed[i] + d.rotor[i] * dt_s).clamp(0.0, 1.0)
        }),
    }
}

/// Returns +1 or -1: the factor that brings both quaternions to the same half of the sphere.
fn sign(before: &AirframeState, after: &AirframeState) -> f64 {
    1f64.copysign(before.world_from_body.dot(after.world_from_body))
}

#[cfg(test)]
mod tests;
