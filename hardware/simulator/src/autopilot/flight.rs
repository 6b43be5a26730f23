//! Flight behaviour of each mode, and landing detection.

use glam::DVec3;
use vizflyt_protocol::geometry::{wrap_pi, yaw_of};
use vizflyt_protocol::mavlink::{CopterMode, GuidedMotion};
use vizflyt_protocol::messages::YawTarget;
use vizflyt_protocol::time::AutopilotTime;

use super::{Autopilot, Guided, Param, Return, airframe};
use crate::airframe::{GRAVITY_MPS2, MASS_KG};
use crate::control::Limits;
use crate::control::attitude::Heading;
use crate::control::mixer::{IDLE_SPEED, mix};
use crate::control::position::{Horizontal, Vertical};
use crate::control::shape::sqrt_rate;
use crate::motor::THRUST_TO_WEIGHT;

/// Thrust as a share of weight below which something else must carry the vehicle.
const CARRIED: f64 = 0.35;
/// Time until the vehicle counts as landed [s].
const LANDED_S: f64 = 1.0;
/// Maximum speed of a vehicle on the ground [m/s].
const LANDED_MPS: f64 = 0.3;
/// Maximum acceleration of a vehicle on the ground, filtered at [`SHAKE_CUTOFF`] [m/s^2].
const LANDED_MPS2: f64 = 1.5;
const SHAKE_CUTOFF: f64 = 12.0; // [rad/s]
/// Height error at which a take-off is complete [m].
const REACHED_M: f64 = 0.05;
/// A failsafe's LAND hovers until this time after LAND began (ArduCopter's `LAND_WITH_DELAY_MS`) [s].
const LAND_PAUSE_S: f64 = 4.0;
/// Sink rate of LAND per height above LAND_ALT_LOW_M (ArduCopter's `PSC_D_POS_P`) [1/s].
const LAND_GAIN_PER_S: f64 = 1.0;
/// Minimum speed, as a share of WP_SPD, at which the nose follows the direction of travel.
const LOOK_AHEAD_SHARE: f64 = 0.05;

/// State of [`Autopilot::fly`] between ticks.
#[derive(Clone, Copy, Debug)]
pub(super) struct FlightState {
    /// Commanded thrust divided by weight.
    lift: f64,
    /// Filtered acceleration [m/s^2, world].
    shake: DVec3,
    carried_s: f64,
    /// Time armed on the ground [s].
    idle_s: f64,
    /// Yaw target.
    pub(super) yaw: YawTarget,
    /// Time tilted beyond recovery [s].
    pub(super) toppled_s: f64,
    /// Time since arming [s]; motors spool up first.
    pub(super) armed_s: f64,
}

impl Default for FlightState {
    fn default() -> Self {
        Self {
            lift: 0.0,
            shake: DVec3::ZERO,
            carried_s: 0.0,
            idle_s: 0.0,
            yaw: YawTarget::Keep,
            toppled_s: 0.0,
            armed_s: 0.0,
        }
    }
}

/// Returns the limits of a vehicle with the parameters of `hardware/airframe`.
///
/// # Panics
/// If the autopilot lacks one of these parameters; a test sets all of them.
pub fn airframe_limits() -> Limits {
    Autopilot::with_params(&airframe()).expect("the airframe's parameters are known").limits()
}

/// Demand of a flight mode.
enum Demand {
    Idle,
    Motion(Horizontal, Vertical),
}

impl Autopilot {
    /// Runs one tick of flight. Returns the motor commands.
    pub(super) fn fly(&mut self, now: AutopilotTime, dt_s: f64) -> [f64; 4] {
        let yaw_rad = yaw_of(self.estimator.estimate().world_from_body);
        if !self.armed {
            self.stand(yaw_rad);
            return [0.0; 4];
        }
        self.flight.armed_s += dt_s;
        let demand = if self.landed { Demand::Idle } else { self.demand(now, dt_s) };
        let motors = match demand {
            Demand::Idle => {
                self.stand(yaw_rad);
                [IDLE_SPEED; 4]
            }
            Demand::Motion(horizontal, vertical) => {
                self.steer(now, horizontal, dt_s);
                let limits = self.limits();
                let estimate = *self.estimator.estimate();
                let acceleration = self.position.update(
                    &estimate,
                    horizontal,
                    vertical,
                    &limits,
                    self.saturated,
                    dt_s,
                );
                let wrench =
                    self.attitude.update(&estimate, acceleration, self.heading, &limits, dt_s);
                self.saturated = wrench.saturated;
                self.flight.lift = wrench.thrust_n / (MASS_KG * GRAVITY_MPS2);
                mix(&wrench)
            }
        };
        self.detect_landing(dt_s);
        motors
    }

    /// Keeps the controllers reset while the vehicle does not fly.
    fn stand(&mut self, yaw_rad: f64) {
        let estimate = *self.estimator.estimate();
        self.position.reset(&estimate);
        self.attitude.reset();
        self.heading = Heading { yaw_rad, rate_radps: 0.0 };
        self.flight.yaw = YawTarget::Keep;
        self.flight.lift = 0.0;
        self.saturated = false;
    }

    fn limits(&self) -> Limits {
        let value = |param| self.params.value(param);
        Limits {
            horizontal_mps2: value(Param::WpAcceleration),
            vertical_mps2: value(Param::WpAccelerationZ),
            horizontal_mps3: value(Param::JerkHorizontal),
            vertical_mps3: value(Param::JerkVertical),
            tilt_rad: value(Param::AngleMax).to_radians(),
        }
    }

    /// Returns the demand of the present mode in flight.
    fn demand(&mut self, now: AutopilotTime, dt_s: f64) -> Demand {
        let stay = Horizontal::Velocity(DVec3::ZERO);
        let stay_z = Vertical::Velocity(0.0);
        match self.mode {
            // Without pilot input, the throttle is at its minimum.
            CopterMode::Stabilize => Demand::Idle,
            CopterMode::AltHold => Demand::Motion(Horizontal::Level, stay_z),
            CopterMode::Loiter | CopterMode::Brake => {
                Demand::Motion(self.or_level(now, stay), stay_z)
            }
            CopterMode::Guided => self.guided_demand(now, dt_s),
            CopterMode::Land => {
                self.landing.pauses &= now.seconds_since(self.landing.began) < LAND_PAUSE_S;
                let down = if self.landing.pauses { stay_z } else { self.descent() };
                Demand::Motion(self.or_level(now, stay), down)
            }
            CopterMode::Rtl => self.return_demand(now),
        }
    }

    /// Returns `wanted`, or level flight without a position.
    fn or_level(&self, now: AutopilotTime, wanted: Horizontal) -> Horizontal {
        if self.estimator.health(now).position { wanted } else { Horizontal::Level }
    }

    fn descent(&self) -> Vertical {
        let value = |param| self.params.value(param);
        let height_m = self.estimator.estimate().p_world_m.z - self.home.map_or(0.0, |home| home.z);
        let fast = match value(Param::LandSpeedHigh) {
            0.0 => value(Param::WpSpeedDown),
            speed => speed,
        };
        let (slow, low_m) = (value(Param::LandSpeed), value(Param::LandAltLow));
        // Slows down before LAND_ALT_LOW_M, not at it.
        let braked = sqrt_rate(height_m - low_m, LAND_GAIN_PER_S, value(Param::WpAccelerationZ));
        Vertical::Descend(braked.clamp(slow, fast.max(slow)))
    }

    fn towards(&self, p: DVec3, v: DVec3) -> Demand {
        let value = |param| self.params.value(param);
        Demand::Motion(
            Horizontal::Position { p, v, speed_mps: value(Param::WpSpeed) },
            Vertical::Position {
                z: p.z,
                v: v.z,
                up_mps: value(Param::WpSpeedUp),
                down_mps: value(Param::WpSpeedDown),
            },
        )
    }

    fn guided_demand(&mut self, now: AutopilotTime, dt_s: f64) -> Demand {
        let stop = Demand::Motion(Horizontal::Velocity(DVec3::ZERO), Vertical::Velocity(0.0));
        match self.guided {
            Guided::Hold => stop,
            Guided::TakeOff { z_m } => {
                let z = self.estimator.estimate().p_world_m.z;
                if (z - z_m).abs() < REACHED_M {
                    self.guided = Guided::Hold;
                }
                let Demand::Motion(_, vertical) = self.towards(DVec3::Z * z_m, DVec3::ZERO) else {
                    return stop;
                };
                Demand::Motion(Horizontal::Velocity(DVec3::ZERO), vertical)
            }
            Guided::Setpoint { setpoint, since, p_world_m } => {
                let timed_out = now.seconds_since(since) > self.params.value(Param::GuidTimeout);
                match setpoint.motion {
                    // A position is held without resending.
                    GuidedMotion::Position(p) => self.towards(p, DVec3::ZERO),
                    _ if timed_out => {
                        self.guided = Guided::Hold;
                        self.flight.yaw = YawTarget::Angle(self.heading.yaw_rad);
                        stop
                    }
                    GuidedMotion::PositionVelocity(_, v) => {
                        let p_world_m = p_world_m + v * dt_s;
                        self.guided = Guided::Setpoint { setpoint, since, p_world_m };
                        self.towards(p_world_m, v)
                    }
                    GuidedMotion::Velocity(v) => {
                        Demand::Motion(Horizontal::Velocity(v), Vertical::Velocity(v.z))
                    }
                    GuidedMotion::Acceleration(a) => {
                        Demand::Motion(Horizontal::Acceleration(a), Vertical::Acceleration(a.z))
                    }
                }
            }
        }
    }

    fn return_demand(&mut self, now: AutopilotTime) -> Demand {
        let Some(home) = self.home else {
            return Demand::Motion(Horizontal::Level, self.descent());
        };
        let p = self.estimator.estimate().p_world_m;
        let climb_m = self.params.value(Param::RtlAlt).min(self.fence_ceiling_m());
        let cruise_z = p.z.max(home.z + climb_m);
        let away_m = (p - home).truncate().length();
        match self.returning {
            Return::Climb if cruise_z - p.z < 0.2 => self.returning = Return::Travel,
            Return::Travel if away_m < 0.2 => self.returning = Return::Land,
            _ => {}
        }
        match self.returning {
            Return::Climb => {
                let Demand::Motion(_, vertical) = self.towards(DVec3::Z * cruise_z, DVec3::ZERO)
                else {
                    return Demand::Idle;
                };
                let stay = Horizontal::Velocity(DVec3::ZERO);
                Demand::Motion(self.or_level(now, stay), vertical)
            }
            Return::Travel => self.towards(home.truncate().extend(cruise_z), DVec3::ZERO),
            Return::Land => {
                let stay = Horizontal::Velocity(DVec3::ZERO);
                Demand::Motion(self.or_level(now, stay), self.descent())
            }
        }
    }

    /// Moves the heading towards its target.
    fn steer(&mut self, now: AutopilotTime, horizontal: Horizontal, dt_s: f64) {
        let slew = (self.params.value(Param::SlewYaw) / 100.0).to_radians();
        let in_guided = self.mode == CopterMode::Guided;
        let target = match self.flight.yaw {
            YawTarget::Angle(yaw_rad) if in_guided => Some(yaw_rad),
            YawTarget::Rate(rate) if in_guided => {
                let rate_radps = rate.clamp(-slew, slew);
                self.heading.yaw_rad = wrap_pi(self.heading.yaw_rad + rate_radps * dt_s);
                self.heading.rate_radps = rate_radps;
                return;
            }
            _ => self.travel_heading(now, horizontal),
        };
        let Some(target) = target else {
            self.heading.rate_radps = 0.0;
            return;
        };
        let step = wrap_pi(target - self.heading.yaw_rad).clamp(-slew * dt_s, slew * dt_s);
        self.heading.yaw_rad = wrap_pi(self.heading.yaw_rad + step);
        self.heading.rate_radps = step / dt_s;
    }

    /// Returns the direction of travel, if the nose follows it because yaw is ignored.
    fn travel_heading(&self, now: AutopilotTime, horizontal: Horizontal) -> Option<f64> {
        let follows = self.params.value(Param::WpYawBehavior) != 0.0
            && self.mode == CopterMode::Guided
            && matches!(self.guided, Guided::Setpoint { .. })
            && self.estimator.health(now).position
            && horizontal != Horizontal::Level;
        let v = self.position.velocity_target_mps().truncate();
        let least_mps = LOOK_AHEAD_SHARE * self.params.value(Param::WpSpeed);
        (follows && v.length() > least_mps).then(|| v.y.atan2(v.x))
    }

    fn detect_landing(&mut self, dt_s: f64) {
        let estimate = self.estimator.estimate();
        let share = 1.0 - (-SHAKE_CUTOFF * dt_s).exp();
        self.flight.shake += (estimate.a_world_mps2 - self.flight.shake) * share;
        if self.landed {
            self.flight.carried_s = 0.0;
            self.flight.idle_s += dt_s;
            let delay_s = self.params.value(Param::DisarmDelay);
            let landing = matches!(self.mode, CopterMode::Land | CopterMode::Rtl);
            if landing || (delay_s > 0.0 && self.flight.idle_s > delay_s) {
                self.disarm();
            }
            return;
        }
        self.flight.idle_s = 0.0;
        let still =
            estimate.v_world_mps.length() < LANDED_MPS && self.flight.shake.length() < LANDED_MPS2;
        let carried = self.flight.lift < CARRIED && still;
        self.flight.carried_s = if carried { self.flight.carried_s + dt_s } else { 0.0 };
        if self.flight.carried_s > LANDED_S {
            self.landed = true;
            self.guided = Guided::Hold;
        }
    }

    /// Returns the present throttle [%].
    pub(super) fn throttle_percent(&self) -> u16 {
        (self.flight.lift / THRUST_TO_WEIGHT * 100.0).clamp(0.0, 100.0) as u16
    }
}
