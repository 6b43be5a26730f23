//! Loading of a scene: renderer, referees, moving objects, top view.

use std::sync::Arc;

use anyhow::{Result, bail};
use tracing::warn;
use vizflyt_arena::{ArenaConfig, DistanceField, Referee};
use vizflyt_splat::sensor::SensorScene;
use vizflyt_splat::{Chosen, Loading, Scene as RenderedScene};

use crate::args::ServeArgs;
use crate::clock;
use crate::render::dynamic_objects::{DynamicObjects, vehicle_models};
use crate::render::sensors::SensorSet;
use crate::render::{choose, open_packed};
use crate::scene::{self, Antialiased, Scene};
use crate::web::top_view::TopView;
use crate::web::twin::TwinParts;

/// Everything created from the scene.
pub(super) struct LoadedScene {
    pub(super) arena: ArenaConfig,
    pub(super) renderer: Chosen,
    /// Name and arena of each vehicle.
    pub(super) flying: Vec<(String, ArenaConfig)>,
    pub(super) referees: Vec<Referee>,
    pub(super) dynamic_objects: DynamicObjects,
    /// Sensors of each vehicle, without the cameras.
    pub(super) sensors: Vec<SensorSet>,
    /// Scene for the sensors; `None` if there are none.
    pub(super) sensor_scene: Option<SensorScene>,
    /// Whether the vehicles see and collide with each other.
    pub(super) neighbours: bool,
    pub(super) top_view: TopView,
    pub(super) twin: TwinParts,
    /// Distances to static obstacles.
    pub(super) field: Arc<DistanceField>,
}

/// Loads the scene and creates everything from it.
///
/// # Errors
/// A scene or an arena that cannot be used, or an unavailable renderer.
pub(super) fn prepare(args: &ServeArgs) -> Result<LoadedScene> {
    let scene = scene::load_to_fly(&args.arena, &args.bare)?;
    let Scene { arena, mut splats, mut objects, seen, packed, .. } = scene;
    if packed.is_some() && args.antialiased != Antialiased::default() {
        bail!("--antialiased: a packed scene is drawn as the one that it was packed of");
    }
    args.antialiased.apply(&mut splats);
    let flying: Vec<_> = arena
        .flying(&args.vehicles)?
        .iter()
        .map(|vehicle| (vehicle.name.clone(), arena.of_vehicle(vehicle)))
        .collect();
    let sensors = flying.iter().map(|(_, arena)| SensorSet::new(&arena.sensors));
    let sensors = sensors.collect::<Result<Vec<_>, _>>()?;
    let together = if args.apart { 0 } else { flying.len() };
    let still = objects.len();
    objects.extend(vehicle_models(together));
    let rendered = RenderedScene { splats: &splats, objects: &objects };
    let (renderer, (field, obstacles, top_view)) = rayon::join(
        // Most of the time is spent in graphics drivers.
        || match &packed {
            None => choose(rendered, args.renderer, args.detail),
            Some(path) => {
                let memory_bytes = args.scene_memory as usize * (1 << 20);
                open_packed(path, &objects, args.renderer, memory_bytes, Loading::Live).map(
                    |renderer| Chosen {
                        rasterizer: Box::new(renderer),
                        reason: "the scene is packed".to_owned(),
                    },
                )
            }
        },
        || {
            let field = Arc::new(scene::bake(&splats, &arena, seen.as_ref()));
            for finding in scene::check_fit(&splats, &arena, &field) {
                warn!("{finding}");
            }
            let obstacles = scene::obstacles(&arena, &objects[..still], field.clone(), args.seed);
            let top_view = TopView::render(&splats, &arena, &field);
            (field, obstacles, top_view)
        },
    );
    let renderer = renderer?;
    let twin = TwinParts::choose(&splats, arena.geofence.min_m, arena.geofence.max_m);
    let has_sensors = sensors.iter().any(|set| !set.configs.is_empty());
    let sensor_scene = has_sensors.then(|| SensorScene::new(rendered));
    // The renderer holds its own form of the scene; the file's form is no longer needed.
    drop(splats);
    // Images and referees use the same epoch for moving objects.
    let epoch = clock::now();
    let dynamic_objects = DynamicObjects::new(epoch, obstacles.objects.clone(), &objects, together);
    let referees =
        flying.iter().map(|(_, arena)| Referee::new(arena, obstacles.clone()).counting_from(epoch));
    let (referees, neighbours) = (referees.collect(), together > 1);
    Ok(LoadedScene {
        arena,
        renderer,
        flying,
        referees,
        dynamic_objects,
        sensors,
        sensor_scene,
        neighbours,
        top_view,
        twin,
        field,
    })
}
