//! Netted lab of 11 x 4.5 x 3.65 m, empty (`room`) or with a race course (`race`).
//!
//! Data flow: [`shell`] plans the hall, [`gate`] and [`gap`] the course in the net, all as true boxes. [`light`]
//! computes the light at a point. [`panel`] covers each face with Gaussians as fine as its [`texture`] requires.

mod dimensions;
mod furniture;
mod gap;
mod gate;
mod light;
mod moving;
mod panel;
mod pillars;
mod shell;
mod texture;

use glam::{DVec2, DVec3};
use serde::Deserialize;
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::{
    EnvironmentConfig, Geofence, Goal, Occupancy, RulesConfig, Spawn, StageConfig,
};
use vizflyt_arena::pose::PoseConfig;
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::messages::Limits;

use crate::canvas::{Canvas, paint};
use crate::forest::front_camera;
use crate::generated::Generated;
use crate::parts::{PartClass, Parts};
use crate::random::{Rng, fractal2, noise2};
use crate::solids::Solids;
use crate::staging::{Stage, Staging};
use dimensions::{NET_MAX_M, NET_MIN_M};
use gap::GapWall;
use gate::Gate;
use light::HallLight;
use moving::{GeneratedMover, HAND_M, Movers};
use panel::{Block, Grain, Look, Painter};
use pillars::Pillars;
use shell::Shell;

/// Contents of the net, in this order along the flight.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Layout {
    /// Number of racing windows; at most three, the number of colours.
    pub(crate) windows: usize,
    /// Whether a wall with a gap follows the windows.
    pub(crate) gap: bool,
    /// Whether a window with a rotating hand comes last.
    pub(crate) hand: bool,
    /// Whether there are pillars.
    pub(crate) pillars: bool,
    /// Whether there is a doorway with a sliding door.
    pub(crate) door: bool,
    /// Whether a pendulum swings across the path.
    pub(crate) pendulum: bool,
    /// Whether another drone flies back and forth.
    pub(crate) drone: bool,
}

/// Returns the empty netted room for a seed.
pub(crate) fn build_room(seed: u64, staging: &mut Staging) -> Generated {
    let goal = Goal { position_m: DVec3::new(10.0, 0.0, 1.2), radius_m: 0.6 };
    build(seed, "room", &Course::default(), goal, 3.0, staging)
}

/// Returns the race for a seed: windows, gap and clock hand, one behind the other.
pub(crate) fn build_race(seed: u64, staging: &mut Staging) -> Generated {
    let layout = Layout { windows: 3, gap: true, hand: true, ..Layout::default() };
    build_staged(seed, "race", layout, staging)
}

/// Returns the netted room for a seed with moving objects.
pub(crate) fn build_moving(seed: u64, staging: &mut Staging) -> Generated {
    let layout = Layout { door: true, pendulum: true, drone: true, ..Layout::default() };
    build_staged(seed, "moving", layout, staging)
}

/// Returns the netted room for a seed with a layout.
pub(crate) fn build_course(seed: u64, name: &str, layout: Layout) -> Generated {
    build_staged(seed, name, layout, &mut Staging::none())
}

fn build_staged(seed: u64, name: &str, layout: Layout, staging: &mut Staging) -> Generated {
    let course = Course::draw(seed, layout);
    let goal = Goal { position_m: DVec3::new(10.3, 0.0, 1.2), radius_m: 0.5 };
    build(seed, name, &course, goal, 4.0, staging)
}

/// Objects in the net.
#[derive(Debug, Default)]
struct Course {
    windows: Vec<Gate>,
    gap: Option<GapWall>,
    hand: Option<Gate>,
    pillars: Pillars,
    doorway: Vec<Block>,
    movers: Movers,
}

impl Course {
    fn draw(seed: u64, layout: Layout) -> Self {
        let mut rng = Rng::new(seed, 31);
        let mut side = if rng.chance(0.5) { 1.0 } else { -1.0 };
        let mut windows = Vec::new();
        let place = |rng: &mut Rng, x_m: f64, side: f64, colours, with_hub| {
            let opening_m = if with_hub {
                DVec2::new(rng.range(1.3, 1.45), rng.range(1.2, 1.3))
            } else {
                DVec2::splat(rng.range(1.0, 1.35))
            };
            // The lower bar is at least 0.1 m above the floor, and the upper bar below the net. A clock hand needs its
            // length below the motor.
            let z_m = if with_hub {
                HAND_M + 0.06 + opening_m.y / 2.0 + rng.range(0.0, 0.2)
            } else {
                rng.range(0.25 + opening_m.y / 2.0 + 0.2, 1.85)
            };
            Gate {
                center_m: DVec3::new(x_m + rng.spread(0.1), side * rng.range(0.1, 0.75), z_m),
                yaw_rad: rng.spread(20f64.to_radians()),
                opening_m,
                colours,
                with_hub,
            }
        };
        let mut places = layout.places_m().into_iter();
        let colours = [(0xd81f2a, 0xf6f2ea), (0x1f54d8, 0xf2d21f), (0xe0218a, 0x1c1c22)];
        for ((bar, stripe), x_m) in colours.into_iter().zip(places.by_ref().take(layout.windows)) {
            windows.push(place(&mut rng, x_m, side, (paint(bar), paint(stripe)), false));
            side = -side;
        }
        let gap = layout.gap.then(|| places.next()).flatten();
        let gap = gap.map(|x_m| GapWall::draw(seed, &mut rng, x_m, side));
        let hand = layout.hand.then(|| places.next()).flatten();
        let colours = (paint(0xf08a12), paint(0x14181c));
        let hand = hand.map(|x_m| place(&mut rng, x_m, -side, colours, true));
        let pillars = if layout.pillars { Pillars::draw(seed) } else { Pillars::default() };
        let mut movers = Movers::default();
        if let Some(gate) = &hand {
            movers.add_hand(seed, gate);
        }
        let mut doorway = Vec::new();
        if layout.door {
            movers.add_door(seed, DOOR_M);
            doorway.extend(moving::doorway(DOOR_M));
        }
        if layout.pendulum {
            movers.add_pendulum(seed, PENDULUM_M);
        }
        if layout.drone {
            movers.add_drone(seed, DRONE_M);
        }
        Self { windows, gap, hand, pillars, doorway, movers }
    }

    /// Returns all gates with the names of their stages.
    fn gates(&self) -> impl Iterator<Item = (&Gate, String)> {
        let window = |(n, gate)| (gate, format!("window {}", n + 1));
        let hand = self.hand.iter().map(|gate| (gate, HAND.to_owned()));
        self.windows.iter().enumerate().map(window).chain(hand)
    }

    fn stages(&self) -> Vec<StageConfig> {
        let mut stages = Vec::new();
        for (n, window) in self.windows.iter().enumerate() {
            stages.push(window.stage(&format!("window {}", n + 1)));
        }
        stages.extend(self.gap.iter().map(|gap| gap.stage(GAP)));
        stages.extend(self.hand.iter().map(|hand| hand.stage(HAND)));
        stages
    }

    fn blocks(&self) -> Vec<Block> {
        let gap = self.gap.iter().flat_map(GapWall::blocks);
        let others = self.pillars.blocks().chain(self.doorway.iter().copied());
        self.gates().flat_map(|(gate, _)| gate.blocks()).chain(gap).chain(others).collect()
    }

    fn casters(&self) -> Vec<Block> {
        let gap = self.gap.iter().flat_map(GapWall::casters);
        let others = self.pillars.blocks().chain(self.doorway.iter().copied());
        self.gates().flat_map(|(gate, _)| gate.blocks()).chain(gap).chain(others).collect()
    }
}

impl Layout {
    /// Returns the positions of objects along x, evenly from the first to the last; a single object is in the middle.
    /// [m, world]
    fn places_m(self) -> Vec<f64> {
        let count = self.windows + usize::from(self.gap) + usize::from(self.hand);
        if count == 1 {
            return vec![f64::midpoint(FIRST_M, LAST_M)];
        }
        let step_m = (LAST_M - FIRST_M) / count.saturating_sub(1).max(1) as f64;
        (0..count).map(|n| FIRST_M + step_m * n as f64).collect()
    }
}

/// Names of stages.
const GAP: &str = "gap";
const HAND: &str = "clock hand";
/// Position of the first opening along x. [m, world]
const FIRST_M: f64 = 2.3;
/// Position of the last opening along x, with enough space behind it to stop before the net. [m, world]
const LAST_M: f64 = 8.95;
/// Positions of moving objects along x. [m, world]
const DOOR_M: f64 = 3.4;
const PENDULUM_M: f64 = 5.9;
const DRONE_M: f64 = 8.3;

fn build(
    seed: u64,
    name: &str,
    course: &Course,
    goal: Goal,
    max_speed_mps: f64,
    staging: &mut Staging,
) -> Generated {
    let shell = Shell::plan(seed);
    let mut truth = shell.truth();
    truth.extend(course.blocks().iter().map(Block::volume));
    let geofence = Geofence { min_m: NET_MIN_M - DVec3::Z * 0.5, max_m: NET_MAX_M };
    let stage = Stage {
        fence: &geofence,
        // A person can lift the net and walk up to the walls.
        around_m: 3.0,
        walls: &shell::walls(),
        movers: &course.movers.keep_out(),
        fence_is_kept_free: true,
    };
    staging.put_up(&mut truth, &stage);
    let solids = Solids::new(truth);
    let casters: Vec<Volume> =
        shell.casters().into_iter().chain(course.casters().iter().map(Block::volume)).collect();
    let mut rng = Rng::new(seed, 22);
    // Low afternoon sun through the north windows.
    let sun = DVec3::new(rng.spread(0.5), 1.0, rng.range(0.62, 0.8)).normalize();
    let light = HallLight::new(&solids, &casters, sun);
    let mut painter = Painter { canvas: Canvas::default(), rng, light };

    let spawn_m = DVec3::new(0.9, 0.0, 0.0);
    let mut parts = Parts::default();
    shell.paint(&mut painter, &|at| mats(seed, at, &[spawn_m, goal.position_m]));
    parts.add(&painter.canvas, PartClass::Room, "room");
    for (gate, name) in course.gates() {
        gate.paint_frame(&mut painter);
        parts.add(&painter.canvas, PartClass::Gate, &name);
        gate.paint_stand(&mut painter);
        parts.add(&painter.canvas, PartClass::Stand, &format!("stand of {name}"));
    }
    if let Some(gap) = &course.gap {
        gap.paint(&mut painter);
        parts.add(&painter.canvas, PartClass::Wall, GAP);
    }
    course.pillars.paint(&mut painter, &mut parts);
    for (n, block) in course.doorway.iter().enumerate() {
        let grain = Grain { coarse_m: 0.12, fine_m: 0.05 };
        painter.cuboid(block, grain, &[4], &|_, p| {
            let tone = 0.85 + 0.3 * noise2(seed ^ 0x84, p / 0.09);
            Some(Look::matt(paint(0x9a8f80) * tone))
        });
        parts.add(&painter.canvas, PartClass::Wall, &format!("doorway {}", n + 1));
    }
    let made = course.movers.make(&mut painter);
    let Painter { canvas, rng, light } = &mut painter;
    staging.paint(canvas, &mut |p_m, normal, albedo| light.matt(p_m, normal, albedo, rng));

    let splats = painter.canvas.finish();
    let arena = ArenaConfig {
        name: name.to_owned(),
        scene: "scene.ply".into(),
        body_radius_m: 0.12,
        takeoff_height_m: 1.2,
        time_limit_s: 60.0,
        ground_truth: true,
        attitude_rate: false,
        spawn: Spawn { position_m: spawn_m, yaw_deg: 0.0 },
        goal: Some(goal),
        geofence,
        limits: Limits::new(max_speed_mps, 6.0),
        body: Vec::new(),
        no_fly: Vec::new(),
        occupancy: Occupancy::default(),
        cameras: vec![front_camera()],
        environment: EnvironmentConfig::default(),
        pose: PoseConfig::default(),
        sensors: Vec::new(),
        vehicles: Vec::new(),
        localization: Vec::new(),
        stages: course.stages(),
        rules: RulesConfig {
            start_box: Some(RulesConfig::start_box_about(spawn_m)),
            ..RulesConfig::default()
        },
        objects: made.iter().map(|made| made.config.clone()).collect(),
    };
    let (objects, true_objects) =
        made.into_iter().map(|GeneratedMover { object, truth, .. }| (object, truth)).unzip();
    Generated {
        splats,
        parts: parts.finish(),
        arena,
        truth: solids.into_volumes(),
        objects,
        true_objects,
        map_is_known: false,
    }
}

/// Returns the colour of the floor mats: tiles of one metre with seams, scuffs, and a ring at start and goal.
fn mats(seed: u64, at: DVec2, pads_m: &[DVec3]) -> DVec3 {
    let (dark, bright) =
        [(0x35567a, 0x4a6f94), (0x4a4f56, 0x646a70), (0x2f6359, 0x47806f)][(seed % 3) as usize];
    let tile = at.floor();
    let odd = (tile.x + tile.y) as i64 % 2 == 0;
    let grain = noise2(seed ^ 0x81, at / 0.10);
    let scuff = fractal2(seed ^ 0x82, at / 0.8, 4);
    let tone = noise2(seed ^ 0x83, tile * 3.7) * 0.25 + 0.85;
    let seam = (at - at.round()).abs().min_element() < 0.014;
    let base = paint(if odd { dark } else { bright });
    for pad in pads_m {
        let r = (at - pad.truncate()).length();
        if (0.34..0.44).contains(&r) || r < 0.07 {
            return paint(0xe9e4d4) * (0.75 + 0.3 * grain);
        }
    }
    if seam { base * 0.45 } else { base * (tone * (0.72 + 0.3 * grain + 0.3 * scuff)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RACE: Layout = Layout {
        windows: 3,
        gap: true,
        hand: true,
        pillars: false,
        door: false,
        pendulum: false,
        drone: false,
    };

    #[test]
    fn fifty_courses_can_be_flown() {
        for seed in 0..50 {
            let course = Course::draw(seed, RACE);
            let volumes: Vec<Volume> = course.blocks().iter().map(Block::volume).collect();
            let clearance_m = |p_m: DVec3| {
                volumes.iter().map(|v| v.signed_distance_m(p_m)).fold(f64::MAX, f64::min)
            };
            let stages = course.stages();
            assert_eq!(stages.len(), 5);
            for stage in &stages {
                let free_m = clearance_m(stage.center_m);
                assert!(free_m >= 0.35, "seed {seed}: {free_m} m in {}", stage.name);
            }
            // There is a straight free path from half a metre behind each stage to half a metre before the next one.
            for pair in stages.windows(2) {
                let from_m = pair[0].center_m + pair[0].normal * 0.5;
                let to_m = pair[1].center_m - pair[1].normal * 0.5;
                for n in 0..=20 {
                    let p_m = from_m.lerp(to_m, f64::from(n) / 20.0);
                    let free_m = clearance_m(p_m);
                    assert!(free_m >= 0.2, "seed {seed}: {free_m} m before {}", pair[1].name);
                }
            }
            // Nothing reaches through the net.
            for (gate, _) in course.gates() {
                for block in gate.blocks() {
                    let (low, high) = crate::solids::bounds(&block.volume()).unwrap();
                    assert!(low.y > NET_MIN_M.y && high.y < NET_MAX_M.y, "seed {seed}");
                    assert!(low.z > -1e-9 && high.z < NET_MAX_M.z, "seed {seed}");
                }
            }
        }
    }

    #[test]
    fn the_part_of_a_gate_contains_exactly_its_bars() {
        for seed in 0..3 {
            let scene = build_race(seed, &mut Staging::none());
            let course = Course::draw(seed, RACE);
            assert!(scene.parts.windows(2).all(|pair| pair[0].splats.end == pair[1].splats.start));
            for (gate, name) in course.gates() {
                let part = scene.parts.iter().find(|part| part.name == name).unwrap();
                assert_eq!(part.class, PartClass::Gate);
                let bars: Vec<Volume> = gate.blocks()[..4].iter().map(Block::volume).collect();
                for (i, mean_m) in scene.splats.means_m.iter().enumerate() {
                    let of = |bar: &Volume| bar.signed_distance_m(mean_m.as_dvec3());
                    let off_m = bars.iter().map(of).fold(f64::MAX, f64::min);
                    let on_surface = (-0.005..1e-5).contains(&off_m);
                    if part.splats.contains(&i) {
                        assert!(on_surface, "seed {seed}, {name}: {off_m} m");
                    } else {
                        // The motor intersects the lower bar.
                        assert!(off_m > -0.002 || gate.with_hub, "seed {seed}, {name}: {off_m} m");
                    }
                }
            }
        }
    }

    #[test]
    fn courses_differ_by_seed() {
        assert_ne!(Course::draw(1, RACE).stages(), Course::draw(2, RACE).stages());
        assert_eq!(Course::draw(1, RACE).stages(), Course::draw(1, RACE).stages());
    }
}
