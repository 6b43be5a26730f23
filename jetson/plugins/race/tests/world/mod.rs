//! A small simulated world for races without an autopilot: the twin's renderer, moving objects, and a vehicle that
//! follows velocities with lag, tilt and limits. In lock-step: the vehicle moves after each reply of the plugin.

pub(crate) mod vehicle;

use std::collections::VecDeque;

use vizflyt_arena::objects::MovingObjects;
use vizflyt_race::Race;
use vizflyt_scenes::projects::{CourseProject, Level};
use vizflyt_scenes::{Generated, Variant};
use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::protocol::geometry::Object;
use vizflyt_sdk::{
    Autonomy, ImageStamps, ObservationBuffer, Pose, Setpoint, Vehicle, Volume, World, YawTarget,
};
use vizflyt_splat::{Camera, CpuRenderer, DepthKind, Rasterizer, RgbdImage, Scene};

use vehicle::Quadrotor;

/// Result of a flight, from the true state.
#[derive(Clone, Debug)]
pub(crate) struct Outcome {
    pub(crate) stages: usize,
    pub(crate) of_stages: usize,
    pub(crate) collided: bool,
    pub(crate) seconds: f64,
    pub(crate) end_m: DVec3,
    /// Smallest distance in flight from the body's surface to anything but the floor. [m]
    pub(crate) least_m: f64,
    /// Largest error of the plugin's position estimate. [m]
    pub(crate) drift_m: f64,
}

impl Outcome {
    /// Returns whether all stages were passed without a collision.
    pub(crate) fn is_good(&self) -> bool {
        self.stages == self.of_stages && !self.collided
    }
}

/// Flies a project's course of a seed until the last stage, a collision, or `limit_s`.
/// Calls `watch` for every image with its time [s] and the position of its camera [m, home].
#[allow(dead_code, reason = "the rehearsal calls fly_in")]
pub(crate) fn fly(
    project: &str,
    seed: u64,
    limit_s: f64,
    watch: impl FnMut(f64, &Race, DVec3, &RgbdImage),
) -> Outcome {
    let project = CourseProject::named(project).expect("a project of the course");
    fly_in(project.generate(seed, Level::Ug, Variant::DAY), seed, limit_s, watch)
}

/// As [`fly`], in any scene. Its splats may differ from its true geometry.
pub(crate) fn fly_in(
    mut generated: Generated,
    seed: u64,
    limit_s: f64,
    mut watch: impl FnMut(f64, &Race, DVec3, &RgbdImage),
) -> Outcome {
    let movers = MovingObjects::new(&generated.arena, seed);
    generated.truth.retain(is_near);
    let scene = Scene { splats: &generated.splats, objects: &generated.objects };
    let mut renderer = CpuRenderer::new(scene);
    let mut images = [RgbdImage::default()];

    let arena = generated.arena.info();
    let mut plugin = Race::default();
    plugin.on_start(&arena);
    let mut buffer = ObservationBuffer::new(&arena.cameras);
    let spawn_m = generated.arena.spawn.position_m + DVec3::Z * 0.08;
    let mut quad = Quadrotor::at_rest(spawn_m);
    let mut pending: VecDeque<(f64, Setpoint)> = VecDeque::new();
    let mut setpoint = Setpoint::Hold;
    let mut climbing = true;
    let (mut rgb, mut depth_mm) = (Vec::new(), Vec::new());
    let of_stages = generated.arena.stages.len();
    let mut outcome = Outcome {
        stages: 0,
        of_stages,
        collided: false,
        seconds: 0.0,
        end_m: spawn_m,
        least_m: f64::INFINITY,
        drift_m: 0.0,
    };
    for tick in 0..(limit_s / vehicle::DT_S) as u64 {
        let now_s = tick as f64 * vehicle::DT_S;
        if tick % IMAGE_TICKS == 0 {
            let front = &arena.cameras[0];
            let camera =
                Camera::new(front.intrinsics, quad.world_from_body() * front.body_from_cam, 0.05);
            let placements = movers.placements(ns(now_s));
            renderer
                .render(&placements, std::slice::from_ref(&camera), &mut images)
                .expect("it renders");
            images[0].write_rgb8(&mut rgb);
            images[0].write_depth_mm(DepthKind::Median, &mut depth_mm);
            buffer.clear(tick / IMAGE_TICKS);
            buffer.set_vehicle(&Vehicle {
                world_from_body: None,
                v_world_mps: None,
                attitude: quad.estimated_attitude(now_s),
                ..quad.vehicle()
            });
            let stamps =
                ImageStamps { seq: tick, pose: quad.stamp, ready: quad.stamp, ahead_ns: 0 };
            buffer.set_image(0, stamps, |planes| {
                planes.rgb.copy_from_slice(&rgb);
                planes.depth_mm.copy_from_slice(&depth_mm);
            });
            if let Some(answer) = plugin.on_image(&buffer.observation()) {
                assert_eq!(answer.check(), Ok(()), "{answer:?}");
                pending.push_back((now_s + SETPOINT_DELAY_S, answer));
            }
            let own_m =
                camera.world_from_cam.translation_m - DVec3::new(spawn_m.x + 0.06, spawn_m.y, 0.0);
            outcome.drift_m = outcome.drift_m.max(plugin.here_m().distance(own_m));
            watch(now_s, &plugin, own_m, &images[0]);
        }
        while pending.front().is_some_and(|&(at_s, _)| at_s <= now_s) {
            setpoint = pending.pop_front().expect("there is one").1;
        }
        let before_m = quad.p_m;
        climbing &= quad.p_m.z < arena.takeoff_height_m;
        if climbing {
            quad.advance(&Setpoint::velocity(DVec3::Z * 0.8, YawTarget::Keep), tick);
        } else {
            quad.advance(&setpoint, tick);
        }
        outcome.seconds = now_s;
        outcome.end_m = quad.p_m;
        let still_m = least_m(&generated.truth, quad.p_m);
        let placements = movers.placements(ns(now_s));
        let moving_m = placements.iter().zip(&generated.true_objects).map(|(placement, solids)| {
            let in_object = |place: &Pose<World, Object>| place.inverse().transform_point(quad.p_m);
            placement.as_ref().map_or(f64::INFINITY, |place| least_m(solids, in_object(place)))
        });
        let clearance_m = moving_m.fold(still_m, f64::min) - arena.body_radius_m;
        if !climbing {
            outcome.least_m = outcome.least_m.min(clearance_m);
            outcome.collided = clearance_m < 0.0;
        }
        if let Some(stage) = generated.arena.stages.get(outcome.stages) {
            let across = stage.normal.cross(DVec3::Z);
            let (from, to) = (before_m - stage.center_m, quad.p_m - stage.center_m);
            let crossed = stage.normal.dot(from) < 0.0 && stage.normal.dot(to) >= 0.0;
            if crossed
                && to.dot(across).abs() < stage.width_m / 2.0
                && to.z.abs() < stage.height_m / 2.0
            {
                outcome.stages += 1;
            }
        }
        if outcome.collided || outcome.stages == of_stages {
            break;
        }
    }
    outcome
}

/// Returns whether a volume is inside the net.
fn is_near(volume: &Volume) -> bool {
    match volume {
        Volume::Cuboid { center_m, .. } => {
            (0.0..11.0).contains(&center_m.x) && center_m.y.abs() < 2.3 && center_m.z < 3.6
        }
        _ => true,
    }
}

/// Returns the distance from a point to the nearest solid. [m]
fn least_m(solids: &[Volume], p_m: DVec3) -> f64 {
    solids.iter().map(|solid| solid.signed_distance_m(p_m)).fold(f64::INFINITY, f64::min)
}

fn ns(seconds: f64) -> i64 {
    (seconds * 1e9).round() as i64
}

/// Ticks per image, for 25 Hz.
const IMAGE_TICKS: u64 = 16;
/// Delay from an image's instant to the effect of its setpoint: rendering, link, MAVLink. [s]
const SETPOINT_DELAY_S: f64 = 0.06;
