//! Poses of an arena's objects at any instant: one clock for images and referee.
//!
//! ```text
//! [[objects]] of arena.toml, seed -> MovingObjects
//! nanoseconds since the arena's epoch -> a pose for each object
//! ```
//! Pure: an instant gives the same bits on every machine, in any order of calls. The epoch is the server's
//! start of the arena, or 0 in a lock-step run. Budget: 0.1 us per object; the render thread calls it once per
//! image, the referee a few times per pose.

use std::f64::consts::TAU;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Object, Pose, World};
use vizflyt_protocol::random;

use crate::config::{ArenaConfig, MotionConfig, ObjectConfig};

/// Objects of an arena with their motions.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MovingObjects {
    objects: Vec<MovingObject>,
}

/// Upper bound of an object's speed: `linear_mps` plus `angular_radps` times the distance of a point from the
/// object's origin.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TopSpeed {
    /// Maximum speed of the origin. [m/s]
    pub linear_mps: f64,
    /// Maximum angular speed about the origin. [rad/s]
    pub angular_radps: f64,
}

#[derive(Clone, Debug, PartialEq)]
struct MovingObject {
    name: String,
    rest: Pose<World, Object>,
    motion: ObjectMotion,
    period_ns: u64,
    /// Part of the period that had passed at the epoch.
    phase_ns: u64,
}

/// [`MotionConfig`], prepared for evaluation.
#[derive(Clone, Debug, PartialEq)]
enum ObjectMotion {
    None,
    Rotation {
        /// Unit vector. [object]
        axis: DVec3,
    },
    Oscillation {
        slide_m: DVec3,
        /// Unit vector, or zero. [object]
        axis: DVec3,
        swing_rad: f64,
    },
    /// Corners of one round, with the first one again at the end, and the path length at each.
    Path {
        corners_m: Vec<DVec3>,
        along_m: Vec<f64>,
        speed_mps: f64,
    },
}

impl MovingObjects {
    /// Returns an arena's objects; absent phases are random by the seed.
    ///
    /// ```
    /// use vizflyt_arena::config::{MotionConfig, ObjectConfig};
    /// use vizflyt_arena::objects::MovingObjects;
    /// use glam::DVec3;
    /// let hand = ObjectConfig {
    ///     name: "hand".into(),
    ///     scene: "hand.ply".into(),
    ///     position_m: DVec3::new(5.0, 0.0, 1.0),
    ///     yaw_deg: 0.0,
    ///     phase_s: Some(0.0),
    ///     motion: Some(MotionConfig::Rotation { axis: DVec3::X, period_s: 4.0 }),
    /// };
    /// let objects = MovingObjects::of(&[hand], 7);
    /// // A quarter of a turn later, the direction that pointed up points to -y.
    /// let pose = objects.placements(1_000_000_000)[0].unwrap();
    /// assert!((pose.rotate(DVec3::Z) - DVec3::NEG_Y).length() < 1e-12);
    /// ```
    pub fn new(config: &ArenaConfig, seed: u64) -> Self {
        Self::of(&config.objects, seed)
    }

    /// Same as [`Self::new`], for a list of objects.
    pub fn of(objects: &[ObjectConfig], seed: u64) -> Self {
        let of = |(index, object): (usize, &ObjectConfig)| MovingObject::new(object, index, seed);
        Self { objects: objects.iter().enumerate().map(of).collect() }
    }

    pub fn len(&self) -> usize {
        self.objects.len()
    }

    pub fn is_empty(&self) -> bool {
        self.objects.is_empty()
    }

    /// Returns the objects with these indices, on the same clock.
    #[must_use]
    pub fn select(&self, indices: &[usize]) -> Self {
        Self { objects: indices.iter().map(|&index| self.objects[index].clone()).collect() }
    }

    pub fn moves(&self, index: usize) -> bool {
        self.objects[index].motion != ObjectMotion::None
    }

    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.objects.iter().map(|object| &*object.name)
    }

    /// Returns the pose of an object at a time after the epoch; negative is before. [ns]
    pub fn placement(&self, index: usize, since_epoch_ns: i64) -> Pose<World, Object> {
        self.objects[index].at(since_epoch_ns)
    }

    /// Returns the poses of all objects in the form of a renderer. [ns]
    pub fn placements(&self, since_epoch_ns: i64) -> Vec<Option<Pose<World, Object>>> {
        let mut placements = Vec::with_capacity(self.len());
        self.place(since_epoch_ns, &mut placements);
        placements
    }

    /// Appends the poses of all objects, without allocating in a loop. [ns]
    pub fn place(&self, since_epoch_ns: i64, placements: &mut Vec<Option<Pose<World, Object>>>) {
        placements.extend(self.objects.iter().map(|object| Some(object.at(since_epoch_ns))));
    }

    /// Returns the maximum speed of an object.
    pub fn top_speed(&self, index: usize) -> TopSpeed {
        self.objects[index].top_speed()
    }
}

impl MovingObject {
    fn new(config: &ObjectConfig, index: usize, seed: u64) -> Self {
        let (motion, period_s) = match &config.motion {
            None => (ObjectMotion::None, 1.0),
            Some(MotionConfig::Rotation { axis, period_s }) => {
                (ObjectMotion::Rotation { axis: axis.normalize_or(DVec3::Z) }, *period_s)
            }
            Some(MotionConfig::Oscillation { slide_m, axis, swing_deg, period_s }) => {
                let axis = axis.normalize_or_zero();
                let swing_rad = if axis == DVec3::ZERO { 0.0 } else { swing_deg.to_radians() };
                (ObjectMotion::Oscillation { slide_m: *slide_m, axis, swing_rad }, *period_s)
            }
            Some(MotionConfig::Path { points_m, speed_mps, closed }) => {
                let mut corners_m = points_m.clone();
                if *closed {
                    corners_m.extend(points_m.first());
                } else {
                    corners_m.extend(points_m.iter().rev().skip(1));
                }
                let mut length_m = 0.0;
                let mut along_m = vec![0.0];
                for pair in corners_m.windows(2) {
                    length_m += (pair[1] - pair[0]).length();
                    along_m.push(length_m);
                }
                (
                    ObjectMotion::Path { corners_m, along_m, speed_mps: *speed_mps },
                    length_m / speed_mps,
                )
            }
        };
        let period_ns = ((period_s * 1e9).round() as u64).max(1);
        let phase_ns = match config.phase_s {
            Some(phase_s) => (phase_s * 1e9).round() as u64 % period_ns,
            None => random::nth(seed, index as u64) % period_ns,
        };
        let yaw_rad = config.yaw_deg.to_radians();
        let rest = Pose::new(config.position_m, turn(DVec3::Z, yaw_rad));
        Self { name: config.name.clone(), rest, motion, period_ns, phase_ns }
    }

    fn at(&self, since_epoch_ns: i64) -> Pose<World, Object> {
        // Whole nanoseconds, in a type wide enough for any instant: no rounding over time.
        let ns = i128::from(since_epoch_ns) + i128::from(self.phase_ns);
        let into_ns = ns.rem_euclid(i128::from(self.period_ns)) as u64;
        let share = into_ns as f64 / self.period_ns as f64;
        let (offset_m, rotation) = match &self.motion {
            ObjectMotion::None => (DVec3::ZERO, DQuat::IDENTITY),
            ObjectMotion::Rotation { axis } => (DVec3::ZERO, turn(*axis, TAU * share)),
            ObjectMotion::Oscillation { slide_m, axis, swing_rad } => {
                let side = libm::sin(TAU * share);
                (*slide_m * side, turn(*axis, *swing_rad * side))
            }
            ObjectMotion::Path { corners_m, along_m, .. } => {
                let way_m = share * along_m[along_m.len() - 1];
                // The last corner that has been passed; the first one is passed at 0.
                let n = along_m.partition_point(|&at_m| at_m <= way_m).clamp(1, along_m.len() - 1);
                let leg_m = along_m[n] - along_m[n - 1];
                let part = if leg_m > 0.0 { (way_m - along_m[n - 1]) / leg_m } else { 0.0 };
                (corners_m[n - 1].lerp(corners_m[n], part.clamp(0.0, 1.0)), DQuat::IDENTITY)
            }
        };
        let Pose { translation_m, rotation: rest, .. } = self.rest;
        Pose::new(translation_m + rest * offset_m, (rest * rotation).normalize())
    }

    fn top_speed(&self) -> TopSpeed {
        let turns_radps = TAU / (self.period_ns as f64 * 1e-9);
        match &self.motion {
            ObjectMotion::None => TopSpeed::default(),
            ObjectMotion::Rotation { .. } => {
                TopSpeed { linear_mps: 0.0, angular_radps: turns_radps }
            }
            ObjectMotion::Oscillation { slide_m, swing_rad, .. } => TopSpeed {
                linear_mps: slide_m.length() * turns_radps,
                angular_radps: swing_rad.abs() * turns_radps,
            },
            ObjectMotion::Path { speed_mps, .. } => {
                TopSpeed { linear_mps: *speed_mps, angular_radps: 0.0 }
            }
        }
    }
}

/// Returns a rotation about a unit axis; `libm` gives the same result on every machine.
fn turn(axis: DVec3, angle_rad: f64) -> DQuat {
    let (sin, cos) = libm::sincos(angle_rad / 2.0);
    DQuat::from_xyzw(axis.x * sin, axis.y * sin, axis.z * sin, cos)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn object(motion: impl Into<Option<MotionConfig>>, phase_s: Option<f64>) -> ObjectConfig {
        ObjectConfig {
            name: "thing".into(),
            scene: "thing.ply".into(),
            position_m: DVec3::new(1.0, 2.0, 3.0),
            yaw_deg: 90.0,
            phase_s,
            motion: motion.into(),
        }
    }

    fn one(motion: MotionConfig) -> MovingObjects {
        MovingObjects::of(&[object(motion, Some(0.0))], 0)
    }

    const S: i64 = 1_000_000_000;

    #[test]
    fn rotation_is_even_and_exact_after_a_year() {
        let hand = one(MotionConfig::Rotation { axis: DVec3::X * 3.0, period_s: 6.0 });
        // At rest turned left, the hand turns in the plane of x and z.
        let up_at = |ns| hand.placement(0, ns).rotate(DVec3::Z);
        assert!((up_at(0) - DVec3::Z).length() < 1e-12);
        assert!((up_at(S * 3 / 2) - DVec3::X).length() < 1e-12);
        assert!((up_at(3 * S) + DVec3::Z).length() < 1e-12);
        // A year later, to the nanosecond: the same bits.
        let year = 5_256_000 * 6 * S;
        for ns in [0, 1, 17, S, 6 * S - 1] {
            assert_eq!(hand.placement(0, year + ns), hand.placement(0, ns));
            assert_eq!(hand.placement(0, ns - year), hand.placement(0, ns));
        }
        // A microsecond makes a difference: 1 um of motion one metre along the hand.
        let moved_m = (up_at(1001) - up_at(1)).length();
        assert!((moved_m / (TAU / 6.0 * 1e-6) - 1.0).abs() < 1e-6, "{moved_m}");
    }

    #[test]
    fn doors_slide_and_pendulums_swing_and_paths_are_followed() {
        let door = one(MotionConfig::Oscillation {
            slide_m: DVec3::X * 0.8,
            axis: DVec3::ZERO,
            swing_deg: 0.0,
            period_s: 4.0,
        });
        let far = door.placement(0, S);
        assert!((far.translation_m - DVec3::new(1.0, 2.8, 3.0)).length() < 1e-12);
        assert!((door.placement(0, 3 * S).translation_m.y - 1.2).abs() < 1e-12);
        let pendulum = one(MotionConfig::Oscillation {
            slide_m: DVec3::ZERO,
            axis: DVec3::X,
            swing_deg: 90.0,
            period_s: 4.0,
        });
        let down = pendulum.placement(0, S).rotate(DVec3::NEG_Z);
        assert!((down - DVec3::NEG_X).length() < 1e-12, "{down}");
        let points_m = vec![DVec3::ZERO, DVec3::X, DVec3::X + DVec3::Y];
        let path =
            |closed| one(MotionConfig::Path { points_m: points_m.clone(), speed_mps: 1.0, closed });
        let at = |objects: &MovingObjects, s: f64| {
            // In the object's axes at rest, from its rest position.
            let offset_m =
                objects.placement(0, (s * 1e9) as i64).translation_m - DVec3::new(1.0, 2.0, 3.0);
            DVec3::new(offset_m.y, -offset_m.x, offset_m.z)
        };
        let back = path(false);
        assert!((at(&back, 1.5) - DVec3::new(1.0, 0.5, 0.0)).length() < 1e-9);
        assert!((at(&back, 2.5) - DVec3::new(1.0, 0.5, 0.0)).length() < 1e-9);
        assert!((at(&back, 3.5) - DVec3::new(0.5, 0.0, 0.0)).length() < 1e-9);
        let round = path(true);
        let corner = 2.0 + 0.5 * 2f64.sqrt();
        assert!((at(&round, corner) - DVec3::new(0.5, 0.5, 0.0)).length() < 1e-9);
    }

    #[test]
    fn phases_come_from_the_seed_unless_given() {
        let motion = MotionConfig::Rotation { axis: DVec3::X, period_s: 6.0 };
        let random = |seed| MovingObjects::of(&[object(motion.clone(), None)], seed);
        assert_eq!(random(3), random(3));
        assert_ne!(random(3).placements(0), random(4).placements(0));
        let fixed = |seed| MovingObjects::of(&[object(motion.clone(), Some(7.5))], seed);
        assert_eq!(fixed(3), fixed(4));
        assert_eq!(fixed(3).placements(0), one(motion.clone()).placements(S * 3 / 2));
    }

    #[test]
    fn object_without_motion_is_fixed() {
        let frame = MovingObjects::of(&[object(None, None)], 3);
        let rest = frame.placement(0, 0);
        assert_eq!(rest.translation_m, DVec3::new(1.0, 2.0, 3.0));
        assert!((rest.rotate(DVec3::X) - DVec3::Y).length() < 1e-12);
        assert_eq!((frame.placement(0, 5 * S), frame.top_speed(0)), (rest, TopSpeed::default()));
        assert!(
            !frame.moves(0)
                && one(MotionConfig::Rotation { axis: DVec3::X, period_s: 6.0 }).moves(0)
        );
    }

    fn motions() -> impl Strategy<Value = MotionConfig> {
        let vector = || prop::array::uniform3(-2.0..2.0f64).prop_map(DVec3::from);
        prop_oneof![
            (vector(), 0.05..20.0f64)
                .prop_map(|(axis, period_s)| MotionConfig::Rotation { axis, period_s }),
            (vector(), vector(), -180.0..180.0f64, 0.05..20.0f64).prop_map(
                |(slide_m, axis, swing_deg, period_s)| MotionConfig::Oscillation {
                    slide_m,
                    axis,
                    swing_deg,
                    period_s
                }
            ),
            (prop::collection::vec(vector(), 2..6), 0.01..10.0f64, any::<bool>()).prop_map(
                |(points_m, speed_mps, closed)| MotionConfig::Path { points_m, speed_mps, closed }
            ),
        ]
    }

    proptest! {
        /// Poses are valid at any instant, and no point exceeds the top speed.
        #[test]
        fn no_point_is_faster_than_the_top_speed(
            motion in motions(), ns in any::<i64>(), step_ns in 1..2_000_000_000i64,
            p in prop::array::uniform3(-2.0..2.0f64).prop_map(DVec3::from),
        ) {
            let objects = MovingObjects::of(&[object(motion, None)], 5);
            let (a, b) = (objects.placement(0, ns), objects.placement(0, ns.saturating_add(step_ns)));
            prop_assert!(a.is_valid() && b.is_valid());
            let TopSpeed { linear_mps, angular_radps } = objects.top_speed(0);
            let most_m = (linear_mps + angular_radps * p.length()) * step_ns as f64 * 1e-9;
            let moved_m = (a.transform_point(p) - b.transform_point(p)).length();
            prop_assert!(moved_m <= most_m * (1.0 + 1e-6) + 1e-8, "{} m of {} m", moved_m, most_m);
        }
    }
}
