//! Random settings of each image, drawn from the seeds of the data set and the scene, and from the image's number.

use std::f64::consts::{PI, TAU};

use anyhow::{Context, Result};
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_arena::config::EnvironmentConfig;
use vizflyt_protocol::geometry::{
    Body, Cam, Intrinsics, Object, Pose, World as WorldFrame, body_from_forward_cam,
};
use vizflyt_splat::Placement;
use vizflyt_twin::random::Random;

use super::randomize::{Randomize, count, range};
use super::world::{Gate, Slot, World};
use crate::evaluate::trajectory::Stamped;

/// Source of poses.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Poses {
    /// Random poses in the free space.
    Random(RandomPoses),
    /// Poses along a path; the optical flow of an image leads to the next one.
    Path { poses: Vec<Stamped>, of: PathOf },
}

/// Frame of the poses of a path.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub(super) enum PathOf {
    /// Body of the vehicle: x forward, y left, z up
    #[default]
    Body,
    /// Camera: x right, y down, z forward
    Camera,
}

/// Bounds of random poses.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RandomPoses {
    /// Minimum distance of the camera from solid space and from the fence. [m]
    pub(super) clearance_m: f64,
    /// Maximum pitch and roll. [deg]
    pub(super) tilt_deg: f64,
    /// Probability that the camera looks towards a gate.
    pub(super) look_at_gate: f64,
    /// Range of distances from that gate. [m]
    pub(super) gate_distance_m: [f64; 2],
    /// Time between the two images of optical flow. [s]
    pub(super) flow_dt_s: f64,
}

/// Time of the scene's clock and pose of a camera. [ns]
pub(super) type TimedCamera = (i64, Pose<WorldFrame, Cam>);

/// Settings of an image.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Shot {
    /// Time of the scene's clock. [ns]
    pub(super) at_ns: i64,
    pub(super) world_from_cam: Pose<WorldFrame, Cam>,
    /// Second time and pose for the optical flow; none at the end of a path.
    pub(super) next: Option<TimedCamera>,
    pub(super) intrinsics: Intrinsics,
    pub(super) environment: EnvironmentConfig,
    /// Seed of random weather, such as the positions of drops.
    pub(super) seed: u64,
    /// Texture of each gate with several textures.
    textures: Vec<usize>,
    /// Placement of each loose object.
    loose: Vec<Placement>,
}

/// Settings of all images.
#[derive(Clone, Debug)]
pub(super) struct Shooting {
    pub(super) seed: u64,
    pub(super) intrinsics: Intrinsics,
    pub(super) poses: Poses,
    pub(super) randomize: Randomize,
}

impl Shooting {
    /// Draws image `within` of the `of` images of a scene.
    ///
    /// # Errors
    /// No free pose is found for the camera.
    pub(super) fn shot(&self, world: &World, within: usize, of: usize) -> Result<Shot> {
        let mut random = Random::stream(self.seed ^ world.seed.rotate_left(32), within as u64);
        let intrinsics = self.randomize.intrinsics(self.intrinsics, &mut random);
        let environment = self.randomize.environment(&world.arena.environment, &mut random);
        let ((at_ns, world_from_cam), next) = match &self.poses {
            Poses::Path { poses, of: kind } => on_path(poses, *kind, within, of),
            Poses::Random(bounds) => bounds
                .draw(world, self.at_ns(within, of), &intrinsics, &mut random)
                .with_context(|| format!("number {within} of {}", world.name))?,
        };
        let textures = (0..world.textured_gates())
            .map(|_| {
                let is_other = f64::from(random.unit()) < self.randomize.gates.probability;
                let texture = 1 + random.below(self.randomize.textures().max(1));
                if is_other { texture } else { 0 }
            })
            .collect();
        let loose = self.scatter(world, at_ns, &world_from_cam, &intrinsics, &mut random);
        let seed = self.seed ^ within as u64;
        Ok(Shot { at_ns, world_from_cam, next, intrinsics, environment, seed, textures, loose })
    }

    /// Returns the time of image `within` of the `of` images of a scene, on the scene's clock. [ns]
    pub(super) fn at_ns(&self, within: usize, of: usize) -> i64 {
        match &self.poses {
            Poses::Path { poses, .. } => instant_ns(poses, row(poses, within, of)),
            // Evenly over the motion of the objects, and in order, like a sequence of images.
            Poses::Random(_) => within as i64 * PERIOD_NS,
        }
    }

    /// Places distractors and vehicles in the free space in front of the camera.
    fn scatter(
        &self,
        world: &World,
        at_ns: i64,
        world_from_cam: &Pose<WorldFrame, Cam>,
        intrinsics: &Intrinsics,
        random: &mut Random,
    ) -> Vec<Placement> {
        let mut left = [self.randomize.vehicles.count, self.randomize.distractors.count]
            .map(|bounds| count(random, bounds));
        let mut taken: Vec<(DVec3, f64)> = vec![(world_from_cam.translation_m, 0.3)];
        let loose = world.slots.iter().filter_map(|slot| match *slot {
            Slot::Loose { distractor, radius_m } => Some((distractor, radius_m)),
            _ => None,
        });
        let mut placed = Vec::new();
        for (distractor, radius_m) in loose {
            let left = &mut left[usize::from(distractor)];
            if *left == 0 {
                placed.push(None);
                continue;
            }
            *left -= 1;
            let place = (0..TRIES_LOOSE).find_map(|_| {
                let pixel = glam::DVec2::new(
                    f64::from(intrinsics.width_px) * f64::from(random.unit()),
                    f64::from(intrinsics.height_px) * f64::from(random.unit()),
                );
                let p_cam = intrinsics.unproject(pixel, range(random, LOOSE_M))?;
                let p_m = world_from_cam.transform_point(p_cam);
                let apart =
                    |(other_m, other): &(DVec3, f64)| (p_m - *other_m).length() > other + radius_m;
                (taken.iter().all(apart) && world.free.is_free(at_ns, p_m, radius_m)).then_some(p_m)
            });
            let rotation = if distractor {
                let turn = DVec3::from_array([(); 3].map(|()| f64::from(random.normal())));
                DQuat::from_scaled_axis(turn * 2.0)
            } else {
                let yaw_rad = range(random, [-PI, PI]);
                let [pitch, roll] = [(); 2].map(|()| range(random, [-0.35, 0.35]));
                attitude(yaw_rad, pitch, roll)
            };
            taken.extend(place.map(|p_m| (p_m, radius_m)));
            placed.push(place.map(|p_m| Pose::new(p_m, rotation.normalize())));
        }
        placed
    }
}

impl Shot {
    /// Returns the placements of all objects of the scene at a time of the scene's clock. [ns]
    pub(super) fn placements(&self, world: &World, at_ns: i64) -> Vec<Placement> {
        let mut loose = self.loose.iter().copied();
        let place = |slot: &Slot| match *slot {
            Slot::Still => Some(Pose::IDENTITY),
            Slot::Texture { gate, texture } => {
                (self.textures[gate] == texture).then_some(Pose::IDENTITY)
            }
            Slot::Mover(index) => Some(world.movers.placement(index, at_ns)),
            Slot::Loose { .. } => loose.next().flatten(),
        };
        world.slots.iter().map(place).collect()
    }
}

impl RandomPoses {
    fn draw(
        &self,
        world: &World,
        at_ns: i64,
        intrinsics: &Intrinsics,
        random: &mut Random,
    ) -> Result<(TimedCamera, Option<TimedCamera>)> {
        let found = (0..TRIES).find_map(|_| {
            let world_from_body = self.candidate(world, intrinsics, random);
            let p_m = world_from_body.translation_m;
            world.free.is_free(at_ns, p_m, self.clearance_m).then_some(world_from_body)
        });
        let world_from_body = found.with_context(|| {
            format!(
                "none of {TRIES} positions has a clearance of {} m; give a smaller --clearance, or another scene",
                self.clearance_m
            )
        })?;
        let vector = |random: &mut Random, scale: f64| {
            DVec3::from_array([(); 3].map(|()| range(random, [-scale, scale])))
        };
        let moved_m = vector(random, SPEED_MPS) * self.flow_dt_s;
        let turned = DQuat::from_scaled_axis(vector(random, TURN_RADPS) * self.flow_dt_s);
        let next: Pose<WorldFrame, Body> = Pose::new(
            world_from_body.translation_m + moved_m,
            (world_from_body.rotation * turned).normalize(),
        );
        let next_ns = at_ns + (self.flow_dt_s * 1e9).round() as i64;
        let body_from_cam = body_from_forward_cam(DVec3::ZERO, 0.0);
        let here = (at_ns, world_from_body * body_from_cam);
        Ok((here, Some((next_ns, next * body_from_cam))))
    }

    fn candidate(
        &self,
        world: &World,
        intrinsics: &Intrinsics,
        random: &mut Random,
    ) -> Pose<WorldFrame, Body> {
        let tilt_rad = self.tilt_deg.to_radians();
        let [pitch_rad, roll_rad] = [(); 2].map(|()| range(random, [-tilt_rad, tilt_rad]));
        if f64::from(random.unit()) < self.look_at_gate && !world.gates.is_empty() {
            let gate = &world.gates[random.below(world.gates.len())];
            let half_fov_rad =
                (f64::from(intrinsics.width_px) / 2.0 / intrinsics.fx_px).atan().min(1.2);
            return self.towards(gate, [pitch_rad, roll_rad], half_fov_rad, random);
        }
        let p_m = world.free.draw(random);
        Pose::new(p_m, attitude(TAU * f64::from(random.unit()), pitch_rad, roll_rad))
    }

    /// Draws a pose in front of a gate or, with probability 1/4, behind it. The gate is in the image, mostly
    /// off-centre.
    fn towards(
        &self,
        gate: &Gate,
        [pitch_rad, roll_rad]: [f64; 2],
        half_fov_rad: f64,
        random: &mut Random,
    ) -> Pose<WorldFrame, Body> {
        let distance_m = range(random, self.gate_distance_m);
        let side = if random.unit() < 0.75 { -1.0 } else { 1.0 };
        let (azimuth, elevation) = (range(random, [-1.0, 1.0]), range(random, [-0.35, 0.35]));
        let from_gate = DVec3::new(
            side * azimuth.cos() * elevation.cos(),
            azimuth.sin() * elevation.cos(),
            elevation.sin(),
        );
        let p_m = gate.world_from_gate.transform_point(from_gate * distance_m);
        let ahead = gate.world_from_gate.translation_m - p_m;
        let aside_rad = range(random, [-0.6, 0.6]) * half_fov_rad;
        let yaw_rad = ahead.y.atan2(ahead.x) + aside_rad;
        let up_rad = ahead.z.atan2(ahead.truncate().length());
        Pose::new(p_m, attitude(yaw_rad, up_rad + pitch_rad, roll_rad))
    }
}

fn on_path(
    poses: &[Stamped],
    kind: PathOf,
    within: usize,
    of: usize,
) -> (TimedCamera, Option<TimedCamera>) {
    let at = |row: usize| {
        let stamped = &poses[row];
        let (p_m, rotation) = (stamped.position_m, stamped.rotation);
        let world_from_cam = match kind {
            PathOf::Camera => Pose::new(p_m, rotation),
            PathOf::Body => {
                Pose::<WorldFrame, Body>::new(p_m, rotation)
                    * body_from_forward_cam(DVec3::ZERO, 0.0)
            }
        };
        (instant_ns(poses, row), world_from_cam)
    };
    let here = at(row(poses, within, of));
    let next = row(poses, within + 1, of);
    (here, (next < poses.len()).then(|| at(next)))
}

/// Returns the row of an image: evenly along the path, each pose at most once.
fn row(poses: &[Stamped], within: usize, of: usize) -> usize {
    within * poses.len() / of.max(1)
}

fn instant_ns(poses: &[Stamped], row: usize) -> i64 {
    ((poses[row].at_s - poses[0].at_s) * 1e9).round() as i64
}

/// Returns a rotation from heading, pitch (nose up) and roll (right side down). [rad]
fn attitude(yaw_rad: f64, pitch_up_rad: f64, roll_rad: f64) -> DQuat {
    let turn = DQuat::from_rotation_z(yaw_rad) * DQuat::from_rotation_y(-pitch_up_rad);
    (turn * DQuat::from_rotation_x(roll_rad)).normalize()
}

/// Maximum number of tested poses for an image.
const TRIES: usize = 2000;
/// Maximum number of tested positions for a loose object; then it is omitted.
const TRIES_LOOSE: usize = 12;
/// Range of distances of loose objects from the camera. [m, cam]
const LOOSE_M: [f64; 2] = [0.6, 6.0];
/// Time between images of random poses. [ns]
const PERIOD_NS: i64 = 100_000_000;
/// Maximum speeds for optical flow, as of a racing vehicle. [m/s, rad/s, on each axis]
const SPEED_MPS: f64 = 2.0;
const TURN_RADPS: f64 = 1.5;

/// Returns position and quaternion (xyzw) of a pose, for files.
pub(super) fn numbers<A, B>(pose: &Pose<A, B>) -> ([f64; 3], [f64; 4]) {
    (pose.translation_m.to_array(), pose.rotation.to_array())
}

/// Returns the motion of an object between two placements. [world]
pub(super) fn motion(
    from: &Pose<WorldFrame, Object>,
    to: &Pose<WorldFrame, Object>,
) -> Pose<WorldFrame, WorldFrame> {
    *to * from.inverse()
}

#[cfg(test)]
mod tests {
    use vizflyt_scenes::projects::CourseProject;
    use vizflyt_server::scene::PartsFile;

    use super::*;
    use crate::dataset::classes::Classes;

    pub(super) const BOUNDS: RandomPoses = RandomPoses {
        clearance_m: 0.25,
        tilt_deg: 15.0,
        look_at_gate: 1.0,
        gate_distance_m: [1.0, 4.0],
        flow_dt_s: 0.04,
    };

    fn shooting(poses: Poses) -> (World, Shooting) {
        let project = CourseProject::named("p5").unwrap();
        let mut randomize = Randomize::default();
        randomize.distractors.count = [2, 4];
        randomize.vehicles.count = [1, 1];
        let classes = Classes::with(std::iter::empty()).unwrap();
        let world =
            World::generate(&project, 3, &randomize, &PartsFile::default(), &classes).unwrap();
        let intrinsics = Intrinsics::from_horizontal_fov(320, 240, 1.5);
        (world, Shooting { seed: 9, intrinsics, poses, randomize })
    }

    #[test]
    fn random_cameras_are_free_and_upright_and_see_a_gate() {
        let (world, shooting) = shooting(Poses::Random(BOUNDS));
        let mut seen = 0;
        for within in 0..60 {
            let shot = shooting.shot(&world, within, 60).unwrap();
            assert_eq!(shot, shooting.shot(&world, within, 60).unwrap());
            let p_m = shot.world_from_cam.translation_m;
            assert!(world.free.is_free(shot.at_ns, p_m, 0.25));
            // The upper side of the image points up.
            assert!(shot.world_from_cam.rotate(DVec3::NEG_Y).z > 0.7);
            let cam_from_world = shot.world_from_cam.inverse();
            let in_image = |gate: &Gate| {
                let at = cam_from_world.transform_point(gate.world_from_gate.translation_m);
                shot.intrinsics.project(at).is_some_and(|pixel| {
                    (0.0..320.0).contains(&pixel.x) && (0.0..240.0).contains(&pixel.y)
                })
            };
            seen += usize::from(world.gates.iter().any(in_image));
            let floating = shot.loose.iter().flatten().count();
            assert!(
                floating <= 5 && shot.placements(&world, shot.at_ns).len() == world.slots.len()
            );
            let (next_ns, next) = shot.next.unwrap();
            assert_eq!(next_ns - shot.at_ns, 40_000_000);
            assert!((next.translation_m - p_m).length() < 0.2);
        }
        assert!(seen >= 55, "{seen} of 60 show a gate");
    }

    #[test]
    fn poses_are_evenly_spaced_along_a_path() {
        let stamped = |n: u32| Stamped {
            at_s: 100.0 + f64::from(n),
            position_m: DVec3::new(f64::from(n), 0.0, 1.0),
            rotation: DQuat::IDENTITY,
        };
        let poses = Poses::Path { poses: (0..10).map(stamped).collect(), of: PathOf::Body };
        let (world, shooting) = shooting(poses);
        let shots: Vec<Shot> = (0..5).map(|n| shooting.shot(&world, n, 5).unwrap()).collect();
        let along: Vec<f64> =
            shots.iter().map(|shot| shot.world_from_cam.translation_m.x).collect();
        assert_eq!(along, [0.0, 2.0, 4.0, 6.0, 8.0]);
        assert_eq!(shots[1].at_ns, 2_000_000_000);
        assert_eq!(shots[1].next.unwrap().1, shots[2].world_from_cam);
        assert!(shots[4].next.is_none());
        // The optical axis is the body's forward axis.
        assert!((shots[0].world_from_cam.rotate(DVec3::Z) - DVec3::X).length() < 1e-12);
    }
}
