//! `vizflyt arena edit`'s page: the view, with a panel that sets up a course in the twin.
//!
//! ```text
//! GET  /course.js, /course_items.js, /course.css    the panel, and what is dragged in the picture
//! POST /api/course        Order -> Report: what speaks against the course, and how long its way is
//! ```
//! The page holds the course, with what can be taken back; here it is put into the arena, shown and checked: what moves or
//! stands in a frame of its own is drawn by the renderer, as flights see it. Writing is the caller's ([`CourseFile`]): this crate
//! changes no arena's file. Only a browser on this computer, on a page of ours, may order.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use anyhow::{Context, Result};
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{ConnectInfo, DefaultBodyLimit, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use serde::{Deserialize, Serialize};
use vizflyt_arena::check::{Checked, Finding, check};
use vizflyt_arena::config::{ConfigError, Geofence, Goal, NoFly, ObjectConfig, Spawn, StageConfig};
use vizflyt_arena::objects::MovingObjects;
use vizflyt_arena::obstacles::Obstacles;
use vizflyt_arena::{ArenaConfig, DistanceField};
use vizflyt_splat::{Chosen, Rasterizer, RigidObject, Splats};

use super::align::Line;
use super::args::ViewArgs;
use super::engine::Engine;
use crate::render::choose;
use crate::scene::{self, Scene, Seen};
use crate::web::http::{file, ordered_here};
use vizflyt_process::lock;

/// The file that a course is written to.
pub trait CourseFile: Send + Sync {
    /// Writes the course of an arena into its file, and what it names of `models`; returns what was done, in words.
    ///
    /// # Errors
    /// Why nothing was written.
    fn save(&self, course: &Course, models: &[(PathBuf, Arc<Splats>)]) -> Result<Vec<Line>>;
}

/// What of an arena is set up on the page.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Course {
    /// Where flights begin.
    pub spawn: Spawn,
    /// Height above the spawn to which the vehicle climbs first. [m]
    pub takeoff_height_m: f64,
    /// Where they shall end.
    pub goal: Option<Goal>,
    /// The fence.
    pub geofence: Geofence,
    /// Boxes to stay out of.
    pub no_fly: Vec<NoFly>,
    /// Gates, in order.
    pub stages: Vec<StageConfig>,
    /// What stands or moves in frames of its own.
    pub objects: Vec<ObjectConfig>,
}

impl Course {
    /// Returns the course of an arena.
    pub fn of(arena: &ArenaConfig) -> Self {
        let ArenaConfig { spawn, takeoff_height_m, goal, geofence, .. } = *arena;
        let (no_fly, stages) = (arena.no_fly.clone(), arena.stages.clone());
        let objects = arena.objects.clone();
        Self { spawn, takeoff_height_m, goal, geofence, no_fly, stages, objects }
    }

    fn put_into(self, arena: &mut ArenaConfig) {
        let Self { spawn, takeoff_height_m, goal, geofence, no_fly, stages, objects } = self;
        *arena = ArenaConfig {
            spawn,
            takeoff_height_m,
            goal,
            geofence,
            no_fly,
            stages,
            objects,
            ..arena.clone()
        };
    }
}

/// The panel's part of the view's state.
pub(super) struct Panel {
    engine: Arc<Mutex<Engine>>,
    session: Mutex<Session>,
}

/// An arena whose course is set up.
struct Session {
    /// With the course as it is shown.
    arena: ArenaConfig,
    on_file: Course,
    folder: PathBuf,
    splats: Splats,
    seen: Option<Seen>,
    file: Arc<dyn CourseFile>,
    args: ViewArgs,
    /// What was baked of the scene, for this fence.
    still: Option<(Geofence, Arc<DistanceField>)>,
    /// By the file that `scene` names.
    models: HashMap<String, Model>,
    /// What the renderer draws.
    drawn: Vec<String>,
}

/// An object's splats, and what was baked of them.
#[derive(Clone)]
struct Model {
    splats: Arc<Splats>,
    field: Arc<DistanceField>,
    is_written: bool,
}

/// What the page asks for.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Order {
    /// The course as the file has it.
    Open,
    /// Shows a course and looks at it.
    Look(Box<Course>),
    /// Writes it into the file.
    Save(Box<Course>),
}

/// What the page shows.
#[derive(Debug, Serialize)]
struct CourseState {
    /// Answers [`Order::Open`].
    course: Option<Course>,
    name: String,
    body_radius_m: f64,
    floor_z_m: f64,
    findings: Vec<Found>,
    /// 0 where the way was not looked for. [m]
    way_m: f64,
    /// Nothing without gates. [m]
    least_room_m: Option<f64>,
    said: Vec<Line>,
}

#[derive(Debug, Serialize)]
struct Found {
    key: String,
    text: String,
}

impl From<Finding> for Found {
    fn from(Finding { key, text }: Finding) -> Self {
        Self { key, text }
    }
}

impl Panel {
    /// Takes a scene whose objects are drawn already.
    pub(super) fn new(
        engine: Arc<Mutex<Engine>>,
        scene: Scene,
        file: Arc<dyn CourseFile>,
        args: ViewArgs,
    ) -> Self {
        let Scene { arena, splats, objects, seen, .. } = scene;
        let toml = &args.scene;
        let folder = if toml.is_dir() { Some(&**toml) } else { toml.parent() };
        let folder = folder.unwrap_or(Path::new("")).to_owned();
        let mut models = HashMap::new();
        for (config, RigidObject { splats, .. }) in arena.objects.iter().zip(objects) {
            let field = Arc::new(scene::bake_object(&splats, &arena));
            let splats = Arc::new(splats);
            models.insert(config.scene.clone(), Model { splats, field, is_written: true });
        }
        let drawn = arena.objects.iter().map(|object| object.scene.clone()).collect();
        let (on_file, still) = (Course::of(&arena), None);
        let session =
            Session { arena, on_file, folder, splats, seen, file, args, still, models, drawn };
        Self { engine, session: Mutex::new(session) }
    }
}

impl Session {
    /// Puts a course into the arena, if it can be one, with what its objects are.
    fn take(&mut self, course: Course) -> Result<(), Vec<Found>> {
        let mut arena = self.arena.clone();
        course.put_into(&mut arena);
        arena.validate().map_err(refusals)?;
        for (index, object) in arena.objects.iter().enumerate() {
            if let Err(error) = self.add_model(&object.scene, &arena) {
                let (key, text) = (format!("objects[{index}].scene"), format!("{error:#}"));
                return Err(vec![Found { key, text }]);
            }
        }
        // Of those that were dragged through, none is kept.
        let is_used = |file: &str| arena.objects.iter().any(|object| object.scene == file);
        self.models.retain(|file, model| model.is_written || is_used(file));
        self.arena = arena;
        Ok(())
    }

    fn add_model(&mut self, file: &str, arena: &ArenaConfig) -> Result<()> {
        if self.models.contains_key(file) {
            return Ok(());
        }
        let path = self.folder.join(file);
        let (splats, is_written) = if path.exists() {
            (scene::read_splats(&path)?, true)
        } else {
            let built = scene::model(file).with_context(|| {
                format!(
                    "there is no {}, and it is none of the models that the page has",
                    path.display()
                )
            })?;
            (built, false)
        };
        let field = Arc::new(scene::bake_object(&splats, arena));
        self.models.insert(file.to_owned(), Model { splats: Arc::new(splats), field, is_written });
        Ok(())
    }

    fn model(&self, object: &ObjectConfig) -> &Model {
        &self.models[&object.scene]
    }

    /// Returns a renderer with the objects of the arena, if it must be another than before.
    fn renderer(&mut self) -> Result<Option<Box<dyn Rasterizer>>> {
        let wanted: Vec<_> = self.arena.objects.iter().map(|object| object.scene.clone()).collect();
        if wanted == self.drawn {
            return Ok(None);
        }
        let numbered = self.arena.objects.iter().zip(1..);
        let objects: Vec<_> = numbered
            .map(|(object, id)| RigidObject { id, splats: (*self.model(object).splats).clone() })
            .collect();
        let twin = vizflyt_splat::Scene { splats: &self.splats, objects: &objects };
        let Chosen { rasterizer, .. } = choose(twin, self.args.renderer, self.args.detail)?;
        self.drawn = wanted;
        Ok(Some(rasterizer))
    }

    fn look(&mut self) -> Checked {
        let still = match &self.still {
            Some((fence, still)) if *fence == self.arena.geofence => still.clone(),
            _ => {
                let baked = Arc::new(scene::bake(&self.splats, &self.arena, self.seen.as_ref()));
                self.still = Some((self.arena.geofence, baked.clone()));
                baked
            }
        };
        let fields = self.arena.objects.iter().map(|object| self.model(object).field.clone());
        let moving = MovingObjects::new(&self.arena, self.args.seed);
        let obstacles = Obstacles::new(still.clone(), fields.collect(), moving);
        let mut checked = check(&self.arena, &obstacles);
        let fit = scene::check_fit(&self.splats, &self.arena, &still);
        checked.findings.splice(0..0, fit);
        checked
    }

    fn save(&mut self) -> Result<Vec<Line>> {
        let named: Vec<_> = self.arena.objects.iter().map(|object| object.scene.clone()).collect();
        let is_new = |file: &String| self.models.get(file).is_some_and(|model| !model.is_written);
        let mut new: Vec<_> = named.into_iter().filter(is_new).collect();
        new.sort();
        new.dedup();
        let with_path = |file: &String| (self.folder.join(file), self.models[file].splats.clone());
        let models: Vec<_> = new.iter().map(with_path).collect();
        let course = Course::of(&self.arena);
        let said = self.file.save(&course, &models)?;
        self.on_file = course;
        for file in new {
            if let Some(model) = self.models.get_mut(&file) {
                model.is_written = true;
            }
        }
        Ok(said)
    }

    fn report(&self, findings: Vec<Found>) -> CourseState {
        CourseState {
            course: None,
            name: self.arena.name.clone(),
            body_radius_m: self.arena.body_radius_m,
            floor_z_m: self.arena.occupancy.floor_z_m,
            findings,
            way_m: 0.0,
            least_room_m: None,
            said: Vec::new(),
        }
    }
}

/// Returns why an arena is none, by key.
fn refusals(error: ConfigError) -> Vec<Found> {
    match error {
        ConfigError::Several(errors) => errors.into_iter().flat_map(refusals).collect(),
        ConfigError::Invalid { key, value, advice, .. } => {
            vec![Found { key, text: format!("{value}: {advice}") }]
        }
        other => vec![Found { key: String::new(), text: other.to_string() }],
    }
}

/// The panel's files and orders.
pub(super) fn routes(panel: Panel) -> Router {
    const SCRIPT: &str = "text/javascript; charset=utf-8";
    Router::new()
        .route("/course.js", get(async || file(SCRIPT, include_str!("../page/course.js"))))
        .route(
            "/course_items.js",
            get(async || file(SCRIPT, include_str!("../page/course_items.js"))),
        )
        .route(
            "/course.css",
            get(async || file("text/css; charset=utf-8", include_str!("../page/course.css"))),
        )
        .route("/api/course", post(obey))
        .layer(DefaultBodyLimit::max(MAX_ORDER))
        .with_state(Arc::new(panel))
}

async fn obey(
    State(panel): State<Arc<Panel>>,
    ConnectInfo(from): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    const WHY: &str = "only a browser on this computer may set up a course; open the page here, or through ssh -L";
    let order = match ordered_here(from, WHY, &headers, body) {
        Ok(order) => order,
        Err(refusal) => return *refusal,
    };
    match tokio::task::spawn_blocking(move || carry_out(&panel, order)).await {
        Ok(Ok(report)) => Json(report).into_response(),
        Ok(Err(error)) => (StatusCode::CONFLICT, format!("{error:#}")).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

fn carry_out(panel: &Panel, order: Order) -> Result<CourseState> {
    let mut session = lock(&panel.session);
    let (course, opens, saves) = match order {
        Order::Open => (session.on_file.clone(), true, false),
        Order::Look(course) => (*course, false, false),
        Order::Save(course) => (*course, false, true),
    };
    if let Err(findings) = session.take(course) {
        return Ok(session.report(findings));
    }
    let renderer = session.renderer()?;
    let moving = MovingObjects::new(&session.arena, session.args.seed);
    lock(&panel.engine).set_objects(renderer, moving);
    let Checked { findings, way_m, least_room_m } = session.look();
    let said = if saves { session.save()? } else { Vec::new() };
    let report = session.report(findings.into_iter().map(Found::from).collect());
    let course = opens.then(|| session.on_file.clone());
    let least_room_m = least_room_m.is_finite().then_some(least_room_m);
    Ok(CourseState { course, way_m, least_room_m, said, ..report })
}

/// An arena has at most 255 gates of 128 corners; a person's has a tenth of it.
const MAX_ORDER: usize = 512 << 10;

#[cfg(test)]
mod tests;
