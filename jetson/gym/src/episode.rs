//! One vehicle that a policy flies through a course: actions in, true state and results out. Pure, on a virtual clock.
//! `vizflyt gym` flies many at once. This is a library crate that is optimised like the renderer, in contrast to the
//! command line, because learning runs it millions of times.
//!
//! The simulator's airframe flies under the simulator's controllers, which receive the true state: no estimator, no
//! MAVLink, no motion capture. The rules are the referee's: the same openings, obstacles and fence.

use glam::DVec3;
use vizflyt_arena::course::{Course, Progress};
use vizflyt_arena::fence::{Boundaries, FenceVerdict};
use vizflyt_arena::obstacles::TimedPose;
use vizflyt_arena::{ArenaConfig, BodyShape, Obstacles};
use vizflyt_protocol::geometry::{wrap_pi, yaw_of};
use vizflyt_protocol::random::SplitMix64;
use vizflyt_simulator::airframe::{Airframe, GRAVITY_MPS2, MASS_KG};
use vizflyt_simulator::control::Limits;
use vizflyt_simulator::control::attitude::{AttitudeController, Heading};
use vizflyt_simulator::control::mixer::mix;
use vizflyt_simulator::control::position::{Horizontal, PositionController, Vertical};
use vizflyt_simulator::estimator::Estimate;

/// Tick of the controllers; physics runs at twice this rate, as in the simulated lab. [s]
const TICK_S: f64 = 1.0 / 400.0;
const TICK_NS: i64 = 2_500_000;
const STEPS: u32 = 2;
/// Poses between two collision checks: 100 checks per second, each a sweep of the body from the previous pose.
const TICKS_PER_CHECK: u32 = 4;
/// Rates of turn for an action of 1. [rad/s]
const YAW_RATE_RADPS: f64 = 2.0;
const BODY_RATES_RADPS: DVec3 = DVec3::new(6.0, 6.0, 3.0);
/// Maximum offset of an episode's start from the spawn, sideways and in height. [m]
pub const START_M: f64 = 0.3;
/// Maximum offset of the start's heading. [rad]
const START_YAW_RAD: f64 = 0.3;
/// Minimum clearance at a start. [m]
const START_CLEARANCE_M: f64 = 0.15;
/// Maximum reported clearance. [m]
const CLEARANCE_TOLD_M: f64 = 10.0;

/// Numbers of an action.
pub const ACTION: usize = 4;
/// Numbers of a state, in the order of [`Episode::write_state`]; documented in `vizflyt.gym`.
pub const STATE: usize = 22;
/// Number of figures for rewards.
pub const FIGURES: usize = 4;

/// Quantity that an action commands. Its numbers are from -1 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ActionKind {
    /// Velocity forward, left and up, as fractions of the course's limit, and a turn.
    Velocity,
    /// Acceleration forward, left and up, as fractions of the course's limit, and a turn.
    Acceleration,
    /// Body rates and thrust.
    BodyRates,
}

/// State of an episode; its number goes to Python.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum End {
    /// In the air.
    Flying = 0,
    /// Collision with an obstacle.
    Crashed = 1,
    /// Fence left.
    LeftFence = 2,
    /// All stages are passed.
    Finished = 3,
    /// Time limit reached.
    TimeUp = 4,
}

/// Rules that all episodes of a course share.
#[derive(Debug)]
pub struct Rules {
    /// The room.
    pub arena: ArenaConfig,
    /// Obstacles that end an episode when touched.
    pub obstacles: Obstacles,
    boundaries: Boundaries,
    body: BodyShape,
    limits: Limits,
    /// Position and direction of each stage, then the goal. [m, world]
    targets: Vec<(DVec3, DVec3)>,
}

impl Rules {
    /// Returns the rules of a course, for a vehicle with these limits.
    pub fn new(arena: ArenaConfig, obstacles: Obstacles, limits: Limits) -> Self {
        let stages =
            arena.stages.iter().map(|stage| (stage.center_m, stage.normal.normalize_or(DVec3::X)));
        let goal = arena.goal.map(|goal| (goal.position_m, DVec3::ZERO));
        Self {
            targets: stages.chain(goal).collect(),
            boundaries: Boundaries::of(&arena),
            body: BodyShape::of(&arena),
            obstacles,
            limits,
            arena,
        }
    }
}

/// Actions and time limit of an episode.
#[derive(Clone, Copy, Debug)]
pub struct Manner {
    /// Quantity that actions command.
    pub action: ActionKind,
    /// Controller ticks per step.
    pub ticks: u32,
    /// Steps until an action takes effect.
    pub delay: usize,
    /// Time limit of an episode. [s]
    pub seconds: f64,
}

/// A vehicle in the air.
#[derive(Debug)]
pub struct Episode {
    airframe: Airframe,
    position: PositionController,
    attitude: AttitudeController,
    heading_rad: f64,
    saturated: bool,
    course: Course,
    /// Controller ticks since the start.
    ticks: u64,
    checked: TimedPose,
    /// Delayed actions, the oldest first.
    waiting: Vec<[f64; ACTION]>,
    /// Decrease of the distance to the target in the last step. [m]
    progress_m: f64,
    clearance_m: f64,
    end: End,
}

impl Episode {
    /// Starts near the spawn. The seed determines the exact pose.
    pub fn start(rules: &Rules, manner: &Manner, seed: u64) -> Self {
        let spawn = &rules.arena.spawn;
        let mut random = SplitMix64::new(seed);
        let mut signed = || 2.0 * random.unit() - 1.0;
        let floor_z_m = spawn.position_m.z;
        let above_m = spawn.position_m + DVec3::Z * rules.arena.takeoff_height_m;
        let yaw_rad = spawn.yaw_deg.to_radians();
        let mut airframe = Airframe::hovering(above_m, yaw_rad, floor_z_m);
        // Without enough space after 20 draws, it starts exactly above the spawn.
        for _ in 0..20 {
            let offset_m = DVec3::new(signed(), signed(), signed()) * START_M;
            let turn_rad = signed() * START_YAW_RAD;
            if rules.obstacles.distance_m(0, above_m + offset_m)
                > rules.body.radius_m() + START_CLEARANCE_M
            {
                airframe = Airframe::hovering(above_m + offset_m, yaw_rad + turn_rad, floor_z_m);
                break;
            }
        }
        let mut episode = Self {
            position: PositionController::default(),
            attitude: AttitudeController::default(),
            heading_rad: yaw_of(airframe.state().world_from_body),
            saturated: false,
            course: Course::new(&rules.arena),
            ticks: 0,
            checked: TimedPose { since_epoch_ns: 0, world_from_body: airframe.state().pose() },
            waiting: vec![[0.0; ACTION]; manner.delay],
            progress_m: 0.0,
            clearance_m: CLEARANCE_TOLD_M,
            end: End::Flying,
            airframe,
        };
        episode.position.reset(&episode.truth());
        episode
    }

    /// Returns the time since the start. [ns]
    pub fn elapsed_ns(&self) -> i64 {
        self.ticks as i64 * TICK_NS
    }

    /// Returns the time since the start. [s]
    fn elapsed_s(&self) -> f64 {
        self.ticks as f64 * TICK_S
    }

    /// Returns the airframe of the vehicle.
    pub fn airframe(&self) -> &Airframe {
        &self.airframe
    }

    /// Returns the state of the episode.
    pub fn end(&self) -> End {
        self.end
    }

    /// Flies one step. The action's numbers are clamped to -1 to 1.
    pub fn step(&mut self, rules: &Rules, manner: &Manner, action: [f32; ACTION]) {
        if self.end != End::Flying {
            return;
        }
        // NaN counts as 0.
        let action =
            action.map(|a| if a.is_finite() { f64::from(a).clamp(-1.0, 1.0) } else { 0.0 });
        self.waiting.push(action);
        let action = self.waiting.remove(0);
        let before_m = self.target_m(rules);
        for tick in 1..=manner.ticks {
            self.fly(rules, manner.action, action);
            if (tick % TICKS_PER_CHECK == 0 || tick == manner.ticks)
                && self.judge(rules) != End::Flying
            {
                break;
            }
        }
        let after_m = self.airframe.state().p_world_m;
        // Progress counts relative to the target before the step, even if that stage was passed.
        self.progress_m = before_m.map_or(0.0, |(target_m, from_m)| {
            from_m.distance(target_m) - after_m.distance(target_m)
        });
        if self.end == End::Flying && self.elapsed_s() >= manner.seconds {
            self.end = End::TimeUp;
        }
    }

    /// Returns the positions of the next target and of the vehicle. [m, world]
    fn target_m(&self, rules: &Rules) -> Option<(DVec3, DVec3)> {
        let (target_m, _) = rules.targets.get(self.course.next())?;
        Some((*target_m, self.airframe.state().p_world_m))
    }

    /// Runs one tick of controllers and physics.
    fn fly(&mut self, rules: &Rules, kind: ActionKind, action: [f64; ACTION]) {
        let truth = self.truth();
        let wish = DVec3::new(action[0], action[1], action[2]);
        let wrench = if kind == ActionKind::BodyRates {
            // From zero to twice the weight.
            let thrust_n = (1.0 + action[3]) * MASS_KG * GRAVITY_MPS2;
            self.attitude.follow_rates(
                truth.omega_body_radps,
                wish * BODY_RATES_RADPS,
                thrust_n,
                TICK_S,
            )
        } else {
            let arena = &rules.arena.limits;
            let yaw_rad = yaw_of(truth.world_from_body);
            let in_world = glam::DQuat::from_rotation_z(yaw_rad) * wish;
            let (horizontal, vertical) = if kind == ActionKind::Velocity {
                let v_mps = (in_world * arena.max_speed_mps).clamp_length_max(arena.max_speed_mps);
                (Horizontal::Velocity(v_mps), Vertical::Velocity(v_mps.z))
            } else {
                let a_mps2 = in_world * arena.max_acceleration_mps2;
                (Horizontal::Acceleration(a_mps2), Vertical::Acceleration(a_mps2.z))
            };
            let rate_radps = action[3] * YAW_RATE_RADPS;
            self.heading_rad = wrap_pi(self.heading_rad + rate_radps * TICK_S);
            let a_mps2 = self.position.update(
                &truth,
                horizontal,
                vertical,
                &rules.limits,
                self.saturated,
                TICK_S,
            );
            let heading = Heading { yaw_rad: self.heading_rad, rate_radps };
            self.attitude.update(&truth, a_mps2, heading, &rules.limits, TICK_S)
        };
        self.saturated = wrench.saturated;
        let motors = mix(&wrench);
        for _ in 0..STEPS {
            self.airframe.tick(motors, TICK_S / f64::from(STEPS));
        }
        self.ticks += 1;
    }

    /// Checks the path since the last check against the rules.
    fn judge(&mut self, rules: &Rules) -> End {
        let state = *self.airframe.state();
        let to = TimedPose { since_epoch_ns: self.elapsed_ns(), world_from_body: state.pose() };
        let from = std::mem::replace(&mut self.checked, to);
        let from_m = from.world_from_body.translation_m;
        let (sweep, _) = rules.obstacles.sweep(&rules.body, &from, &to);
        self.clearance_m = sweep.clearance_m.min(CLEARANCE_TOLD_M);
        let mut has_finished = false;
        while let Some(progress) = self.course.advance(from_m, state.p_world_m) {
            has_finished |= progress == Progress::Finished;
        }
        let fence = rules.boundaries.check(from_m, state.p_world_m, state.v_world_mps);
        self.end = if sweep.contact.is_some() || self.airframe.touches_floor() {
            End::Crashed
        } else if fence.margin_m < 0.0 && fence.verdict == FenceVerdict::Breach {
            End::LeftFence
        } else if has_finished {
            End::Finished
        } else {
            End::Flying
        };
        self.end
    }

    /// Returns the true state as the controllers' estimate.
    fn truth(&self) -> Estimate {
        let state = self.airframe.state();
        Estimate {
            p_world_m: state.p_world_m,
            v_world_mps: state.v_world_mps,
            world_from_body: state.world_from_body,
            omega_body_radps: state.omega_body_radps,
            a_world_mps2: state.world_from_body * self.airframe.specific_force_body_mps2()
                - DVec3::Z * GRAVITY_MPS2,
        }
    }

    /// Writes the state in the order documented in `vizflyt.gym`: velocity, up, angular velocity, vector to the target
    /// and its direction, position, sine and cosine of the heading, remaining targets, remaining fraction of the time.
    pub fn write_state(&self, rules: &Rules, manner: &Manner, out: &mut [f32; STATE]) {
        let state = self.airframe.state();
        let yaw_rad = yaw_of(state.world_from_body);
        let heading_from_world = glam::DQuat::from_rotation_z(-yaw_rad);
        let target = rules.targets.get(self.course.next());
        let (way_m, normal) = target.map_or((DVec3::ZERO, DVec3::ZERO), |(target_m, normal)| {
            (heading_from_world * (*target_m - state.p_world_m), heading_from_world * *normal)
        });
        let vectors = [
            heading_from_world * state.v_world_mps,
            state.world_from_body.conjugate() * DVec3::Z,
            state.omega_body_radps,
            way_m,
            normal,
            state.p_world_m,
        ];
        for (to, vector) in out.chunks_exact_mut(3).zip(vectors) {
            to.copy_from_slice(&vector.as_vec3().to_array());
        }
        let left = rules.targets.len().saturating_sub(self.course.next());
        out[18..].copy_from_slice(&[
            yaw_rad.sin() as f32,
            yaw_rad.cos() as f32,
            left as f32,
            (1.0 - self.elapsed_s() / manner.seconds) as f32,
        ]);
    }

    /// Returns the figures for rewards: progress [m], clearance [m], stages passed, time [s].
    pub fn figures(&self) -> [f32; FIGURES] {
        [
            self.progress_m as f32,
            self.clearance_m as f32,
            self.course.next() as f32,
            self.elapsed_s() as f32,
        ]
    }
}

/// Appends numbers, little-endian.
pub fn append(numbers: &[f32], out: &mut Vec<u8>) {
    out.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
}

/// Appends depths in the format of `vizflyt gym`: whole millimetres, little-endian, at most 65535; 0 means no return.
/// [m]
pub fn append_depth_mm(depth_m: &[f32], out: &mut Vec<u8>) {
    // Clamped before the cast, in an order that can be vectorised.
    let mm = depth_m.iter().map(|m| (m * 1000.0 + 0.5).clamp(0.0, 65535.0) as u16);
    out.extend(mm.flat_map(u16::to_le_bytes));
}

#[cfg(test)]
mod tests {
    use super::append_depth_mm;

    #[test]
    fn depths_are_whole_millimetres() {
        let mut bytes = vec![7];
        append_depth_mm(&[0.0, 1.2344, 2.0006, 65.534, 65.6, f32::MAX, f32::NAN], &mut bytes);
        let (pairs, rest) = bytes[1..].as_chunks();
        let mm: Vec<u16> = pairs.iter().map(|pair| u16::from_le_bytes(*pair)).collect();
        assert_eq!((mm, rest.len()), (vec![0, 1234, 2001, 65534, 65535, 65535, 0], 0));
    }
}
