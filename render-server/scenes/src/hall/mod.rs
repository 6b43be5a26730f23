//! The netted lab, 11 x 4.5 x 3.65 m, empty (`room`) or with a race course (`race`).
//!
//! Data flow: [`shell`] plans the hall, [`gate`] and [`gap`] what stands in the net, all as true
//! boxes; [`light`] answers how much light arrives at a point; [`panel`] covers every face with
//! Gaussians as fine as its [`texture`] needs.

mod furniture;
mod gap;
mod gate;
mod light;
mod panel;
mod shell;
mod texture;

use glam::{DVec2, DVec3};
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::{Geofence, Goal, Occupancy, Spawn, StageConfig};
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::messages::Limits;

use crate::Generated;
use crate::canvas::{Canvas, paint};
use crate::forest::front_camera;
use crate::random::{Rng, fractal2, noise2};
use crate::solids::Solids;
use gap::GapWall;
use gate::Gate;
use light::HallLight;
use panel::{Block, Painter};
use shell::{NET_MAX_M, NET_MIN_M, Shell};

/// Returns the empty netted room of a seed.
pub(crate) fn build_room(seed: u64) -> Generated {
    let goal = Goal { position_m: DVec3::new(10.0, 0.0, 1.2), radius_m: 0.6 };
    build(seed, "room", &Course::default(), goal, 3.0)
}

/// Returns the race of a seed.
pub(crate) fn build_race(seed: u64) -> Generated {
    let course = Course::draw(seed);
    let goal = Goal { position_m: DVec3::new(10.3, 0.0, 1.2), radius_m: 0.5 };
    build(seed, "race", &course, goal, 4.0)
}

/// What stands in the net.
#[derive(Debug, Default)]
struct Course {
    windows: Vec<Gate>,
    gap: Option<GapWall>,
    hand: Option<Gate>,
}

impl Course {
    fn draw(seed: u64) -> Self {
        let mut rng = Rng::new(seed, 31);
        let mut side = if rng.chance(0.5) { 1.0 } else { -1.0 };
        let mut windows = Vec::new();
        let place = |rng: &mut Rng, x_m: f64, side: f64, colours, with_hub| {
            let opening_m = if with_hub {
                DVec2::new(rng.range(1.3, 1.45), rng.range(1.2, 1.3))
            } else {
                DVec2::splat(rng.range(1.0, 1.35))
            };
            // The lower bar stays a hand above the floor, the upper below the net.
            let z_m = rng.range(0.25 + opening_m.y / 2.0 + 0.2, 1.85);
            Gate {
                center_m: DVec3::new(x_m + rng.spread(0.1), side * rng.range(0.1, 0.75), z_m),
                yaw_rad: rng.spread(20f64.to_radians()),
                opening_m,
                colours,
                with_hub,
            }
        };
        let colours = [(0xd81f2a, 0xf6f2ea), (0x1f54d8, 0xf2d21f), (0xe0218a, 0x1c1c22)];
        for (n, (bar, stripe)) in colours.into_iter().enumerate() {
            let x_m = 2.3 + 1.65 * n as f64;
            windows.push(place(&mut rng, x_m, side, (paint(bar), paint(stripe)), false));
            side = -side;
        }
        let gap = GapWall::draw(seed, &mut rng, 7.25, side);
        let colours = (paint(0xf08a12), paint(0x14181c));
        let hand = place(&mut rng, 8.95, -side, colours, true);
        Self { windows, gap: Some(gap), hand: Some(hand) }
    }

    fn gates(&self) -> impl Iterator<Item = &Gate> {
        self.windows.iter().chain(&self.hand)
    }

    fn stages(&self) -> Vec<StageConfig> {
        let mut stages = Vec::new();
        for (n, window) in self.windows.iter().enumerate() {
            stages.push(window.stage(&format!("window {}", n + 1)));
        }
        stages.extend(self.gap.iter().map(|gap| gap.stage("gap")));
        stages.extend(self.hand.iter().map(|hand| hand.stage("clock hand")));
        stages
    }

    fn blocks(&self) -> Vec<Block> {
        let gap = self.gap.iter().flat_map(GapWall::blocks);
        self.gates().flat_map(Gate::blocks).chain(gap).collect()
    }

    fn casters(&self) -> Vec<Block> {
        let gap = self.gap.iter().flat_map(GapWall::casters);
        self.gates().flat_map(Gate::blocks).chain(gap).collect()
    }
}

fn build(seed: u64, name: &str, course: &Course, goal: Goal, max_speed_mps: f64) -> Generated {
    let shell = Shell::plan(seed);
    let mut truth = shell.truth();
    truth.extend(course.blocks().iter().map(Block::volume));
    let solids = Solids::new(truth);
    let casters: Vec<Volume> =
        shell.casters().into_iter().chain(course.casters().iter().map(Block::volume)).collect();
    let mut rng = Rng::new(seed, 22);
    // Through the north windows, afternoon-low.
    let sun = DVec3::new(rng.spread(0.5), 1.0, rng.range(0.62, 0.8)).normalize();
    let light = HallLight::new(&solids, &casters, sun);
    let mut painter = Painter { canvas: Canvas::default(), rng, light };

    let spawn_m = DVec3::new(0.9, 0.0, 0.0);
    shell.paint(&mut painter, &|at| mats(seed, at, &[spawn_m, goal.position_m]));
    for gate in course.gates() {
        gate.paint(&mut painter);
    }
    if let Some(gap) = &course.gap {
        gap.paint(&mut painter);
    }

    let splats = painter.canvas.finish();
    let arena = ArenaConfig {
        name: name.to_owned(),
        scene: "scene.ply".to_owned(),
        body_radius_m: 0.12,
        takeoff_height_m: 1.2,
        time_limit_s: 60.0,
        ground_truth: true,
        attitude_rate: false,
        spawn: Spawn { position_m: spawn_m, yaw_deg: 0.0 },
        goal: Some(goal),
        geofence: Geofence { min_m: NET_MIN_M - DVec3::Z * 0.5, max_m: NET_MAX_M },
        limits: Limits::new(max_speed_mps, 6.0),
        occupancy: Occupancy::default(),
        cameras: vec![front_camera()],
        vehicles: Vec::new(),
        stages: course.stages(),
    };
    Generated { splats, arena, truth: solids.into_volumes() }
}

/// Returns the colour of the floor mats: one-metre tiles with seams, scuffs, and a ring at each
/// place to start from or land on.
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

    #[test]
    fn fifty_courses_can_be_flown() {
        for seed in 0..50 {
            let course = Course::draw(seed);
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
            // Between two stages there is a way: straight from half a metre behind one to half
            // a metre before the next.
            for pair in stages.windows(2) {
                let from_m = pair[0].center_m + pair[0].normal * 0.5;
                let to_m = pair[1].center_m - pair[1].normal * 0.5;
                for n in 0..=20 {
                    let p_m = from_m.lerp(to_m, f64::from(n) / 20.0);
                    let free_m = clearance_m(p_m);
                    assert!(free_m >= 0.2, "seed {seed}: {free_m} m before {}", pair[1].name);
                }
            }
            // Nothing reaches through the net or into another piece.
            for gate in course.gates() {
                for block in gate.blocks() {
                    let (low, high) = crate::solids::bounds(&block.volume()).unwrap();
                    assert!(low.y > NET_MIN_M.y && high.y < NET_MAX_M.y, "seed {seed}");
                    assert!(low.z > -1e-9 && high.z < NET_MAX_M.z, "seed {seed}");
                }
            }
        }
    }

    #[test]
    fn courses_differ_by_seed() {
        assert_ne!(Course::draw(1).stages(), Course::draw(2).stages());
        assert_eq!(Course::draw(1).stages(), Course::draw(1).stages());
    }
}
