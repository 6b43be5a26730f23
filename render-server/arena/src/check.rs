//! Check of a course before a flight: the start is free, gates fit the vehicle and the room, a path leads
//! through all of them, and no moving object blocks it permanently.
//!
//! ```text
//! ArenaConfig, Obstacles -> path search between gates, in cells of the distance field -> findings
//! ```
//! Budget: one second for a hall of 11 x 4.5 x 3.65 m; for people and tests, not in flight.

use std::collections::VecDeque;
use std::fmt;

use glam::{DQuat, DVec3, IVec3};

use crate::body::BodyShape;
use crate::collision::Sweep;
use crate::config::{ArenaConfig, StageConfig};
use crate::grid::Grid;
use crate::obstacles::{Obstacles, TimedPose, Touched};
use vizflyt_protocol::geometry::Pose;

/// A problem that makes a course unflyable.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// Path of the key in the file: `stages[1].width_m`.
    pub key: String,
    /// Problem and solution.
    pub text: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.key, self.text)
    }
}

/// Result of a check.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Checked {
    /// Problems; empty if the course can be flown.
    pub findings: Vec<Finding>,
    /// Length of a path through the course, along the axes. [m]
    pub way_m: f64,
    /// Minimum distance between the body and fixed obstacles, straight through the gates; infinite without
    /// gates. [m]
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
    // Paths are searched only if each position by itself is valid.
    if checker.checked.findings.is_empty() {
        checker.check_ways();
    }
    checker.checked
}

/// Checks only the start and the climb, for rooms without a course.
pub fn check_start(config: &ArenaConfig, obstacles: &Obstacles) -> Vec<Finding> {
    let mut checker = Checker::new(config, obstacles);
    checker.check_start();
    checker.checked.findings
}

struct Checker<'a> {
    config: &'a ArenaConfig,
    obstacles: &'a Obstacles,
    /// The obstacles that never move.
    still: Obstacles,
    /// Indices of the objects that move.
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

    /// Sweeps the level body along a straight line past the fixed obstacles.
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

    /// Returns the obstacle that a body touches at a position, and the advice: `otherwise`, unless it is unseen
    /// space.
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

    /// Start box and goal must be in seen space.
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
                    "'{}' is too close to the geofence: {AHEAD_M} m before or behind it, at \
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

    /// Returns the longest time for which an object leaves a straight path free, within a minute. [s]
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

/// The room in cells, with the distance of each from the start of a search.
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

    /// Whether the body may be anywhere between this cell's centre and that of another free cell: no point
    /// between two is further than half a cell from one of them.
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

    /// Returns the nearest free cell from which a point is reached in a straight line.
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

    /// Returns the length of the shortest path along the axes; `None` if there is none. [m]
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

/// Returns the points straight before and behind a gate. [m, world]
fn ends_m(stage: &StageConfig) -> (DVec3, DVec3) {
    let ahead_m = stage.normal.normalize_or(DVec3::X) * AHEAD_M;
    (stage.center_m - ahead_m, stage.center_m + ahead_m)
}

/// Margin on each side of a vehicle in a gate: the accuracy of a good controller. [m]
const GATE_ROOM_M: f64 = 0.05;
/// Length of the straight path before and behind a gate. [m]
const AHEAD_M: f64 = 0.35;
/// Size of a cell: half the width of a body of 0.1 m. [m]
const CELL_M: f64 = 0.1;
/// Time that a vehicle at 1 m/s needs to pass a gate. [s]
const WINDOW_S: f64 = 0.7;
/// Samples over a minute, twenty per second.
const LOOKS: u32 = 1200;
const LOOK_NS: i64 = 50_000_000;
/// Samples along a straight path: closer than a body's radius.
const POINTS: u32 = 7;
/// Resolution of the check of the start box. [m]
const START_M: f64 = 0.1;
/// Advice for unseen space.
const FILM: &str = "film there, train and carve again, or move it into seen space";
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

    /// Returns the referee's arena with a wall at x = 3 that has a hole of `hole_m` at y = 0, z = 1.
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

    /// Returns the arena with a fixed board as an object with its own frame.
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
    fn fixed_objects_are_obstacles() {
        let free = with_board(DVec3::new(2.0, -2.0, 1.0));
        assert_eq!(check(&free.0, &free.1).findings, []);
        // Directly in front of the hole.
        let (config, obstacles) = with_board(DVec3::new(2.8, 0.0, 1.0));
        let checked = check(&config, &obstacles);
        assert_eq!(keys(&checked), ["stages[0].center_m"]);
        assert!(checked.findings[0].text.contains("touches 'board'"), "{checked:?}");
    }

    fn keys(checked: &Checked) -> Vec<&str> {
        checked.findings.iter().map(|finding| finding.key.as_str()).collect()
    }

    #[test]
    fn flyable_course_has_no_findings() {
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
        // The gate is at a closed part of the wall.
        let (mut config, obstacles) = walled(1.0);
        config.stages[0].center_m.y = 1.5;
        let checked = check(&config, &obstacles);
        assert_eq!(keys(&checked), ["stages[0].center_m"]);
        assert!(checked.findings[0].text.contains("touches an obstacle"), "{checked:?}");
        // No stage, and the wall blocks the way to the goal.
        let (mut config, obstacles) = walled(0.0);
        config.stages.clear();
        assert_eq!(keys(&check(&config, &obstacles)), ["goal.position_m"]);
        // The start is in the wall.
        config.spawn.position_m.x = 3.0;
        assert_eq!(keys(&check(&config, &obstacles)), ["spawn.position_m"]);
        // Too close to the fence.
        let (mut config, obstacles) = walled(1.0);
        config.stages[0].center_m.x = 9.7;
        assert_eq!(keys(&check(&config, &obstacles)), ["stages[0].center_m"]);
    }
}
