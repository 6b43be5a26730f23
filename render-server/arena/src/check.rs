//! Can the course be flown? Looked at before anyone tries: the start is free, gates fit the vehicle and
//! the room, there is a way through all of them, and nothing that moves bars it for good.
//!
//! ```text
//! ArenaConfig, Obstacles -> path search between gates, in cells of the distance field -> findings
//! ```
//! Budget: a second for a hall of 11 x 4.5 x 3.65 m; for people and tests, not for flight.

use std::collections::VecDeque;
use std::fmt;

use glam::{DQuat, DVec3, IVec3};

use crate::body::BodyShape;
use crate::collision::Sweep;
use crate::config::{ArenaConfig, StageConfig};
use crate::grid::Grid;
use crate::obstacles::{Obstacles, TimedPose, Touched};
use vizflyt_protocol::geometry::Pose;

/// Something that a course cannot be flown with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// Where in the file: `stages[1].width_m`.
    pub key: String,
    /// What is wrong and what to do.
    pub text: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.key, self.text)
    }
}

/// What was found out about a course.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Checked {
    /// What is wrong; empty if it can be flown.
    pub findings: Vec<Finding>,
    /// Length of a way through all of it, along the axes. [m]
    pub way_m: f64,
    /// Least room between the body and what stands still, straight through the gates; infinite
    /// without gates. [m]
    pub least_room_m: f64,
}

/// Checks a course against its obstacles.
pub fn check(config: &ArenaConfig, obstacles: &Obstacles) -> Checked {
    let mut checker = Checker::new(config, obstacles);
    checker.checked.least_room_m = f64::INFINITY;
    checker.check_start();
    for (index, stage) in config.stages.iter().enumerate() {
        checker.check_stage(index, stage);
    }
    // Ways are looked for where each place of its own is good.
    if checker.checked.findings.is_empty() {
        checker.check_ways();
    }
    checker.checked
}

/// Checks where the vehicle starts, and its climb, alone: for places without a course.
pub fn check_start(config: &ArenaConfig, obstacles: &Obstacles) -> Vec<Finding> {
    let mut checker = Checker::new(config, obstacles);
    checker.check_start();
    checker.checked.findings
}

struct Checker<'a> {
    config: &'a ArenaConfig,
    obstacles: &'a Obstacles,
    /// Of the obstacles, what never moves.
    still: Obstacles,
    /// The objects that move.
    moving: Vec<usize>,
    body: BodyShape,
    checked: Checked,
}

impl<'a> Checker<'a> {
    fn new(config: &'a ArenaConfig, obstacles: &'a Obstacles) -> Self {
        let objects = &obstacles.objects;
        let (moving, resting): (Vec<_>, Vec<_>) =
            (0..objects.len()).partition(|&index| objects.moves(index));
        let still = obstacles.select(&resting);
        let (body, checked) = (BodyShape::of(config), Checked::default());
        Self { config, obstacles, still, moving, body, checked }
    }

    /// Sweeps the body, level, along a straight way past what never moves.
    fn sweep(&self, from_m: DVec3, to_m: DVec3) -> (Sweep, Touched) {
        let at = |p_m| Pose::new(p_m, DQuat::IDENTITY);
        let timed = |p_m| TimedPose { since_epoch_ns: 0, world_from_body: at(p_m) };
        self.still.sweep(&self.body, &timed(from_m), &timed(to_m))
    }

    fn found(&mut self, key: impl Into<String>, text: impl Into<String>) {
        self.checked.findings.push(Finding { key: key.into(), text: text.into() });
    }

    fn room_m(&self, p_m: DVec3) -> f64 {
        self.still.distance_m(0, p_m) - self.body.radius_m()
    }

    fn above_start_m(&self) -> DVec3 {
        self.config.spawn.position_m + DVec3::Z * self.config.takeoff_height_m
    }

    fn check_start(&mut self) {
        let (start_m, top_m) = (self.config.spawn.position_m, self.above_start_m());
        let from_m = start_m + DVec3::Z * self.body.radius_m();
        let (straight, touched) = self.sweep(from_m, top_m);
        if let Some(contact) = straight.contact {
            let otherwise = "move the start or the obstacle";
            let (what, advice) = self.touched(touched, contact.p_world_m, otherwise);
            let text = format!(
                "the climb to {} m touches {what} at {:.2} m; {advice}",
                self.config.takeoff_height_m, contact.p_world_m
            );
            self.found("spawn.position_m", text);
        }
        self.check_seen();
        for &index in &self.moving {
            if self.longest_free_s(from_m, top_m, index) < WINDOW_S {
                let name = self.obstacles.objects.names().nth(index).unwrap_or_default();
                let text = format!("'{name}' leaves no {WINDOW_S} s to climb; move one of the two");
                self.checked.findings.push(Finding { key: "spawn.position_m".into(), text });
                return;
            }
        }
    }

    /// Returns what a body touches at a place, and what to do: `otherwise`, if it is a known obstacle.
    fn touched(
        &self,
        touched: Touched,
        p_m: DVec3,
        otherwise: &'static str,
    ) -> (String, &'static str) {
        if let Touched::Object(index) = touched {
            let name = self.still.objects.names().nth(index).unwrap_or_default();
            return (format!("'{name}'"), otherwise);
        }
        let still = &self.obstacles.still;
        let reach_m = self.body.radius_m() + 2.0 * still.grid().voxel_m;
        if still.is_unseen_nearest(p_m, reach_m) {
            ("unseen space".to_owned(), FILM)
        } else {
            ("an obstacle".to_owned(), otherwise)
        }
    }

    /// Where the vehicle may start and where it shall end must have been seen.
    fn check_seen(&mut self) {
        let still = self.obstacles.still.clone();
        if still.unseen_voxels() == 0 {
            return;
        }
        let is_unseen =
            |p_m: DVec3| still.obstacle_distance_m(p_m) < 0.0 && still.is_unseen_nearest(p_m, 0.0);
        if let Some(start) = self.config.rules.start_box {
            let grid = Grid::covering(start.min_m, start.max_m, still.grid().voxel_m.max(START_M));
            let [nx, ny, nz] = grid.size;
            let all = (0..nx * ny * nz).map(|n| [n / (ny * nz), n / nz % ny, n % nz]);
            let unseen = all.filter(|voxel| is_unseen(grid.center_m(*voxel))).count();
            if unseen > 0 {
                let share = 100.0 * unseen as f64 / grid.voxels() as f64;
                let text =
                    format!("{share:.0} % of the start box was not seen by the capture; {FILM}");
                self.found("rules.start_box", text);
            }
        }
        if let Some(goal) = self.config.goal.filter(|goal| is_unseen(goal.position_m)) {
            let text =
                format!("the goal at {:.2} m was not seen by the capture; {FILM}", goal.position_m);
            self.found("goal.position_m", text);
        }
    }

    fn check_stage(&mut self, index: usize, stage: &StageConfig) {
        let key = |field: &str| format!("stages[{index}].{field}");
        let across_m = 2.0 * self.body.radius_m();
        for (field, size_m) in [("width_m", stage.width_m), ("height_m", stage.height_m)] {
            if !(size_m >= across_m + 2.0 * GATE_ROOM_M) {
                let text = format!(
                    "'{}' is {size_m:.2} m there, and the vehicle {across_m:.2} m across: give at \
                     least {:.2} m",
                    stage.name,
                    across_m + 2.0 * GATE_ROOM_M
                );
                self.found(key(field), text);
            }
        }
        let (before_m, after_m) = ends_m(stage);
        for end_m in [before_m, after_m] {
            if self.config.geofence().signed_distance_m(end_m) > -self.body.radius_m() {
                let text = format!(
                    "'{}' is too near to the geofence: {AHEAD_M} m before or behind it, at \
                     {end_m:.2} m, the vehicle would leave it",
                    stage.name
                );
                self.found(key("center_m"), text);
                return;
            }
        }
        let (through, touched) = self.sweep(before_m, after_m);
        self.checked.least_room_m = self.checked.least_room_m.min(through.clearance_m);
        if let Some(contact) = through.contact {
            let otherwise = "move the gate, or correct center_m and normal";
            let (what, advice) = self.touched(touched, contact.p_world_m, otherwise);
            let text = format!(
                "straight through '{}' the vehicle touches {what} at {:.2} m; {advice}",
                stage.name, contact.p_world_m
            );
            self.found(key("center_m"), text);
        }
        for &number in &self.moving.clone() {
            let free_s = self.longest_free_s(before_m, after_m, number);
            if free_s < WINDOW_S {
                let name = self.obstacles.objects.names().nth(number).unwrap_or_default();
                let text = format!(
                    "'{name}' never leaves '{}' free for {WINDOW_S} s, at most for {free_s:.1} s; slow \
                     it down",
                    stage.name
                );
                self.found(key("center_m"), text);
            }
        }
    }

    /// Returns the longest time that an object leaves a straight way free, within a minute. [s]
    fn longest_free_s(&self, from_m: DVec3, to_m: DVec3, object: usize) -> f64 {
        let alone = self.obstacles.select(&[object]);
        let (mut longest, mut free) = (0_u32, 0_u32);
        for tick in 0..LOOKS {
            let ns = i64::from(tick) * LOOK_NS;
            let touches = (0..=POINTS).any(|n| {
                let p_m = from_m.lerp(to_m, f64::from(n) / f64::from(POINTS));
                alone.moving_distance_m(ns, p_m) <= self.body.radius_m()
            });
            free = if touches { 0 } else { free + 1 };
            longest = longest.max(free);
        }
        f64::from(longest) * LOOK_NS as f64 * 1e-9
    }

    fn check_ways(&mut self) {
        let mut from_m = self.above_start_m();
        let mut cells = Cells::new(self);
        let mut legs: Vec<(String, String, DVec3, DVec3)> = Vec::new();
        for (index, stage) in self.config.stages.iter().enumerate() {
            let (before_m, after_m) = ends_m(stage);
            legs.push((format!("stages[{index}].center_m"), stage.name.clone(), from_m, before_m));
            from_m = after_m;
        }
        if let Some(goal) = self.config.goal {
            legs.push(("goal.position_m".into(), "the goal".into(), from_m, goal.position_m));
        }
        for (key, name, from_m, to_m) in legs {
            let Some(length_m) = cells.way_m(self, from_m, to_m) else {
                let text = format!(
                    "no way leads from {from_m:.2} m to {name} at {to_m:.2} m for a vehicle of \
                     {:.2} m; make room",
                    2.0 * self.body.radius_m()
                );
                self.found(key, text);
                return;
            };
            self.checked.way_m += length_m;
        }
        self.checked.way_m += 2.0 * AHEAD_M * self.config.stages.len() as f64;
    }
}

/// The room in cells, and how far each is from where a search began.
struct Cells {
    min_m: DVec3,
    size: IVec3,
    steps: Vec<u32>,
    queue: VecDeque<IVec3>,
}

impl Cells {
    fn new(checker: &Checker) -> Self {
        let fence = &checker.config.geofence;
        let floor_m = checker.config.occupancy.floor_z_m;
        let min_m = fence.min_m.with_z(fence.min_m.z.max(floor_m));
        let size = ((fence.max_m - min_m) / CELL_M).floor().max(DVec3::ONE).as_ivec3();
        Self { min_m, size, steps: Vec::new(), queue: VecDeque::new() }
    }

    fn center_m(&self, cell: IVec3) -> DVec3 {
        self.min_m + (cell.as_dvec3() + 0.5) * CELL_M
    }

    fn index(&self, cell: IVec3) -> Option<usize> {
        let within = cell.cmpge(IVec3::ZERO).all() && cell.cmplt(self.size).all();
        within.then(|| ((cell.x * self.size.y + cell.y) * self.size.z + cell.z) as usize)
    }

    /// Whether the body may be anywhere between this cell's middle and that of another such: no point
    /// between two is further from one of them than half a cell.
    fn is_free(&self, checker: &Checker, cell: IVec3) -> bool {
        let p_m = self.center_m(cell);
        let radius_m = checker.body.radius_m();
        let floor_m = p_m.z - checker.config.occupancy.floor_z_m;
        checker.room_m(p_m) >= CELL_M / 2.0
            && checker.config.geofence().signed_distance_m(p_m) <= -radius_m
            && checker
                .config
                .no_fly
                .iter()
                .all(|no_fly| no_fly.volume().signed_distance_m(p_m) >= radius_m + CELL_M / 2.0)
            && floor_m >= radius_m
    }

    /// Returns the free cell next to a point, from which the point is reached.
    fn near(&self, checker: &Checker, p_m: DVec3) -> Option<IVec3> {
        let own = ((p_m - self.min_m) / CELL_M).floor().as_ivec3();
        let around =
            (-1..=1).flat_map(|x| (-1..=1).flat_map(move |y| (-1..=1).map(move |z| (x, y, z))));
        let mut cells: Vec<IVec3> = around.map(|offset| own + IVec3::from(offset)).collect();
        cells.sort_by(|a, b| {
            let away = |cell: &IVec3| (self.center_m(*cell) - p_m).length_squared();
            away(a).total_cmp(&away(b))
        });
        cells.into_iter().find(|&cell| {
            self.index(cell).is_some()
                && self.is_free(checker, cell)
                && checker.sweep(p_m, self.center_m(cell)).0.contact.is_none()
        })
    }

    /// Returns the length of the shortest way along the axes; `None` if there is none. [m]
    fn way_m(&mut self, checker: &Checker, from_m: DVec3, to_m: DVec3) -> Option<f64> {
        let (start, end) = (self.near(checker, from_m)?, self.near(checker, to_m)?);
        self.steps.clear();
        self.steps.resize(self.size.as_uvec3().element_product() as usize, UNSEEN);
        self.queue.clear();
        let first = self.index(start)?;
        self.steps[first] = 0;
        self.queue.push_back(start);
        while let Some(cell) = self.queue.pop_front() {
            let steps = self.steps[self.index(cell)?];
            if cell == end {
                return Some(f64::from(steps) * CELL_M);
            }
            for axis in IVec3::AXES {
                for next in [cell + axis, cell - axis] {
                    let Some(index) = self.index(next) else { continue };
                    if self.steps[index] == UNSEEN {
                        let free = self.is_free(checker, next);
                        self.steps[index] = if free { steps + 1 } else { BLOCKED };
                        if free {
                            self.queue.push_back(next);
                        }
                    }
                }
            }
        }
        None
    }
}

/// Returns the places straight before and behind a gate. [m, world]
fn ends_m(stage: &StageConfig) -> (DVec3, DVec3) {
    let ahead_m = stage.normal.normalize_or(DVec3::X) * AHEAD_M;
    (stage.center_m - ahead_m, stage.center_m + ahead_m)
}

/// Room on each side of a vehicle in a gate: what a good controller keeps. [m]
const GATE_ROOM_M: f64 = 0.05;
/// So far before and behind a gate the way is straight. [m]
const AHEAD_M: f64 = 0.35;
/// Side of a cell: half the width of a body of 0.1 m. [m]
const CELL_M: f64 = 0.1;
/// A vehicle of 1 m/s needs this long through a gate. [s]
const WINDOW_S: f64 = 0.7;
/// Looked at a minute, twenty times a second.
const LOOKS: u32 = 1200;
const LOOK_NS: i64 = 50_000_000;
/// Places along a straight way: closer than a body's radius.
const POINTS: u32 = 7;
/// The start box is looked at this closely. [m]
const START_M: f64 = 0.1;
/// What to do about unseen space.
const FILM: &str = "film there, train and carve again, or move it into what was seen";
const UNSEEN: u32 = u32::MAX;
const BLOCKED: u32 = u32::MAX - 1;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::config::ObjectConfig;
    use crate::distance::DistanceField;
    use crate::objects::MovingObjects;
    use crate::occupancy::occupancy_of;
    use crate::referee::tests::arena;
    use vizflyt_protocol::geometry::Volume;

    /// The referee's room with a wall at x = 3 that has a hole of `hole_m` at y = 0, z = 1.
    fn walled(hole_m: f64) -> (ArenaConfig, Obstacles) {
        let mut config = arena();
        config.stages.push(StageConfig {
            name: "hole".into(),
            center_m: DVec3::new(3.0, 0.0, 1.0),
            normal: DVec3::X,
            width_m: hole_m,
            height_m: hole_m,
            ..StageConfig::default()
        });
        let (min_m, max_m) = (config.geofence.min_m, config.geofence.max_m);
        let grid = Grid::covering(min_m.with_z(0.0), max_m, 0.05);
        let wall = Volume::aabb(DVec3::new(2.95, -9.0, -1.0), DVec3::new(3.05, 9.0, 9.0));
        let field = DistanceField::of(occupancy_of(grid, 0.0, |p| {
            let in_hole = p.y.abs() < hole_m / 2.0 && (p.z - 1.0).abs() < hole_m / 2.0;
            wall.signed_distance_m(p) < 0.0 && !in_hole
        }));
        (config, field.into())
    }

    /// The room with a board of its own frame, half a metre square, that stands still at a place.
    fn with_board(at_m: DVec3) -> (ArenaConfig, Obstacles) {
        let (mut config, walled) = walled(1.0);
        config.objects.push(ObjectConfig {
            name: "board".into(),
            scene: "board.ply".into(),
            position_m: at_m,
            yaw_deg: 0.0,
            phase_s: None,
            motion: None,
        });
        let board = Volume::aabb(DVec3::new(-0.05, -0.6, -0.6), DVec3::new(0.05, 0.6, 0.6));
        let grid = Grid::covering(DVec3::splat(-1.0), DVec3::splat(1.0), 0.025);
        let field =
            DistanceField::of(occupancy_of(grid, -1e4, |p| board.signed_distance_m(p) < 0.0));
        let objects = MovingObjects::new(&config, 0);
        (config, Obstacles::new(walled.still, vec![Arc::new(field)], objects))
    }

    #[test]
    fn what_stands_still_in_a_frame_of_its_own_is_an_obstacle() {
        let free = with_board(DVec3::new(2.0, -2.0, 1.0));
        assert_eq!(check(&free.0, &free.1).findings, []);
        // Right before the hole.
        let (config, obstacles) = with_board(DVec3::new(2.8, 0.0, 1.0));
        let checked = check(&config, &obstacles);
        assert_eq!(keys(&checked), ["stages[0].center_m"]);
        assert!(checked.findings[0].text.contains("touches 'board'"), "{checked:?}");
    }

    fn keys(checked: &Checked) -> Vec<&str> {
        checked.findings.iter().map(|finding| finding.key.as_str()).collect()
    }

    #[test]
    fn a_course_that_can_be_flown_has_no_findings() {
        let (config, obstacles) = walled(1.0);
        let checked = check(&config, &obstacles);
        assert_eq!(checked.findings, []);
        assert!((7.0..12.0).contains(&checked.way_m), "{checked:?}");
        assert!((0.3..0.42).contains(&checked.least_room_m), "{checked:?}");
    }

    #[test]
    fn unflyable_courses_are_reported_by_key() {
        // Narrower than vehicle and margins.
        let (config, obstacles) = walled(0.3);
        let checked = check(&config, &obstacles);
        assert_eq!(keys(&checked)[..2], ["stages[0].width_m", "stages[0].height_m"]);
        // The gate is where the wall is whole.
        let (mut config, obstacles) = walled(1.0);
        config.stages[0].center_m.y = 1.5;
        let checked = check(&config, &obstacles);
        assert_eq!(keys(&checked), ["stages[0].center_m"]);
        assert!(checked.findings[0].text.contains("touches an obstacle"), "{checked:?}");
        // Nothing to fly through, and the wall is in the way.
        let (mut config, obstacles) = walled(0.0);
        config.stages.clear();
        assert_eq!(keys(&check(&config, &obstacles)), ["goal.position_m"]);
        // The start is in the wall.
        config.spawn.position_m.x = 3.0;
        assert_eq!(keys(&check(&config, &obstacles)), ["spawn.position_m"]);
        // Too near to the fence.
        let (mut config, obstacles) = walled(1.0);
        config.stages[0].center_m.x = 9.7;
        assert_eq!(keys(&check(&config, &obstacles)), ["stages[0].center_m"]);
    }
}
