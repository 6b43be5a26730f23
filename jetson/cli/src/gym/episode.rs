//! One vehicle that a policy flies through a course: setpoints in, true state and rules out. Pure, on a clock of its own.
//!
//! What flies is the simulator's airframe under the simulator's own controllers, which are given the truth: no
//! estimator, no MAVLink, no motion capture. Rules are the referee's: the same openings, obstacles, fence.

use glam::DVec3;
use vizflyt_arena::course::{Course, Progress};
use vizflyt_arena::fence::{Boundaries, FenceVerdict};
use vizflyt_arena::obstacles::TimedPose;
use vizflyt_arena::{ArenaConfig, BodyShape, Obstacles};
use vizflyt_protocol::geometry::{wrap_pi, yaw_of};
use vizflyt_simulator::airframe::{Airframe, GRAVITY_MPS2, MASS_KG};
use vizflyt_simulator::control::Limits;
use vizflyt_simulator::control::attitude::{AttitudeController, Heading};
use vizflyt_simulator::control::mixer::mix;
use vizflyt_simulator::control::position::{Horizontal, PositionController, Vertical};
use vizflyt_simulator::estimator::Estimate;

use super::ActionKind;

/// Physics at twice the rate of the controllers, as in the simulated lab. [s]
const TICK_S: f64 = 1.0 / 400.0;
const TICK_NS: i64 = 2_500_000;
const STEPS: u32 = 2;
/// Poses between two checks for contact: 100 a second, each a sweep of the body from the last.
const TICKS_PER_CHECK: u32 = 4;
/// Fastest turns that an action of 1 asks for. [rad/s]
const YAW_RATE_RADPS: f64 = 2.0;
const BODY_RATES_RADPS: DVec3 = DVec3::new(6.0, 6.0, 3.0);
/// How far an episode's start is off the spawn, at most: sideways and in height; and its heading.
const START_M: f64 = 0.3;
const START_YAW_RAD: f64 = 0.3;
/// So much room must be about a start. [m]
const START_CLEARANCE_M: f64 = 0.15;
/// A clearance beyond is told as this. [m]
const CLEARANCE_TOLD_M: f64 = 10.0;

/// Numbers of an action.
pub(super) const ACTION: usize = 4;
/// Numbers of a state, as `vizflyt.gym` explains them.
pub(super) const STATE: usize = 22;
/// Numbers that rewards are made of.
pub(super) const FIGURES: usize = 4;

/// How an episode stands; its number goes to Python.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum End {
    Flying = 0,
    Crashed = 1,
    LeftFence = 2,
    Finished = 3,
    TimeUp = 4,
}

/// What episodes of one course have in common.
pub(super) struct Rules {
    pub(super) arena: ArenaConfig,
    pub(super) obstacles: Obstacles,
    boundaries: Boundaries,
    body: BodyShape,
    limits: Limits,
    /// Where each stage is, and its direction; the goal behind them. [m, world]
    targets: Vec<(DVec3, DVec3)>,
}

impl Rules {
    pub(super) fn new(arena: ArenaConfig, obstacles: Obstacles, limits: Limits) -> Self {
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

/// How an episode is flown.
#[derive(Clone, Copy, Debug)]
pub(super) struct Manner {
    pub(super) action: ActionKind,
    /// Controller's ticks a step.
    pub(super) ticks: u32,
    /// Steps until an action counts.
    pub(super) delay: usize,
    /// After so much an episode is over. [s]
    pub(super) seconds: f64,
}

/// A vehicle in the air.
pub(super) struct Episode {
    airframe: Airframe,
    position: PositionController,
    attitude: AttitudeController,
    heading_rad: f64,
    saturated: bool,
    course: Course,
    /// Of the controllers, since its start.
    ticks: u64,
    checked: TimedPose,
    /// Actions under way, the oldest first.
    waiting: Vec<[f64; ACTION]>,
    /// Nearer to the target than a step before. [m]
    progress_m: f64,
    clearance_m: f64,
    end: End,
}

impl Episode {
    /// Starts near the spawn: where, follows from the seed.
    pub(super) fn start(rules: &Rules, manner: &Manner, seed: u64) -> Self {
        let spawn = &rules.arena.spawn;
        let mut noise = Noise(seed);
        let floor_z_m = spawn.position_m.z;
        let above_m = spawn.position_m + DVec3::Z * rules.arena.takeoff_height_m;
        let yaw_rad = spawn.yaw_deg.to_radians();
        let mut airframe = Airframe::hovering(above_m, yaw_rad, floor_z_m);
        // Where there is no room for a start of its own it starts above the spawn.
        for _ in 0..20 {
            let offset_m = DVec3::new(noise.signed(), noise.signed(), noise.signed()) * START_M;
            let turn_rad = noise.signed() * START_YAW_RAD;
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

    /// Since its start. [ns]
    pub(super) fn elapsed_ns(&self) -> i64 {
        self.ticks as i64 * TICK_NS
    }

    /// Since its start. [s]
    fn elapsed_s(&self) -> f64 {
        self.ticks as f64 * TICK_S
    }

    pub(super) fn airframe(&self) -> &Airframe {
        &self.airframe
    }

    pub(super) fn end(&self) -> End {
        self.end
    }

    /// Flies one step; an action's numbers are within -1 and 1, others are cut.
    pub(super) fn step(&mut self, rules: &Rules, manner: &Manner, action: [f32; ACTION]) {
        if self.end != End::Flying {
            return;
        }
        // NaN is no wish.
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
        // A stage that was passed counts by the target that it was.
        self.progress_m = before_m.map_or(0.0, |(target_m, from_m)| {
            from_m.distance(target_m) - after_m.distance(target_m)
        });
        if self.end == End::Flying && self.elapsed_s() >= manner.seconds {
            self.end = End::TimeUp;
        }
    }

    /// Returns the next target's place and the vehicle's. [m, world]
    fn target_m(&self, rules: &Rules) -> Option<(DVec3, DVec3)> {
        let (target_m, _) = rules.targets.get(self.course.next())?;
        Some((*target_m, self.airframe.state().p_world_m))
    }

    /// One tick of controllers and physics.
    fn fly(&mut self, rules: &Rules, kind: ActionKind, action: [f64; ACTION]) {
        let truth = self.truth();
        let wish = DVec3::new(action[0], action[1], action[2]);
        let wrench = if kind == ActionKind::BodyRates {
            // 1 more than the weight at most, and nothing at least.
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

    /// Holds the way since the last check against the rules.
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

    /// What the controllers are given: the truth.
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

    /// Writes the state, in the order that `vizflyt.gym` gives: velocity, up, turn, the way to the target and its
    /// direction, position, sine and cosine of the heading, targets left, share of the time left.
    pub(super) fn write_state(&self, rules: &Rules, manner: &Manner, out: &mut [f32; STATE]) {
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

    /// Returns what rewards are made of: progress [m], clearance [m], stages passed, time [s].
    pub(super) fn figures(&self) -> [f32; FIGURES] {
        [
            self.progress_m as f32,
            self.clearance_m as f32,
            self.course.next() as f32,
            self.elapsed_s() as f32,
        ]
    }
}

/// SplitMix64 (Steele, Lea, Flood 2014): numbers that follow from a seed.
struct Noise(u64);

impl Noise {
    /// Returns the next one, from -1 to 1.
    fn signed(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
}

#[cfg(test)]
mod tests {
    use vizflyt_scenes::Variant;
    use vizflyt_scenes::projects::{CourseProject, Level};
    use vizflyt_simulator::autopilot::airframe_limits;

    use super::*;
    use crate::grade::course::CourseInstance;

    const MANNER: Manner =
        Manner { action: ActionKind::Velocity, ticks: 10, delay: 0, seconds: 20.0 };

    fn rules() -> Rules {
        let project = CourseProject::named("square").unwrap();
        let course = CourseInstance::make(&project, Level::Ug, Variant::DAY, 1).unwrap();
        Rules::new(course.arena, course.obstacles, airframe_limits())
    }

    fn state(episode: &Episode, rules: &Rules) -> [f32; STATE] {
        let mut state = [0.0; STATE];
        episode.write_state(rules, &MANNER, &mut state);
        state
    }

    #[test]
    fn a_velocity_is_flown_and_the_fence_ends_it() {
        let rules = rules();
        let mut episode = Episode::start(&rules, &MANNER, 3);
        let most_mps = rules.arena.limits.max_speed_mps as f32;
        for _ in 0..60 {
            episode.step(&rules, &MANNER, [0.4, 0.0, 0.0, 0.0]);
        }
        let flown = state(&episode, &rules);
        // Ahead in its own axes, whichever way it looks.
        assert!((flown[0] - 0.4 * most_mps).abs() < 0.1, "{flown:?}");
        assert!(flown[1].abs() < 0.1 && flown[2].abs() < 0.1, "{flown:?}");
        assert_eq!(episode.end(), End::Flying);
        for _ in 0..400 {
            episode.step(&rules, &MANNER, [1.0, 0.0, 0.0, 0.0]);
        }
        assert!(matches!(episode.end(), End::LeftFence | End::Crashed), "{:?}", episode.end());
        let ended = state(&episode, &rules);
        episode.step(&rules, &MANNER, [-1.0; 4]);
        assert_eq!(state(&episode, &rules), ended, "what is over stays as it is");
    }

    #[test]
    fn the_seed_says_where_it_starts_and_time_ends_it() {
        let rules = rules();
        let begin = |seed| state(&Episode::start(&rules, &MANNER, seed), &rules);
        assert_eq!(begin(1), begin(1));
        assert_ne!(begin(1), begin(2));
        let spawn_m = rules.arena.spawn.position_m + DVec3::Z * rules.arena.takeoff_height_m;
        for seed in 0..50 {
            let start = begin(seed);
            let p_m = DVec3::new(start[15].into(), start[16].into(), start[17].into());
            assert!((p_m - spawn_m).abs().max_element() <= START_M + 1e-6, "seed {seed}: {p_m}");
        }
        let short = Manner { seconds: 1.0, ..MANNER };
        let mut episode = Episode::start(&rules, &short, 1);
        for _ in 0..39 {
            episode.step(&rules, &short, [0.0; ACTION]);
            assert_eq!(episode.end(), End::Flying);
        }
        episode.step(&rules, &short, [0.0; ACTION]);
        assert_eq!(episode.end(), End::TimeUp);
    }

    #[test]
    fn an_action_counts_after_its_delay() {
        let rules = rules();
        let late = Manner { delay: 3, ..MANNER };
        let turned = |manner: &Manner, steps| {
            let mut episode = Episode::start(&rules, manner, 1);
            let before = state(&episode, &rules);
            for _ in 0..steps {
                episode.step(&rules, manner, [0.0, 0.0, 0.0, 1.0]);
            }
            (state(&episode, &rules)[8] - before[8]).abs()
        };
        assert!(turned(&MANNER, 3) > 0.1, "{}", turned(&MANNER, 3));
        assert!(turned(&late, 3) < 1e-3 && turned(&late, 6) > 0.1, "{}", turned(&late, 3));
    }
}
