//! Moving objects in the net: hand of the last window, sliding door, pendulum, second drone. Each is painted at its
//! rest pose in the hall's light, and then transformed to the object frame.

use glam::{DQuat, DVec2, DVec3};
use vizflyt_arena::config::{MotionConfig, ObjectConfig};
use vizflyt_protocol::geometry::{Object, Pose, Volume, World};
use vizflyt_splat::builtin_models::{QUADROTOR, boxes};
use vizflyt_splat::{RigidObject, Splats};

use super::dimensions::{NET_MAX_M, NET_MIN_M};
use super::gate::Gate;
use super::panel::{Block, Grain, Look, Painter};
use crate::canvas::paint;
use crate::random::Rng;

/// Moving objects of a course.
#[derive(Clone, Debug, Default)]
pub(crate) struct Movers {
    movers: Vec<Mover>,
}

/// Moving object.
#[derive(Clone, Debug)]
struct Mover {
    name: &'static str,
    /// Rest position. [m, world]
    position_m: DVec3,
    yaw_rad: f64,
    phase_s: f64,
    motion: MotionConfig,
    shape: Shape,
}

#[derive(Clone, Debug)]
enum Shape {
    /// Painted boxes, with two colours in bands along z. [m, object]
    Blocks(Vec<(Block, [DVec3; 2])>),
    Quadrotor,
}

/// Generated moving object.
pub(crate) struct GeneratedMover {
    pub(crate) config: ObjectConfig,
    pub(crate) object: RigidObject,
    /// True solids. [m, object]
    pub(crate) truth: Vec<Volume>,
}

impl Movers {
    /// Adds the hand of a window on its motor. It rotates at constant speed in either direction.
    pub(crate) fn add_hand(&mut self, seed: u64, gate: &Gate) {
        let mut rng = Rng::new(seed, 41);
        let speed_deg_ps = rng.range(45.0, 65.0);
        let period_s = 360.0 / speed_deg_ps;
        let side = if rng.chance(0.5) { 1.0 } else { -1.0 };
        // The hand is in front of the window's bars, so that it passes them.
        let pivot_m = gate.at(DVec3::new(-HAND_AHEAD_M, 0.0, -gate.opening_m.y / 2.0));
        let bar = Block::between(
            DVec3::new(-0.015, -0.035, -HAND_TAIL_M),
            DVec3::new(0.015, 0.035, HAND_M),
        );
        self.movers.push(Mover {
            name: "hand",
            position_m: pivot_m,
            yaw_rad: gate.yaw_rad,
            phase_s: rng.range(0.0, period_s),
            motion: MotionConfig::Rotation { axis: DVec3::X * side, period_s },
            shape: Shape::Blocks(vec![(bar, [paint(0x12b5a6), paint(0x12b5a6)])]),
        });
    }

    /// Adds a door that slides across the net at `x_m`, at a doorway between two walls.
    pub(crate) fn add_door(&mut self, seed: u64, x_m: f64) {
        let mut rng = Rng::new(seed, 42);
        let leaf = Block::between(DVec3::new(-0.03, -0.45, 0.05), DVec3::new(0.03, 0.45, 2.35));
        let period_s = rng.range(6.0, 9.0);
        self.movers.push(Mover {
            name: "door",
            position_m: DVec3::new(x_m, 0.0, 0.0),
            yaw_rad: 0.0,
            phase_s: rng.range(0.0, period_s),
            motion: MotionConfig::Oscillation {
                slide_m: DVec3::Y * 1.2,
                axis: DVec3::ZERO,
                swing_deg: 0.0,
                period_s,
            },
            shape: Shape::Blocks(vec![(leaf, [paint(0x3f7fbf), paint(0xe8e4d8)])]),
        });
    }

    /// Adds a pendulum (block on a rod) that swings across the net at `x_m`.
    pub(crate) fn add_pendulum(&mut self, seed: u64, x_m: f64) {
        let mut rng = Rng::new(seed, 43);
        let rod = Block::between(DVec3::new(-0.015, -0.015, -1.7), DVec3::new(0.015, 0.015, 0.0));
        let bob = Block::between(DVec3::new(-0.14, -0.14, -1.98), DVec3::new(0.14, 0.14, -1.7));
        // Period of a mathematical pendulum of this length: 2 pi sqrt(l / g).
        let period_s = 2.0 * core::f64::consts::PI * (1.84f64 / 9.81).sqrt();
        self.movers.push(Mover {
            name: "pendulum",
            position_m: DVec3::new(x_m, rng.spread(0.3), 3.3),
            yaw_rad: 0.0,
            phase_s: rng.range(0.0, period_s),
            motion: MotionConfig::Oscillation {
                slide_m: DVec3::ZERO,
                axis: DVec3::X,
                swing_deg: rng.range(30.0, 40.0),
                period_s,
            },
            shape: Shape::Blocks(vec![
                (rod, [paint(0x8b8e93), paint(0x8b8e93)]),
                (bob, [paint(0xc23b2a), paint(0xf2d21f)]),
            ]),
        });
    }

    /// Adds a drone that flies back and forth across the net at `x_m`.
    pub(crate) fn add_drone(&mut self, seed: u64, x_m: f64) {
        let mut rng = Rng::new(seed, 44);
        let reach_m = NET_MAX_M.y - 0.7;
        let up_m = rng.range(0.2, 0.4);
        let points_m = vec![
            DVec3::new(0.0, -reach_m, 0.0),
            DVec3::new(0.3, 0.0, up_m),
            DVec3::new(0.0, reach_m, 0.0),
            DVec3::new(-0.3, 0.0, -up_m),
        ];
        self.movers.push(Mover {
            name: "second drone",
            position_m: DVec3::new(x_m, 0.0, 1.3),
            yaw_rad: core::f64::consts::PI,
            phase_s: rng.range(0.0, 8.0),
            motion: MotionConfig::Path { points_m, speed_mps: rng.range(0.7, 1.1), closed: true },
            shape: Shape::Quadrotor,
        });
    }

    /// Returns vertical columns around moving objects, which walks must avoid. [m, world]
    pub(crate) fn keep_out(&self) -> Vec<Volume> {
        let column = |mover: &Mover| {
            let at = mover.position_m.truncate();
            Volume::Capsule { a_m: at.extend(0.0), b_m: at.extend(2.5), radius_m: KEEP_OUT_M }
        };
        self.movers.iter().map(column).collect()
    }

    /// Generates all objects, with ids from 1.
    pub(crate) fn make(&self, painter: &mut Painter) -> Vec<GeneratedMover> {
        let numbered = self.movers.iter().zip(1..);
        numbered.map(|(mover, id)| mover.make(id, painter)).collect()
    }
}

impl Mover {
    fn make(&self, id: u16, painter: &mut Painter) -> GeneratedMover {
        let rest = self.rest();
        let (splats, truth) = match &self.shape {
            Shape::Quadrotor => {
                let solid = |part: &vizflyt_splat::builtin_models::Part| Volume::Cuboid {
                    center_m: part.center_m.as_dvec3(),
                    half_m: part.half_m.as_dvec3(),
                    rotation: DQuat::IDENTITY,
                };
                (boxes(&QUADROTOR), QUADROTOR.iter().map(solid).collect())
            }
            Shape::Blocks(blocks) => {
                let kept = core::mem::take(&mut painter.canvas);
                for (block, colours) in blocks {
                    paint_block(painter, block, *colours, &rest);
                }
                let painted = core::mem::replace(&mut painter.canvas, kept).finish();
                (into_frame(painted, &rest), blocks.iter().map(|(b, _)| b.volume()).collect())
            }
        };
        let config = ObjectConfig {
            name: self.name.to_owned(),
            scene: format!("{}.ply", self.name.replace(' ', "-")),
            position_m: self.position_m,
            yaw_deg: self.yaw_rad.to_degrees(),
            phase_s: Some(self.phase_s),
            motion: Some(self.motion.clone()),
        };
        GeneratedMover { config, object: RigidObject { id, splats }, truth }
    }

    /// Returns the rest pose, with the yaw rounded as in the arena file: converted to degrees and back.
    fn rest(&self) -> Pose<World, Object> {
        let yaw_rad = self.yaw_rad.to_degrees().to_radians();
        Pose::new(self.position_m, DQuat::from_rotation_z(yaw_rad))
    }
}

fn paint_block(
    painter: &mut Painter,
    block: &Block,
    [even, odd]: [DVec3; 2],
    rest: &Pose<World, Object>,
) {
    let placed = Block {
        center_m: rest.transform_point(block.center_m),
        half_m: block.half_m,
        rotation: rest.rotation * block.rotation,
    };
    let grain = Grain { coarse_m: 0.05, fine_m: 0.02 };
    painter.cuboid(&placed, grain, &[], &|face, p: DVec2| {
        let band = (placed.local(face, p).z / BAND_M).floor() as i64;
        Some(Look::matt(if band.rem_euclid(2) == 0 { even } else { odd }))
    });
}

/// Returns the walls next to a sliding door, just behind its leaf. The doorway is free at each end of the door's
/// motion. [m, world]
pub(crate) fn doorway(x_m: f64) -> [Block; 2] {
    let wall = |low_m: f64, high_m: f64| {
        Block::between(DVec3::new(x_m + 0.06, low_m, 0.0), DVec3::new(x_m + 0.16, high_m, 2.5))
    };
    [wall(NET_MIN_M.y, -DOORWAY_M / 2.0), wall(DOORWAY_M / 2.0, NET_MAX_M.y)]
}

/// Width of a doorway. [m]
const DOORWAY_M: f64 = 1.5;

/// Transforms splats from the world to the frame of an object with this rest pose.
fn into_frame(mut splats: Splats, rest: &Pose<World, Object>) -> Splats {
    let object_from_world = rest.inverse();
    for mean_m in &mut splats.means_m {
        *mean_m = object_from_world.transform_point(mean_m.as_dvec3()).as_vec3();
    }
    for rotation in &mut splats.rotations {
        let turned = object_from_world.rotation * rotation.as_dquat();
        *rotation = turned.normalize().as_quat();
    }
    splats
}

/// Length from the pivot to the hand's tip, almost up to the window's upper bar. [m]
pub(crate) const HAND_M: f64 = 0.95;
/// Length of the hand behind the pivot. [m]
const HAND_TAIL_M: f64 = 0.08;
/// Distance of the hand in front of the window's centre plane, so that it is clear of the motor. [m]
const HAND_AHEAD_M: f64 = 0.1;
/// Height of a band of colour. [m]
const BAND_M: f64 = 0.2;

const _: () = assert!(NET_MIN_M.y == -NET_MAX_M.y);

/// Distance of walks from the centre of moving objects. [m]
const KEEP_OUT_M: f64 = 0.8;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canvas::Canvas;
    use vizflyt_arena::objects::MovingObjects;

    /// Generates an object in plain light.
    fn made(add: impl FnOnce(&mut Movers)) -> GeneratedMover {
        let mut movers = Movers::default();
        add(&mut movers);
        let solids = crate::solids::Solids::new(Vec::new());
        let light = super::super::light::HallLight::new(&solids, &[], DVec3::Z);
        let mut painter = Painter { canvas: Canvas::default(), rng: Rng::new(1, 1), light };
        let mut made = movers.make(&mut painter);
        assert!(painter.canvas.finish().is_empty(), "painted into the scene");
        made.remove(0)
    }

    #[test]
    fn splats_lie_on_the_true_faces_in_the_object_frame() {
        for add in [
            |movers: &mut Movers| movers.add_door(3, 4.0),
            |movers: &mut Movers| movers.add_pendulum(3, 6.0),
            |movers: &mut Movers| movers.add_drone(3, 9.0),
        ] {
            let GeneratedMover { config, object, truth } = made(add);
            assert!(object.splats.len() > 300 && object.id == 1, "{}", config.name);
            for mean_m in &object.splats.means_m {
                let of = |volume: &Volume| volume.signed_distance_m(mean_m.as_dvec3());
                let nearest_m = truth.iter().map(of).fold(f64::MAX, f64::min);
                assert!((-0.01..0.002).contains(&nearest_m), "{}: {nearest_m}", config.name);
            }
        }
    }

    #[test]
    fn moving_objects_stay_in_the_net() {
        for seed in 0..10 {
            for add in [Movers::add_door, Movers::add_pendulum, Movers::add_drone] {
                let GeneratedMover { config, truth, .. } = made(|movers| add(movers, seed, 5.5));
                let objects = MovingObjects::of(std::slice::from_ref(&config), 0);
                for n in 0..200 {
                    let placement = objects.placement(0, n * 61_000_000);
                    for volume in &truth {
                        let (low_m, high_m) = crate::solids::bounds(volume).unwrap();
                        for corner_m in [low_m, high_m] {
                            let p_m = placement.transform_point(corner_m);
                            let inside = p_m.y.abs() < NET_MAX_M.y && p_m.z < NET_MAX_M.z;
                            assert!(inside && p_m.z > 0.0, "seed {seed}: {} at {p_m}", config.name);
                        }
                    }
                }
            }
        }
    }
}
