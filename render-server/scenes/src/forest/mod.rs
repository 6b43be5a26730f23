//! Forest: 40 m of trunks between start and goal.
//!
//! Data flow: [`site`] plans all objects and their true shapes. [`light`] computes the light at a point. [`ground`],
//! [`bark`], [`plants`] and [`backdrop`] paint lit patches on the true surfaces.

mod backdrop;
mod bark;
mod ground;
mod light;
mod plants;
mod site;

use glam::DVec3;
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::{
    CameraConfig, EnvironmentConfig, Geofence, Goal, Occupancy, RulesConfig, Spawn,
};
use vizflyt_arena::pose::PoseConfig;
use vizflyt_protocol::messages::Limits;

use crate::canvas::Canvas;
use crate::generated::Generated;
use crate::parts::{PartClass, Parts};
use crate::solids::Solids;
use crate::staging::{Stage, Staging};
use light::Light;
use site::{FENCE_Y_M, SPAWN_X_M, Site};

/// Returns the forest of a seed.
pub(crate) fn build(seed: u64) -> Generated {
    build_staged(seed, &mut Staging::none())
}

/// Returns the forest of a seed, staged for a capture.
pub(crate) fn build_staged(seed: u64, staging: &mut Staging) -> Generated {
    let layers: [Layer; 3] = [
        (PartClass::Ground, ground::paint_ground),
        (PartClass::Tree, bark::paint_wood),
        (PartClass::Plant, plants::paint_plants),
    ];
    build_layers(seed, &layers, staging)
}

/// Returns the forest with only its solid parts: without leaves, ferns and grass.
#[cfg(test)]
pub(crate) fn build_bare(seed: u64) -> Generated {
    let layers: [Layer; 2] =
        [(PartClass::Ground, ground::paint_ground), (PartClass::Tree, bark::paint_wood)];
    build_layers(seed, &layers, &mut Staging::none())
}

/// Class of the painted parts, and the function that paints them.
type Layer = (PartClass, fn(&mut Canvas, &Site, &Light));

fn build_layers(seed: u64, layers: &[Layer], staging: &mut Staging) -> Generated {
    let site = Site::plan(seed);
    let arena = arena(&site);
    let mut truth = site.truth();
    let stage = Stage {
        fence: &arena.geofence,
        // The forest is painted coarsely outside of the fence.
        around_m: -0.6,
        walls: &[],
        movers: &[],
        fence_is_kept_free: false,
    };
    staging.put_up(&mut truth, &stage);
    let solids = Solids::new(truth);
    let mut canvas = Canvas::default();
    let light = Light::new(&site, &solids);
    let mut parts = Parts::default();
    for (class, paint) in layers {
        paint(&mut canvas, &site, &light);
        parts.add(&canvas, *class, class.name());
    }
    backdrop::paint_backdrop(&mut canvas, &site);
    parts.add(&canvas, PartClass::Backdrop, PartClass::Backdrop.name());
    staging.paint(&mut canvas, &mut |p_m, normal, albedo| light.matt(p_m, normal, albedo));
    Generated {
        splats: canvas.finish(),
        parts: parts.finish(),
        arena,
        truth: solids.into_volumes(),
        objects: Vec::new(),
        true_objects: Vec::new(),
        map_is_known: false,
    }
}

fn arena(site: &Site) -> ArenaConfig {
    let spawn_m = DVec3::new(SPAWN_X_M, 0.0, 0.0);
    ArenaConfig {
        name: "forest".to_owned(),
        scene: "scene.ply".into(),
        body_radius_m: 0.12,
        takeoff_height_m: 1.2,
        time_limit_s: 60.0,
        ground_truth: true,
        attitude_rate: false,
        spawn: Spawn { position_m: spawn_m, yaw_deg: 0.0 },
        goal: Some(Goal { position_m: site.goal_m, radius_m: 1.0 }),
        geofence: Geofence {
            min_m: DVec3::new(-1.0, -FENCE_Y_M, -0.5),
            max_m: DVec3::new(41.0, FENCE_Y_M, 4.0),
        },
        limits: Limits::new(6.0, 8.0),
        body: Vec::new(),
        no_fly: Vec::new(),
        occupancy: Occupancy::default(),
        cameras: vec![front_camera()],
        environment: EnvironmentConfig::default(),
        pose: PoseConfig::default(),
        sensors: Vec::new(),
        vehicles: Vec::new(),
        localization: Vec::new(),
        stages: Vec::new(),
        objects: Vec::new(),
        rules: RulesConfig {
            start_box: Some(RulesConfig::start_box_about(spawn_m)),
            ..RulesConfig::default()
        },
    }
}

/// Returns the camera of all generated arenas: 320x240, horizontal field of view of 90 degrees, in the nose.
pub(crate) fn front_camera() -> CameraConfig {
    CameraConfig::ahead("front", [320, 240], 90.0, DVec3::new(0.06, 0.0, 0.02))
}
