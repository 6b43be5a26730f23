//! The course: openings to pass in order, then the goal.

use glam::DVec3;

use crate::config::{ArenaConfig, Goal, StageConfig};

/// One thing that the vehicle achieved.
#[derive(Clone, Debug, PartialEq)]
pub enum Progress {
    /// Passed the stage with this index.
    Stage(usize),
    /// Reached the goal, all stages passed.
    Finished,
    /// Reached the goal, but the stage with this index was not passed. Said once.
    GoalTooEarly(usize),
}

/// Follows one vehicle along the stages.
#[derive(Clone, Debug)]
pub struct Course {
    stages: Vec<Opening>,
    goal: Option<Goal>,
    next: usize,
    finished: bool,
    told_too_early: bool,
}

impl Course {
    /// Makes the course of an arena, nothing passed yet.
    pub fn new(config: &ArenaConfig) -> Self {
        Self {
            stages: config.stages.iter().map(Opening::new).collect(),
            goal: config.goal,
            next: 0,
            finished: false,
            told_too_early: false,
        }
    }

    /// Takes the way of the body's centre between two poses; returns what it achieved. [m, world]
    pub fn advance(&mut self, from_m: DVec3, to_m: DVec3) -> Option<Progress> {
        if self.finished {
            return None;
        }
        if let Some(stage) = self.stages.get(self.next)
            && stage.is_passed(from_m, to_m)
        {
            self.next += 1;
            return Some(Progress::Stage(self.next - 1));
        }
        let goal = self.goal?;
        if !(distance_to_segment_m(goal.position_m, from_m, to_m) <= goal.radius_m) {
            return None;
        }
        if self.next == self.stages.len() {
            self.finished = true;
            return Some(Progress::Finished);
        }
        (!std::mem::replace(&mut self.told_too_early, true))
            .then_some(Progress::GoalTooEarly(self.next))
    }
}

/// A rectangle in space with a direction.
#[derive(Clone, Copy, Debug)]
struct Opening {
    center_m: DVec3,
    normal: DVec3,
    /// Unit vector along the width, level.
    across: DVec3,
    half_width_m: f64,
    half_height_m: f64,
}

impl Opening {
    fn new(stage: &StageConfig) -> Self {
        let normal = stage.normal.normalize_or(DVec3::X);
        // A gate in the floor has no level width of its own; any will do.
        let across = DVec3::Z.cross(normal).normalize_or(DVec3::Y);
        Self {
            center_m: stage.center_m,
            normal,
            across,
            half_width_m: stage.width_m / 2.0,
            half_height_m: stage.height_m / 2.0,
        }
    }

    /// Whether the way crosses the rectangle in its direction.
    fn is_passed(&self, from_m: DVec3, to_m: DVec3) -> bool {
        let before_m = self.normal.dot(from_m - self.center_m);
        let after_m = self.normal.dot(to_m - self.center_m);
        if !(before_m < 0.0 && after_m >= 0.0) {
            return false;
        }
        let at_m = from_m.lerp(to_m, before_m / (before_m - after_m)) - self.center_m;
        let up = self.normal.cross(self.across);
        at_m.dot(self.across).abs() <= self.half_width_m && at_m.dot(up).abs() <= self.half_height_m
    }
}

fn distance_to_segment_m(p_m: DVec3, a_m: DVec3, b_m: DVec3) -> f64 {
    let way_m = b_m - a_m;
    let share = (p_m - a_m).dot(way_m) / way_m.length_squared().max(f64::MIN_POSITIVE);
    (p_m - a_m - way_m * share.clamp(0.0, 1.0)).length()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::referee::tests::arena;

    fn course() -> Course {
        let mut config = arena();
        config.stages = vec![StageConfig {
            name: "window".into(),
            center_m: DVec3::new(3.0, 0.0, 1.0),
            normal: DVec3::X,
            width_m: 1.0,
            height_m: 0.8,
        }];
        Course::new(&config)
    }

    fn check(way: &[[f64; 3]], expected: &[Progress]) {
        let mut course = course();
        let found: Vec<_> = way
            .windows(2)
            .filter_map(|pair| course.advance(pair[0].into(), pair[1].into()))
            .collect();
        assert_eq!(found, expected);
    }

    #[test]
    fn stages_count_in_order_direction_and_opening() {
        let through = [Progress::Stage(0), Progress::Finished];
        check(&[[1., 0., 1.], [5., 0.2, 1.2], [8., 0., 1.], [9., 0., 1.]], &through);
        // Beside, above, and the wrong way: not passed, so the goal does not count either.
        let missed = [Progress::GoalTooEarly(0)];
        check(&[[1., 0.6, 1.], [5., 0.6, 1.], [8., 0., 1.], [8.1, 0., 1.]], &missed);
        check(&[[1., 0., 1.5], [5., 0., 1.5], [8., 0., 1.]], &missed);
        check(&[[5., 0., 1.], [1., 0., 1.]], &[]);
        // Back and through again counts.
        check(&[[5., 0., 1.], [1., 0., 1.], [5., 0., 1.]], &[Progress::Stage(0)]);
    }

    #[test]
    fn a_goal_between_two_poses_counts() {
        let mut course = Course::new(&arena());
        let (from, to) = (DVec3::new(1.0, 0.0, 1.0), DVec3::new(12.0, 0.5, 1.0));
        assert_eq!(course.advance(from, to), Some(Progress::Finished));
        assert_eq!(course.advance(from, to), None);
    }
}
