//! The vehicle's response to velocity commands, and its stopping distance.
//!
//! An autopilot does not reach a commanded velocity at once: it reduces the difference exponentially, with limited
//! acceleration and jerk (ArduCopter: `WP_ACC` and `PSC_JERK_*`; the rate is jerk over acceleration). The parameters
//! are used until the flight contradicts them: candidate responses are simulated with the same commands and compared
//! with the vehicle's motion.

use glam::DVec3;

/// Response of a vehicle to velocity commands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Response {
    /// Time constant from a velocity command to the velocity. [s]
    pub lag_s: f64,
    /// Maximum jerk. [m/s^3]
    pub jerk_mps3: f64,
    /// Maximum acceleration. [m/s^2]
    pub acceleration_mps2: f64,
}

impl Response {
    /// Assumed response if it is unknown: slower than ArduCopter with its default parameters.
    pub const UNKNOWN: Self = Self { lag_s: 1.2, jerk_mps3: 5.0, acceleration_mps2: 0.6 };
    /// Lag of attitude and motors behind the autopilot's shaped command. [s]
    const ATTITUDE_LAG_S: f64 = 0.12;

    /// Returns the response of an ArduCopter with these parameters: `PSC_JERK_NE` [m/s^3] and `WP_ACC` [m/s^2]. Invalid
    /// values give [`Self::UNKNOWN`].
    pub fn of_ardupilot(jerk_mps3: f64, acceleration_mps2: f64) -> Self {
        let positive = |value: f64| value.is_finite() && value > 0.0;
        if !positive(jerk_mps3) || !positive(acceleration_mps2) {
            return Self::UNKNOWN;
        }
        let lag_s = (acceleration_mps2 / jerk_mps3 + Self::ATTITUDE_LAG_S).min(MAX_LAG_S);
        let jerk_mps3 = jerk_mps3.clamp(LEAST_JERK_MPS3, MAX_JERK_MPS3);
        Self { lag_s, jerk_mps3, acceleration_mps2 }
    }

    /// Returns a response without overshoot: it reduces differences at the rate of jerk over acceleration, as
    /// ArduCopter does.
    pub const fn smooth(lag_s: f64, jerk_mps3: f64) -> Self {
        Self { lag_s, jerk_mps3, acceleration_mps2: lag_s * jerk_mps3 }
    }
}

/// Maximum lag that is distinguished; a slower vehicle cannot be flown by velocities. [s]
const MAX_LAG_S: f64 = 2.4;
const LEAST_JERK_MPS3: f64 = 2.0;
const MAX_JERK_MPS3: f64 = 100.0;
/// Candidate responses. [s], [m/s^3]
const LAGS_S: [f64; 8] = [0.12, 0.2, 0.3, 0.45, 0.65, 0.9, 1.25, 1.8];
const JERKS_MPS3: [f64; 7] = [3.0, 4.5, 6.5, 10.0, 16.0, 30.0, 80.0];
/// The true response lies between the candidates: use this share of the measured acceleration and jerk.
const MEASURED_SHARE: f64 = 0.7;
/// Speed at which stopping distances are compared, to rank candidates from quick to slow. [m/s]
const FAST_MPS: f64 = 3.0;
/// Time constant with which old measurements fade. [s]
const MEMORY_S: f64 = 20.0;
/// Velocity error of localization. [m/s]
const NOISE_MPS: f64 = 0.04;
/// A candidate is possible if its error is at most this factor times the smallest error.
const POSSIBLE: f64 = 2.5;
/// Evidence needed before a conclusion: the squared difference between the quickest and the slowest candidate, summed
/// over time. [m^2/s]
const ENOUGH: f64 = 0.15;
/// If even the best candidate's error exceeds this share of the evidence, the vehicle did not follow the commands at
/// all, for example because a person held it.
const EXPLAINED: f64 = 0.2;
/// Delay from a command to the first response: link and ticks. [s]
const DELAY_S: f64 = 0.1;
/// Time step of the simulated stopping path. [s]
const STEP_S: f64 = 0.05;
/// Iterations until a command is exact to 0.01 m/s.
const FALSE_POSITIONS: usize = 5;
/// Maximum duration of the simulated stopping path. [s]
const LONGEST_S: f64 = 12.0;
/// Maximum speed of a stopped vehicle on it. [m/s]
const STOPPED_MPS: f64 = 0.02;

/// Velocity that approaches a command.
#[derive(Clone, Copy, Debug, Default)]
struct CommandedVelocity<V> {
    v_mps: V,
    a_mps2: V,
}

impl CommandedVelocity<DVec3> {
    fn advance(&mut self, command_mps: DVec3, response: Response, max_mps2: f64, dt_s: f64) {
        let most_mps2 = max_mps2.min(response.acceleration_mps2);
        let wanted = ((command_mps - self.v_mps) / response.lag_s).clamp_length_max(most_mps2);
        self.a_mps2 += (wanted - self.a_mps2).clamp_length_max(response.jerk_mps3 * dt_s);
        self.v_mps += self.a_mps2 * dt_s;
    }
}

impl CommandedVelocity<f64> {
    fn advance(&mut self, command_mps: f64, response: Response, max_mps2: f64, dt_s: f64) {
        let most_mps2 = max_mps2.min(response.acceleration_mps2);
        let wanted = ((command_mps - self.v_mps) / response.lag_s).clamp(-most_mps2, most_mps2);
        let most = response.jerk_mps3 * dt_s;
        self.a_mps2 += (wanted - self.a_mps2).clamp(-most, most);
        self.v_mps += self.a_mps2 * dt_s;
    }
}

/// Candidate response, simulated in parallel with the flight.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    response: Response,
    motion: CommandedVelocity<DVec3>,
    /// Stopping distance from [`FAST_MPS`]. [m]
    stops_m: f64,
    /// Squared error, summed over time with fading. [m^2/s]
    error: f64,
}

/// Estimates the vehicle's response.
#[derive(Clone, Debug)]
pub(super) struct Answers {
    /// The first is the response according to the parameters.
    candidates: Vec<Candidate>,
    /// Evidence, as [`ENOUGH`] counts it.
    seen: f64,
    seen_s: f64,
    /// Lead of the vehicle over the response of the parameters, in the direction of the command. [m^2/s]
    ahead: f64,
    max_mps2: f64,
    is_known: bool,
    in_use: usize,
}

impl Answers {
    /// Starts with the response according to the autopilot's parameters, for a vehicle that flies at `v_mps`.
    pub(super) fn new(parameters: Option<Response>, v_mps: DVec3, max_mps2: f64) -> Self {
        let others = LAGS_S.iter().flat_map(|&lag_s| {
            JERKS_MPS3.iter().map(move |&jerk_mps3| Response::smooth(lag_s, jerk_mps3))
        });
        let candidates = std::iter::once(parameters.unwrap_or(Response::UNKNOWN))
            .chain(others)
            .map(|response| {
                let motion = CommandedVelocity { v_mps, a_mps2: DVec3::ZERO };
                let stops_m =
                    Stopping::new(response, max_mps2, 1.0).reach_m(FAST_MPS, FAST_MPS, 0.0);
                Candidate { response, motion, stops_m, error: 0.0 }
            })
            .collect();
        let is_known = parameters.is_some();
        Self { candidates, seen: 0.0, seen_s: 0.0, ahead: 0.0, max_mps2, is_known, in_use: 0 }
    }

    /// Records that the vehicle flew at `v_mps` after `dt_s` of a command.
    pub(super) fn watch(&mut self, command_mps: DVec3, v_mps: DVec3, dt_s: f64) {
        if !(dt_s > 0.0) || !v_mps.is_finite() {
            return;
        }
        let fades = 1.0 - dt_s / MEMORY_S;
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for candidate in &mut self.candidates {
            candidate.motion.advance(command_mps, candidate.response, self.max_mps2, dt_s);
            let error = candidate.motion.v_mps.distance_squared(v_mps);
            candidate.error = candidate.error * fades + error * dt_s;
            (low, high) = (low.min(candidate.motion.v_mps), high.max(candidate.motion.v_mps));
        }
        self.seen = self.seen * fades + low.distance_squared(high) * dt_s;
        self.seen_s = self.seen_s * fades + dt_s;
        let said_mps = self.candidates[0].motion.v_mps;
        self.ahead = self.ahead * fades + (v_mps - said_mps).dot(command_mps - said_mps) * dt_s;
        self.in_use = self.conclude();
    }

    fn conclude(&self) -> usize {
        let best = self.candidates.iter().map(|one| one.error).fold(f64::INFINITY, f64::min);
        if self.seen < ENOUGH || best > EXPLAINED * self.seen {
            return 0;
        }
        let most = POSSIBLE * best + NOISE_MPS * NOISE_MPS * self.seen_s;
        // Keep the parameters also if they are too careful.
        if self.candidates[0].error <= most || (self.is_known && self.ahead >= 0.0) {
            return 0;
        }
        let possible = self.candidates.iter().enumerate().filter(|(_, one)| one.error <= most);
        possible
            .max_by(|(_, a), (_, b)| a.stops_m.total_cmp(&b.stops_m))
            .map_or(0, |(index, _)| index)
    }

    /// Returns the response to calculate with.
    pub(super) fn response(&self) -> Response {
        let Response { lag_s, jerk_mps3, acceleration_mps2 } =
            self.candidates[self.in_use].response;
        let share = if self.is_measured() { MEASURED_SHARE } else { 1.0 };
        Response {
            lag_s,
            jerk_mps3: share * jerk_mps3,
            acceleration_mps2: share * acceleration_mps2,
        }
    }

    /// Whether the flight has contradicted the parameters.
    pub(super) fn is_measured(&self) -> bool {
        self.in_use != 0
    }

    /// Returns the estimated acceleration of the vehicle. [m/s^2, world]
    pub(super) fn a_mps2(&self) -> DVec3 {
        self.candidates[self.in_use].motion.a_mps2
    }
}

/// Model of a stop before one face.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stopping {
    /// Its jerk is reduced to the share for one face.
    response: Response,
    /// Rate at which the command is reduced. [m/s^2]
    taken_back_mps2: f64,
    /// Maximum deceleration of the vehicle. [m/s^2]
    brakes_mps2: f64,
}

impl Stopping {
    /// Creates the stop of a vehicle with commands that change by at most `max_mps2`, with `share` of its capability
    /// for one face.
    pub(super) fn new(response: Response, max_mps2: f64, share: f64) -> Self {
        let most_mps2 = max_mps2.min(response.acceleration_mps2);
        Self {
            response: Response { jerk_mps3: share * response.jerk_mps3, ..response },
            taken_back_mps2: share * max_mps2,
            brakes_mps2: share * most_mps2,
        }
    }

    /// Returns the maximum distance that a vehicle at `v_mps`, accelerating by `a_mps2`, still covers if it receives
    /// `command_mps` now and less from the next tick on. Along one axis. [m]
    pub(super) fn reach_m(&self, command_mps: f64, v_mps: f64, a_mps2: f64) -> f64 {
        // Ignore a present deceleration: it is only an estimate.
        let mut motion = CommandedVelocity { v_mps, a_mps2: a_mps2.max(0.0) };
        let (mut way_m, mut most_m) = (0.0, 0.0_f64);
        let mut t_s = 0.0;
        while t_s < LONGEST_S {
            let less_mps = self.taken_back_mps2 * (t_s - DELAY_S).max(0.0);
            let command_mps = command_mps.signum() * (command_mps.abs() - less_mps).max(0.0);
            // Use the greater speed of the step, so that the distance is never too short.
            let before_mps = motion.v_mps;
            motion.advance(command_mps, self.response, self.brakes_mps2, STEP_S);
            way_m += before_mps.max(motion.v_mps) * STEP_S;
            most_m = most_m.max(way_m);
            t_s += STEP_S;
            if command_mps.abs() < STOPPED_MPS && motion.v_mps < STOPPED_MPS && motion.a_mps2 <= 0.0
            {
                break;
            }
        }
        most_m
    }

    /// Returns an upper bound of [`Self::reach_m`] without the simulation. [m]
    pub(super) fn bound_m(&self, command_mps: f64, v_mps: f64, a_mps2: f64) -> f64 {
        let Response { lag_s, jerk_mps3, .. } = self.response;
        let builds_s = (self.brakes_mps2 + a_mps2.abs()) / jerk_mps3;
        let speed_mps = v_mps.abs().max(command_mps.abs()) + a_mps2.abs() * builds_s;
        let brakes_s = speed_mps / self.brakes_mps2.min(self.taken_back_mps2);
        speed_mps * (DELAY_S + 2.0 * STEP_S + builds_s + brakes_s + 2.0 * lag_s)
    }

    /// Returns the greatest command up to `wanted_mps` from which the vehicle stops within `free_m`; 0 if there is
    /// none. Along one axis. [m/s]
    pub(super) fn most_mps(&self, wanted_mps: f64, free_m: f64, v_mps: f64, a_mps2: f64) -> f64 {
        if self.bound_m(wanted_mps, v_mps, a_mps2) <= free_m {
            return wanted_mps;
        }
        let over_m = |command_mps| self.reach_m(command_mps, v_mps, a_mps2) - free_m;
        let (mut good, mut bad) = ((0.0, over_m(0.0)), (wanted_mps, over_m(wanted_mps)));
        if bad.1 <= 0.0 {
            return wanted_mps;
        }
        if good.1 >= 0.0 {
            return 0.0;
        }
        // The distance is nearly linear in the command: false position, from the good side (Illinois).
        for _ in 0..FALSE_POSITIONS {
            let middle = good.0 + (bad.0 - good.0) * good.1 / (good.1 - bad.1);
            let over = over_m(middle);
            if over <= 0.0 {
                good = (middle, over);
                bad.1 *= 0.5;
            } else {
                bad = (middle, over);
                good.1 *= 0.5;
            }
        }
        good.0
    }

    /// Whether a vehicle on a straight or curved path stops while `is_inside` holds; [`Self::reach_m`] in space.
    pub(super) fn stays(
        &self,
        command_mps: DVec3,
        v_mps: DVec3,
        a_mps2: DVec3,
        is_inside: impl Fn(DVec3) -> bool,
    ) -> bool {
        let mut motion = CommandedVelocity { v_mps, a_mps2 };
        let (mut way_m, mut t_s) = (DVec3::ZERO, 0.0);
        let speed_mps = command_mps.length();
        while t_s < LONGEST_S {
            let less_mps = self.taken_back_mps2 * (t_s - DELAY_S).max(0.0);
            let share = if speed_mps > 0.0 { (1.0 - less_mps / speed_mps).max(0.0) } else { 0.0 };
            way_m += motion.v_mps * STEP_S;
            motion.advance(command_mps * share, self.response, self.brakes_mps2, STEP_S);
            t_s += STEP_S;
            if !is_inside(way_m) {
                return false;
            }
            if share * speed_mps < STOPPED_MPS && motion.v_mps.length() < STOPPED_MPS {
                break;
            }
        }
        true
    }
}

/// Returns the largest good value from 0 to `most`, if all values below a good one are good; 0 if none is good.
pub(super) fn largest(most: f64, is_good: impl Fn(f64) -> bool) -> f64 {
    if is_good(most) {
        return most;
    }
    let (mut good, mut bad) = (0.0, most);
    // 2^-10 of the speed is finer than any actuator.
    for _ in 0..10 {
        let middle = 0.5 * (good + bad);
        if is_good(middle) { good = middle } else { bad = middle }
    }
    good
}
