//! Check by hand: determines wrong pose settings from motions of a vehicle that a person carries. Sans-IO.
//!
//! ```text
//! it stands -> lift it -> push it forward -> turn it left -> raise its nose -> (raise its left side)
//! ```
//! A motion ends when the vehicle rests again. Its size does not matter, so that wrong units are no obstacle.
//! The poses at rest are converted back to the values of the stream, and every combination of settings (units,
//! axes, body, quaternion, order of angles) is tried on them. The direction of the nose in the object follows
//! from the push. The result is the smallest change for which all motions look as requested. The last motion is
//! requested only if several changes of the same size fit.

pub mod description;

use std::collections::VecDeque;
use std::f64::consts::FRAC_PI_2;

use crate::poses::settings::{
    Axes, BodyAxes, Driver, Euler, LocalizationConfig, Nose, Offset, Quaternion, Units, UpAxis,
};
use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World, wrap_pi, yaw_of};

use self::description::direction;

/// Next step of the check.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HandCheckStep {
    /// Place it on the floor.
    Stand,
    /// Lift it.
    Lift,
    /// Push it in the direction of its nose.
    Push,
    /// Turn it left by a quarter turn.
    Turn,
    /// Raise its nose.
    Nose,
    /// Raise its left side; only if the earlier steps do not distinguish the settings.
    Roll,
    /// All steps are complete.
    Done,
}

impl HandCheckStep {
    /// Returns the instruction for the user.
    pub fn ask(self) -> &'static str {
        match self {
            Self::Stand => "put it on the floor and let go",
            Self::Lift => "lift it straight up, by half a metre or so, and hold it still",
            Self::Push => {
                "move it forward, the way its nose points, by half a metre or so; hold still"
            }
            Self::Turn => "turn it to the left by a quarter turn, on the spot; hold still",
            Self::Nose => "raise its nose by some 30 degrees; hold still",
            Self::Roll => {
                "one more, as several settings would explain that: level it, and raise its left side by \
                 some 30 degrees; hold still"
            }
            Self::Done => "that is all",
        }
    }
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Diagnosis {
    /// Faults as sentences; empty if there are none.
    pub faults: Vec<String>,
    /// Settings to change; also empty if no change would help.
    pub change: Change,
    /// Other changes of the same size that would explain all motions as well.
    pub others: Vec<Change>,
}

/// Settings to change, as key and value.
pub type Change = Vec<(&'static str, String)>;

/// State of a check.
#[derive(Debug)]
pub struct Check {
    config: LocalizationConfig,
    step: HandCheckStep,
    /// Poses of the last [`REST_S`], with their times. [s]
    window: VecDeque<(f64, Pose<World, Body>)>,
    /// Pose at rest after each step.
    rests: Vec<Pose<World, Body>>,
}

impl Check {
    /// Starts a check; poses must be converted with these settings.
    pub fn new(config: LocalizationConfig) -> Self {
        Self { config, step: HandCheckStep::Stand, window: VecDeque::new(), rests: Vec::new() }
    }

    /// Returns the current step.
    pub fn step(&self) -> HandCheckStep {
        self.step
    }

    /// Processes a pose at time `at_s` [s]. Returns whether a step is complete.
    pub fn handle_pose(&mut self, at_s: f64, pose: &Pose<World, Body>) -> bool {
        if self.step == HandCheckStep::Done || !pose.is_valid() {
            return false;
        }
        // Limits the number of samples; enough to judge at any source rate.
        if self.window.back().is_none_or(|(last_s, _)| at_s - last_s >= SAMPLE_S) {
            self.window.push_back((at_s, *pose));
        }
        while self.window.front().is_some_and(|(first_s, _)| at_s - first_s > REST_S) {
            self.window.pop_front();
        }
        let Some(rest) = self.rest() else { return false };
        if !self.has_moved(&rest) {
            return false;
        }
        self.rests.push(rest);
        self.window.clear();
        self.step = match self.step {
            HandCheckStep::Stand => HandCheckStep::Lift,
            HandCheckStep::Lift => HandCheckStep::Push,
            HandCheckStep::Push => HandCheckStep::Turn,
            HandCheckStep::Turn => HandCheckStep::Nose,
            HandCheckStep::Nose if !self.diagnosis().others.is_empty() => HandCheckStep::Roll,
            HandCheckStep::Nose | HandCheckStep::Roll | HandCheckStep::Done => HandCheckStep::Done,
        };
        true
    }

    /// Returns the pose at rest; `None` while it moves.
    fn rest(&self) -> Option<Pose<World, Body>> {
        let (first, last) = (self.window.front()?, self.window.back()?);
        if self.window.len() < MIN_SAMPLES || last.0 - first.0 < REST_S * 0.9 {
            return None;
        }
        let mean = |from: usize, to: usize| {
            let sum: DVec3 = self.window.range(from..to).map(|(_, pose)| pose.translation_m).sum();
            sum / (to - from) as f64
        };
        let count = self.window.len();
        let middle = mean(0, count);
        let off = |(_, pose): &(f64, Pose<World, Body>)| (pose.translation_m - middle).length();
        let extent = self.window.iter().map(off).fold(0.0, f64::max);
        let drift = (mean(count / 2, count) - mean(0, count / 2)).length();
        // Noise changes direction, motion continues in one: this holds in any unit. A motion that is small
        // compared with the earlier ones also counts as rest.
        let far = self.rests.iter().map(|rest| (rest.translation_m - middle).length());
        let far = far.fold(0.0, f64::max);
        let rests = drift <= 0.25 * extent || extent <= 0.03 * far;
        let turned = |(_, pose): &(f64, Pose<World, Body>)| {
            pose.rotation.dot(last.1.rotation).abs().min(1.0).acos() * 2.0
        };
        let turned_rad = self.window.iter().map(turned).fold(0.0, f64::max);
        (rests && turned_rad < STILL_RAD).then(|| Pose::new(middle, last.1.rotation))
    }

    /// Returns whether the motion of this step lies between the last rest and this one.
    fn has_moved(&self, rest: &Pose<World, Body>) -> bool {
        let Some(last) = self.rests.last() else { return true };
        let moved = (rest.translation_m - last.translation_m).length();
        let off = |(_, pose): &(f64, Pose<World, Body>)| {
            (pose.translation_m - rest.translation_m).length()
        };
        let noise = self.window.iter().map(off).fold(0.0, f64::max);
        let turned_rad = rest.rotation.dot(last.rotation).abs().min(1.0).acos() * 2.0;
        match self.step {
            HandCheckStep::Stand | HandCheckStep::Done => true,
            HandCheckStep::Lift => moved > 20.0 * noise + f64::MIN_POSITIVE,
            // The lift shows the size of a motion in the stream's unit.
            HandCheckStep::Push => moved > 0.3 * self.lifted(),
            HandCheckStep::Turn => turned_rad > MIN_TURN_RAD,
            HandCheckStep::Nose | HandCheckStep::Roll => turned_rad > MIN_NOSE_RAD,
        }
    }

    fn lifted(&self) -> f64 {
        match &*self.rests {
            [stood, lifted, ..] => (lifted.translation_m - stood.translation_m).length(),
            _ => 0.0,
        }
    }

    /// Returns a description of the last motion.
    pub fn seen(&self) -> String {
        let moved = |a: &Pose<World, Body>, b: &Pose<World, Body>| {
            let v = b.translation_m - a.translation_m;
            format!("it went {} along {}", length(v.length()), direction(v))
        };
        match &*self.rests {
            [] => String::new(),
            [_] => "it stands".to_owned(),
            [a, b] | [_, a, b] => moved(a, b),
            [.., a, b] => {
                let turned = (b.rotation * a.rotation.conjugate()).normalize();
                // The shorter rotation.
                let turned = if turned.w < 0.0 { -turned } else { turned };
                let turned = turned.to_scaled_axis();
                let degrees = turned.length().to_degrees();
                format!("it turned by {degrees:.0} degrees about {}", direction(turned))
            }
        }
    }

    /// Returns the diagnosis after all steps.
    pub fn diagnosis(&self) -> Diagnosis {
        let faults = faults(&self.rests);
        if faults.is_empty() {
            return Diagnosis::default();
        }
        let mut fitting: Vec<_> = self.trials().flat_map(|trial| self.fit(&trial)).collect();
        fitting.sort_by(|a, b| self.cost(a).total_cmp(&self.cost(b)));
        let Some(&best) = fitting.first() else {
            return Diagnosis { faults, ..Default::default() };
        };
        let change = self.change_to(&best);
        let mut told = vec![best];
        for trial in fitting {
            let is_as_small = self.change_to(&trial).len() == change.len();
            // Among orders of angles that differ too little to be measured by hand, the vendors' usual ones are
            // kept.
            let is_usual = USUAL_EULERS.contains(&trial.euler) || trial.euler == best.euler;
            if is_as_small && is_usual && told.iter().all(|other| !self.is_same(other, &trial)) {
                told.push(trial);
            }
        }
        let others = told[1..].iter().map(|trial| self.change_to(trial)).collect();
        Diagnosis { faults, change, others }
    }

    /// Returns every combination of settings except the nose.
    fn trials(&self) -> impl Iterator<Item = Trial> {
        let driver = self.config.driver;
        let eulers = if driver == Driver::Vicon { &Euler::ALL[..] } else { &Euler::ALL[..1] };
        let quaternions = &Quaternion::ALL[..if driver.has_quaternions() { 4 } else { 1 }];
        let laid = Axes::all().flat_map(|axes| {
            // The named body axes do not apply to a mirrored frame.
            let bodies = &BodyAxes::ALL[..if axes.is_mirror() { 1 } else { 3 }];
            bodies.iter().map(move |&body| (axes, body))
        });
        laid.flat_map(move |(axes, body)| {
            quaternions.iter().flat_map(move |&quaternion| {
                eulers.iter().flat_map(move |&euler| {
                    Units::ALL.into_iter().map(move |units| Trial {
                        units,
                        axes,
                        body,
                        quaternion,
                        nose: Nose::default(),
                        euler,
                    })
                })
            })
        })
    }

    /// Returns a trial with every nose (named, or as measured from the push) for which all motions look as
    /// requested.
    fn fit(&self, trial: &Trial) -> Vec<Trial> {
        let rests = self.under(trial);
        // Assumes the nose along x: another nose only turns the body about its own vertical axis.
        if !stands_and_rises(&rests) {
            return Vec::new();
        }
        let [_, lifted, pushed, ..] = &*rests else { return Vec::new() };
        let (ahead_world, body) = push(lifted, pushed);
        let ahead = body.conjugate() * ahead_world;
        let seen = Nose::from_deg(ahead.y.atan2(ahead.x).to_degrees().round());
        let mut noses = vec![self.config.nose];
        noses.extend(Nose::NAMED.into_iter().filter(|nose| *nose != self.config.nose));
        // A push by hand is not straighter: within this tolerance the named direction is used.
        if noses.iter().all(|nose| apart_deg(*nose, seen) > STRAIGHT_DEG) {
            noses.push(seen);
        }
        let turned = noses.into_iter().map(|nose| Trial { nose, ..*trial });
        turned.filter(|trial| faults(&self.under(trial)).is_empty()).collect()
    }

    fn now(&self) -> Trial {
        Trial {
            units: self.config.units.unwrap_or(self.config.driver.usual_units()),
            axes: self.config.stream_axes(),
            body: self.config.body,
            quaternion: self.config.quaternion,
            nose: self.config.nose,
            euler: self.config.euler.unwrap_or_default(),
        }
    }

    /// Returns the poses at rest, converted with the settings of a trial.
    fn under(&self, trial: &Trial) -> Vec<Pose<World, Body>> {
        let (was, would) = (self.config.alignment(), self.with(trial).alignment());
        let again = |pose: &Pose<World, Body>| {
            let (p_stream, rotation) = was.streamed(pose);
            would.world_from_body(p_stream, self.reread(trial, rotation))
        };
        self.rests.iter().map(again).collect()
    }

    /// Returns the settings with the values of a trial.
    fn with(&self, trial: &Trial) -> LocalizationConfig {
        LocalizationConfig {
            units: Some(trial.units),
            up: None,
            axes: Some(trial.axes),
            body: trial.body,
            quaternion: trial.quaternion,
            nose: trial.nose,
            ..self.config.clone()
        }
    }

    /// Returns a streamed rotation with its angles in the order of a trial.
    fn reread(&self, trial: &Trial, rotation: DQuat) -> DQuat {
        if self.config.driver == Driver::Vicon {
            trial.euler.rotation(self.now().euler.angles(rotation))
        } else {
            rotation
        }
    }

    /// Returns whether two trials give the same poses for any stream. Ignored are the choice of the x axis,
    /// which this check cannot determine, and noses that differ by less than the accuracy of a push.
    fn is_same(&self, a: &Trial, b: &Trial) -> bool {
        let nose = if apart_deg(a.nose, b.nose) > STRAIGHT_DEG { b.nose } else { a.nose };
        let b = Trial { nose, ..*b };
        let poses = |trial: &Trial| {
            let config = self.with(trial);
            let config =
                LocalizationConfig { offset: Offset::default(), pivot_m: DVec3::ZERO, ..config };
            PROBES.map(|[x, y, z]| {
                let axis = DVec3::new(x, y, z);
                let rotation = self.reread(trial, DQuat::from_scaled_axis(axis));
                config.alignment().world_from_body(axis, rotation)
            })
        };
        let (a, b) = (poses(a), poses(&b));
        let turn = (b[0].rotation * a[0].rotation.conjugate()).normalize();
        turn.mul_vec3(DVec3::Z).z > 1.0 - SAME
            && a.iter().zip(&b).all(|(a, b)| {
                let off_m = (turn * a.translation_m - b.translation_m).length();
                let agrees = (turn * a.rotation).dot(b.rotation).abs() > 1.0 - SAME;
                agrees && off_m <= SAME * b.translation_m.length()
            })
    }

    /// Returns the cost of a trial: one per changed setting, plus a little for unusual values.
    fn cost(&self, trial: &Trial) -> f64 {
        let now = self.now();
        let mut cost = 0.0;
        if trial.units != now.units {
            cost += 1.0;
        }
        if trial.quaternion != now.quaternion {
            cost += 1.0 + 0.02 * trial.quaternion as u8 as f64;
        }
        if trial.body != now.body {
            let usual = [BodyAxes::Flu, BodyAxes::Frd, BodyAxes::Stream];
            let place = usual.iter().position(|body| *body == trial.body);
            cost += 1.0 + 0.02 * place.unwrap_or(usual.len()) as f64;
        }
        if trial.nose != now.nose {
            cost += 1.0 + if Nose::NAMED.contains(&trial.nose) { 0.0 } else { 0.1 };
        }
        if trial.axes != now.axes {
            let usual = [UpAxis::Z.axes(), UpAxis::Y.axes()].contains(&trial.axes);
            cost += 1.0
                + if usual { 0.0 } else { 0.2 }
                + if trial.axes.is_mirror() { 0.2 } else { 0.0 };
        }
        if trial.euler != now.euler {
            let place = USUAL_EULERS.iter().position(|euler| *euler == trial.euler);
            cost += 1.0 + 0.05 * place.unwrap_or(USUAL_EULERS.len()) as f64;
        }
        cost
    }

    fn change_to(&self, trial: &Trial) -> Change {
        let now = self.now();
        let mut change = Vec::new();
        if trial.units != now.units {
            change.push(("units", trial.units.to_string()));
        }
        if trial.axes != now.axes {
            change.push(match trial.axes {
                axes if self.config.axes.is_none() && axes == UpAxis::Y.axes() => {
                    ("up", "y".to_owned())
                }
                axes if self.config.axes.is_none() && axes == UpAxis::Z.axes() => {
                    ("up", "z".to_owned())
                }
                axes => ("axes", axes.to_string()),
            });
        }
        if trial.body != now.body {
            change.push(("body", trial.body.to_string()));
        }
        if trial.quaternion != now.quaternion {
            change.push(("quaternion", trial.quaternion.to_string()));
        }
        if trial.nose != now.nose {
            change.push(("nose", trial.nose.to_string()));
        }
        if trial.euler != now.euler {
            change.push(("euler", trial.euler.to_string()));
        }
        change
    }
}

#[derive(Clone, Copy, Debug)]
struct Trial {
    units: Units,
    axes: Axes,
    body: BodyAxes,
    quaternion: Quaternion,
    nose: Nose,
    euler: Euler,
}

/// Returns the displacement of the push, and the mean attitude during it. [m, world]
fn push(lifted: &Pose<World, Body>, pushed: &Pose<World, Body>) -> (DVec3, DQuat) {
    let ahead = pushed.translation_m - lifted.translation_m;
    (ahead, lifted.rotation.slerp(pushed.rotation, 0.5))
}

/// Returns the angle between two noses. [deg]
fn apart_deg(a: Nose, b: Nose) -> f64 {
    wrap_pi((a.deg() - b.deg()).to_radians()).abs().to_degrees()
}

/// Returns whether the vehicle stands upright and was lifted upwards.
fn stands_and_rises(rests: &[Pose<World, Body>]) -> bool {
    let [stood, lifted, ..] = rests else { return false };
    let lift = lifted.translation_m - stood.translation_m;
    stood.rotate(DVec3::Z).z > NEARLY && lift.z > NEARLY * lift.length()
}

/// Returns the motions that do not look as requested.
fn faults(rests: &[Pose<World, Body>]) -> Vec<String> {
    let [stood, lifted, pushed, turned, raised, rolled @ ..] = rests else {
        return vec!["not all was done".to_owned()];
    };
    let mut faults = Vec::new();
    let up = |pose: &Pose<World, Body>| pose.rotate(DVec3::Z);
    if !(up(stood).z > NEARLY) {
        faults.push(format!(
            "it stands on the floor, and its up is {}, not +z",
            direction(up(stood))
        ));
    }
    let lift = lifted.translation_m - stood.translation_m;
    if !(lift.z > NEARLY * lift.length()) {
        faults.push(format!("lifted, it went along {}, not up", direction(lift)));
    }
    if !(HAND_M.0..HAND_M.1).contains(&lift.length()) {
        faults.push(format!("lifted by half a metre or so, it went {}", length(lift.length())));
    }
    let (push, body) = push(lifted, pushed);
    let nose = body * DVec3::X;
    if !(push.dot(nose) > STRAIGHT_DEG.to_radians().cos() * push.length()) {
        faults.push(format!(
            "pushed the way its nose points, it went along {}, while its nose points {}",
            direction(push),
            direction(nose)
        ));
    }
    let left_rad = wrap_pi(yaw_of(turned.rotation) - yaw_of(pushed.rotation));
    if !((left_rad - FRAC_PI_2).abs() < QUARTER_OFF_RAD) || !(up(turned).z > NEARLY) {
        let how = if left_rad < 0.0 { "right" } else { "left" };
        faults.push(format!(
            "turned left by a quarter, it turned {how} by {:.0} degrees, and its up is {}",
            left_rad.abs().to_degrees(),
            direction(up(turned))
        ));
    }
    let (nose_z, side_z) = (raised.rotate(DVec3::X).z, raised.rotate(DVec3::Y).z);
    if !(nose_z > MIN_NOSE_RAD.sin() * 0.8 && side_z.abs() < 0.5 * nose_z) {
        faults.push(format!(
            "with its nose raised, its nose points {:.0} degrees up and its left side {:.0}",
            nose_z.clamp(-1.0, 1.0).asin().to_degrees(),
            side_z.clamp(-1.0, 1.0).asin().to_degrees()
        ));
    }
    if let [rolled, ..] = rolled {
        let (nose_z, side_z) = (rolled.rotate(DVec3::X).z, rolled.rotate(DVec3::Y).z);
        if !(side_z > MIN_NOSE_RAD.sin() * 0.8 && nose_z.abs() < 0.5 * side_z) {
            faults.push(format!(
                "with its left side raised, that points {:.0} degrees up and its nose {:.0}",
                side_z.clamp(-1.0, 1.0).asin().to_degrees(),
                nose_z.clamp(-1.0, 1.0).asin().to_degrees()
            ));
        }
    }
    faults
}

/// Formats a length, in mm if it is short.
fn length(m: f64) -> String {
    if m < 0.01 { format!("{:.2} mm", m * 1e3) } else { format!("{m:.2} m") }
}

/// Minimum duration of rest. [s]
const REST_S: f64 = 0.8;
/// Minimum time between samples of the window: at most 40 Hz. [s]
const SAMPLE_S: f64 = 0.025;
/// Minimum samples of a rest; satisfied from 10 Hz.
const MIN_SAMPLES: usize = 7;
/// Maximum rotation at rest: more than the tremor of a hand. [rad]
const STILL_RAD: f64 = 0.06;
/// Minimum turn of 40 degrees, and minimum raise of the nose of 12 degrees. [rad]
const MIN_TURN_RAD: f64 = 0.7;
const MIN_NOSE_RAD: f64 = 0.21;
/// Maximum error of a quarter turn by hand: 35 degrees. [rad]
const QUARTER_OFF_RAD: f64 = 0.61;
/// Cosine of 30 degrees: maximum error of a motion along an axis.
const NEARLY: f64 = 0.866;
/// Orders of angles that vendors use; the others are tried as well.
const USUAL_EULERS: [Euler; 3] = [Euler::Xyz, Euler::Zyx, Euler::Vector];
/// Maximum error of a push's direction. [deg]
const STRAIGHT_DEG: f64 = 15.0;
/// Maximum relative difference of equal poses.
const SAME: f64 = 1e-6;
/// Rotation vectors, also used as positions, by which combinations of settings are distinguished. They have no
/// symmetry.
const PROBES: [[f64; 3]; 4] =
    [[0.3, -0.7, 1.1], [1.9, 0.2, -0.4], [-0.6, 1.3, 0.5], [0.1, 0.4, -2.3]];
/// Accepted length for "half a metre or so"; centimetres and millimetres differ by a factor of ten. [m]
const HAND_M: (f64, f64) = (0.15, 1.5);

#[cfg(test)]
mod tests;
