//! Page of `vizflyt arena edit`: the view, with a panel that sets up a course in the twin.
//!
//! ```text
//! GET  /course.js, /course_items.js, /course.css    panel, and items that are dragged in the image
//! POST /api/course        Order -> CourseState: findings about the course, and the length of its path
//! ```
//! The page stores the course and its undo history. The server inserts the course into the arena, shows and checks it;
//! the renderer draws objects as in flights. The caller writes the file ([`CourseFile`]), because this crate changes no
//! arena file. Only this server's page, in a browser on this computer, may send requests.

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

/// The file to which a course is written.
pub trait CourseFile: Send + Sync {
    /// Writes the course of an arena into its file, and the files of `models` that it uses; returns the report.
    ///
    /// # Errors
    /// If nothing was written.
    fn save(&self, course: &Course, models: &[(PathBuf, Arc<Splats>)]) -> Result<Vec<Line>>;
}

/// The parts of an arena that are set up on the page.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Course {
    /// Start of flights.
    pub spawn: Spawn,
    /// Height above the spawn to which the vehicle climbs first. [m]
    pub takeoff_height_m: f64,
    /// End of flights.
    pub goal: Option<Goal>,
    pub geofence: Geofence,
    /// Boxes that the vehicle must not enter.
    pub no_fly: Vec<NoFly>,
    /// Stages, in order.
    pub stages: Vec<StageConfig>,
    /// Objects, fixed or moving, each in its own frame.
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

/// Arena and course that are being set up.
struct Session {
    /// The arena with the shown course.
    arena: ArenaConfig,
    on_file: Course,
    folder: PathBuf,
    splats: Splats,
    seen: Option<Seen>,
    file: Arc<dyn CourseFile>,
    args: ViewArgs,
    /// Distance field of the scene without objects, for this fence.
    still: Option<(Geofence, Arc<DistanceField>)>,
    /// Models by the file name of their `scene`.
    models: HashMap<String, Model>,
    /// Files of the objects that the renderer draws.
    drawn: Vec<String>,
}

/// Splats and distance field of an object.
#[derive(Clone)]
struct Model {
    splats: Arc<Splats>,
    field: Arc<DistanceField>,
    is_written: bool,
}

/// Request of the page.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Order {
    /// Returns the course of the file.
    Open,
    /// Shows and checks a course.
    Look(Box<Course>),
    /// Writes a course into the file.
    Save(Box<Course>),
}

/// State that the page shows.
#[derive(Debug, Serialize)]
struct CourseState {
    /// Answer to [`Order::Open`].
    course: Option<Course>,
    name: String,
    body_radius_m: f64,
    floor_z_m: f64,
    findings: Vec<Found>,
    /// Length of the path; 0 if it was not computed. [m]
    way_m: f64,
    /// Smallest clearance in a stage; `None` without stages. [m]
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
    /// Creates the panel of a scene whose objects the renderer draws already.
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
    /// Inserts a valid course into the arena, and loads the models of its objects.
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
        // Drop unsaved models that are no longer used.
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
                format!("{} does not exist, and the page has no model of this name", path.display())
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

    /// Returns a renderer for the arena's objects, if they have changed.
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

/// Returns the reasons for which an arena is invalid, by key.
fn refusals(error: ConfigError) -> Vec<Found> {
    match error {
        ConfigError::Several(errors) => errors.into_iter().flat_map(refusals).collect(),
        ConfigError::Invalid { key, value, advice, .. } => {
            vec![Found { key, text: format!("{value}: {advice}") }]
        }
        other => vec![Found { key: String::new(), text: other.to_string() }],
    }
}

/// Returns the routes of the panel.
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

/// Maximum request. An arena has at most 255 stages of 128 corners; a typical one a tenth of that.
const MAX_ORDER: usize = 512 << 10;

#[cfg(test)]
mod tests;
