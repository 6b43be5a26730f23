//! The course: openings to pass in order, then the goal.

use glam::{DVec2, DVec3};

use crate::config::{ArenaConfig, Goal, StageConfig};

/// Progress of the vehicle on the course.
#[derive(Clone, Debug, PartialEq)]
pub enum Progress {
    /// Passed the stage with this index.
    Stage(usize),
    /// Reached the goal, all stages passed.
    Finished,
    /// Reached the goal, but the stage with this index was not passed. Reported once.
    GoalTooEarly(usize),
}

/// Progress of one vehicle through the stages.
#[derive(Clone, Debug)]
pub struct Course {
    stages: Vec<Opening>,
    goal: Option<Goal>,
    next: usize,
    /// Whether the vehicle is within the thickness of the next stage.
    entered: bool,
    finished: bool,
    told_too_early: bool,
}

impl Course {
    /// Returns the course of an arena, with no stage passed.
    pub fn new(config: &ArenaConfig) -> Self {
        Self {
            stages: config.stages.iter().map(Opening::new).collect(),
            goal: config.goal,
            next: 0,
            entered: false,
            finished: false,
            told_too_early: false,
        }
    }

    /// Returns the index of the next stage; the number of stages if only the goal is left.
    pub fn next(&self) -> usize {
        self.next
    }

    /// Processes the path of the body's centre between two poses; returns the progress. Call it with the same
    /// path until it returns `None`: the last stage may also be the end. [m, world]
    pub fn advance(&mut self, from_m: DVec3, to_m: DVec3) -> Option<Progress> {
        if self.finished {
            return None;
        }
        if let Some(stage) = self.stages.get(self.next)
            && stage.is_passed(from_m, to_m, &mut self.entered)
        {
            self.next += 1;
            return Some(Progress::Stage(self.next - 1));
        }
        let Some(goal) = self.goal else {
            // Without a goal, the last stage is the finish; without stages either, there is none.
            self.finished = !self.stages.is_empty() && self.next == self.stages.len();
            return self.finished.then_some(Progress::Finished);
        };
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

/// A polygon in space with a direction.
#[derive(Clone, Debug)]
struct Opening {
    center_m: DVec3,
    normal: DVec3,
    /// Unit vector along the width, level, to the left in the direction of passage.
    across: DVec3,
    up: DVec3,
    /// Corners of the polygon. [m, along across and up]
    corners_m: Vec<DVec2>,
    half_thickness_m: f64,
    clearance_m: f64,
}

impl Opening {
    fn new(stage: &StageConfig) -> Self {
        let normal = stage.normal.normalize_or(DVec3::X);
        // A gate in the floor has no level width; use y.
        let across = DVec3::Z.cross(normal).normalize_or(DVec3::Y);
        let (x, y) = (stage.width_m / 2.0, stage.height_m / 2.0);
        let rectangle =
            [DVec2::new(x, y), DVec2::new(-x, y), DVec2::new(-x, -y), DVec2::new(x, -y)];
        let given = &stage.polygon_m;
        Self {
            center_m: stage.center_m,
            normal,
            across,
            up: normal.cross(across),
            corners_m: if given.is_empty() { rectangle.to_vec() } else { given.clone() },
            half_thickness_m: stage.thickness_m / 2.0,
            clearance_m: stage.clearance_m,
        }
    }

    /// Whether the path leaves the opening through its far face; `entered` stores whether it has entered
    /// through the near one.
    fn is_passed(&self, from_m: DVec3, to_m: DVec3, entered: &mut bool) -> bool {
        if let Some(inside) = self.crossing(-self.half_thickness_m, from_m, to_m) {
            *entered = inside;
        } else if self.crossing(-self.half_thickness_m, to_m, from_m).is_some() {
            // Left again through the near face.
            *entered = false;
        }
        self.crossing(self.half_thickness_m, from_m, to_m) == Some(true)
            && std::mem::replace(entered, false)
    }

    /// Returns whether the path crosses a face inside the polygon; `None` if it does not cross the face in the
    /// direction of passage.
    fn crossing(&self, face_m: f64, from_m: DVec3, to_m: DVec3) -> Option<bool> {
        let before_m = self.normal.dot(from_m - self.center_m) - face_m;
        let after_m = self.normal.dot(to_m - self.center_m) - face_m;
        if !(before_m < 0.0 && after_m >= 0.0) {
            return None;
        }
        let at_m = from_m.lerp(to_m, before_m / (before_m - after_m)) - self.center_m;
        Some(self.holds(DVec2::new(at_m.dot(self.across), at_m.dot(self.up))))
    }

    /// Whether a point of the plane is inside the polygon, with the required clearance from its edge.
    fn holds(&self, p_m: DVec2) -> bool {
        let mut inside = false;
        for (n, &b_m) in self.corners_m.iter().enumerate() {
            let a_m = self.corners_m[(n + self.corners_m.len() - 1) % self.corners_m.len()];
            // Counts the edges that a ray along +x crosses.
            if (a_m.y > p_m.y) != (b_m.y > p_m.y)
                && p_m.x < a_m.x + (p_m.y - a_m.y) / (b_m.y - a_m.y) * (b_m.x - a_m.x)
            {
                inside = !inside;
            }
            let edge_m = distance_to_segment_m(p_m.extend(0.0), a_m.extend(0.0), b_m.extend(0.0));
            if edge_m < self.clearance_m {
                return false;
            }
        }
        inside
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
            ..StageConfig::default()
        }];
        Course::new(&config)
    }

    fn check(way: &[[f64; 3]], expected: &[Progress]) {
        let mut course = course();
        assert_eq!(found(&mut course, way), expected);
    }

    fn found(course: &mut Course, way: &[[f64; 3]]) -> Vec<Progress> {
        way.windows(2)
            .flat_map(|pair| {
                std::iter::from_fn(|| course.advance(pair[0].into(), pair[1].into()))
                    .collect::<Vec<_>>()
            })
            .collect()
    }

    #[test]
    fn stages_count_only_in_order_and_direction_and_through_the_opening() {
        let through = [Progress::Stage(0), Progress::Finished];
        check(&[[1., 0., 1.], [5., 0.2, 1.2], [8., 0., 1.], [9., 0., 1.]], &through);
        // Past the side, above, and in reverse: not passed, so the goal does not count either.
        let missed = [Progress::GoalTooEarly(0)];
        check(&[[1., 0.6, 1.], [5., 0.6, 1.], [8., 0., 1.], [8.1, 0., 1.]], &missed);
        check(&[[1., 0., 1.5], [5., 0., 1.5], [8., 0., 1.]], &missed);
        check(&[[5., 0., 1.], [1., 0., 1.]], &[]);
        // Passing again in the right direction counts.
        check(&[[5., 0., 1.], [1., 0., 1.], [5., 0., 1.]], &[Progress::Stage(0)]);
    }

    #[test]
    fn polygon_thickness_and_clearance_are_checked() {
        let mut config = arena();
        config.goal = None;
        let stage = StageConfig {
            name: "triangle".into(),
            center_m: DVec3::new(3.0, 0.0, 1.0),
            normal: DVec3::X,
            width_m: 2.0,
            height_m: 2.0,
            // The right angle is on the upper left.
            polygon_m: vec![DVec2::new(1., 1.), DVec2::new(-1., 1.), DVec2::new(1., -1.)],
            ..StageConfig::default()
        };
        let passes = |stage: &StageConfig, way: &[[f64; 3]]| {
            let mut config = config.clone();
            config.stages = vec![stage.clone()];
            !found(&mut Course::new(&config), way).is_empty()
        };
        let straight = |y: f64, z: f64| [[2., y, z], [4., y, z]];
        assert!(passes(&stage, &straight(0.5, 1.5)));
        assert!(!passes(&stage, &straight(-0.5, 0.5)), "beyond the long side");
        assert!(!passes(&stage, &straight(1.5, 1.5)), "outside of the rectangle too");
        let clear = StageConfig { clearance_m: 0.2, ..stage.clone() };
        assert!(passes(&clear, &straight(0.5, 1.5)));
        assert!(!passes(&clear, &straight(0.9, 1.5)), "0.1 m from its side");
        let thick = StageConfig { thickness_m: 1.0, ..stage };
        assert!(passes(&thick, &straight(0.5, 1.5)));
        assert!(!passes(&thick, &[[2., 0.5, 1.5], [3.2, 0.5, 1.5]]), "still inside");
        let sideways = [[2., 1.5, 1.5], [3., 1.5, 1.5], [3., 0.5, 1.5], [4., 0.5, 1.5]];
        assert!(!passes(&thick, &sideways), "not by its near face");
        let back = [[2., 0.5, 1.5], [3., 0.5, 1.5], [2., 0.5, 1.5], [2., 1.5, 1.5], [4., 1.5, 1.5]];
        assert!(!passes(&thick, &back));
        let slowly = [[2., 0.5, 1.5], [3., 0.5, 1.5], [3.2, 0.5, 1.5], [4., 0.5, 1.5]];
        assert!(passes(&thick, &slowly));
    }

    #[test]
    fn last_stage_is_the_finish_without_a_goal() {
        let mut course = course();
        course.goal = None;
        let through = [Progress::Stage(0), Progress::Finished];
        let way = [[1., 0., 1.], [2., 0., 1.], [5., 0., 1.], [9., 0., 1.]];
        assert_eq!(found(&mut course, &way), through);
        let mut neither = Course { stages: Vec::new(), ..course.clone() };
        neither.finished = false;
        assert_eq!(found(&mut neither, &way), []);
    }

    #[test]
    fn goal_between_two_poses_counts() {
        let mut course = Course::new(&arena());
        let (from, to) = (DVec3::new(1.0, 0.0, 1.0), DVec3::new(12.0, 0.5, 1.0));
        assert_eq!(course.advance(from, to), Some(Progress::Finished));
        assert_eq!(course.advance(from, to), None);
    }
}
