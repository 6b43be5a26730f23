//! `vizflyt scene view`: a page with a free-flying camera in a scene.
//!
//! ```text
//! GET /     page; requests images of its camera over /ws, one at a time
//! GET /ws   in: Request (JSON); out: the image's description (JSON), then the image (JPEG)
//! ```
//! The server renders only on request. A page requests an image only after its camera has moved and the previous image
//! has arrived, so it always gets the newest view, even from a slow computer. One renderer serves all viewers in turn.

pub(crate) mod align;
mod args;
pub(crate) mod course;
mod edit;
mod engine;
mod pick;
mod place;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use anyhow::{Context, Result};
use axum::Router;
use axum::body::Bytes;
use axum::extract::ws::{Message, WebSocket, rejection::WebSocketUpgradeRejection};
use axum::extract::{State, WebSocketUpgrade};
use axum::http::HeaderMap;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use serde::Serialize;
use tokio::time::timeout;
use tracing::debug;
use vizflyt_arena::objects::MovingObjects;
use vizflyt_splat::Chosen;

use self::align::{Aligner, Setup};
pub use self::args::ViewArgs;
use self::course::CourseFile;
use self::edit::Session;
use self::engine::{Engine, Picture, Request};
pub use self::place::Place;
use crate::render::{RendererInfo, choose};
use crate::scene::{self, Editor, Placement, Scene};
use crate::stop::Stop;
use crate::web::http::{ICON, file, refuse};
use crate::web::{https, listener, origin};
use vizflyt_process::lock;

/// Serves the page until SIGINT or SIGTERM; calls `open` with its address when it is ready.
///
/// # Errors
/// If the scene cannot be used, the address cannot be bound, or the renderer is not available.
#[allow(clippy::needless_pass_by_value)] // Why: a command consumes its arguments.
pub fn view(args: ViewArgs, open: impl FnOnce(&str, &RendererInfo)) -> Result<()> {
    serve_view(&args, None, open)
}

/// Task of the page, in addition to viewing.
#[allow(clippy::large_enum_variant)] // Why: there is one of it, for a moment.
enum Work {
    Align(Arc<dyn Aligner>),
    Course(Arc<dyn CourseFile>),
    /// Edits the scene; saves to the path.
    Edit(Editor, PathBuf),
}

/// As [`view`], with the panel that aligns the arena's scene.
///
/// # Errors
/// As [`view`].
#[allow(clippy::needless_pass_by_value)] // Why: a command consumes its arguments.
pub fn align(
    args: ViewArgs,
    aligner: Arc<dyn Aligner>,
    open: impl FnOnce(&str, &RendererInfo),
) -> Result<()> {
    serve_view(&args, Some(Work::Align(aligner)), open)
}

/// As [`view`], with the panel that sets up the arena's course.
///
/// # Errors
/// As [`view`].
#[allow(clippy::needless_pass_by_value)] // Why: a command consumes its arguments.
pub fn set_up(
    args: ViewArgs,
    file: Arc<dyn CourseFile>,
    open: impl FnOnce(&str, &RendererInfo),
) -> Result<()> {
    serve_view(&args, Some(Work::Course(file)), open)
}

/// As [`view`], with the panel that edits the scene; it is saved to `output`.
///
/// # Errors
/// As [`view`].
#[allow(clippy::needless_pass_by_value)] // Why: a command consumes its arguments.
pub fn edit(
    args: ViewArgs,
    editor: Editor,
    output: PathBuf,
    open: impl FnOnce(&str, &RendererInfo),
) -> Result<()> {
    serve_view(&args, Some(Work::Edit(editor, output)), open)
}

fn serve_view(
    args: &ViewArgs,
    work: Option<Work>,
    open: impl FnOnce(&str, &RendererInfo),
) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("net")
        .enable_all()
        .build()
        .context("cannot start tokio")?;
    let result = runtime.block_on(run(args, work, open));
    // Not awaited: a running render must not delay the exit.
    runtime.shutdown_background();
    result
}

/// Shared state of the handlers.
struct ViewState {
    engine: Arc<Mutex<Engine>>,
    welcome: Welcome,
    stop: Stop,
}

/// First message to each page.
#[derive(Debug, Serialize)]
struct Welcome {
    name: String,
    renderer: RendererInfo,
    splats: usize,
    /// Initial position of the camera. [m, world]
    start_m: [f64; 3],
    /// Initial heading of the camera. [rad, world]
    yaw_rad: f64,
    /// Fence of the arena. [m, world]
    fence_m: [[f64; 3]; 2],
    /// Number of moving objects.
    objects: usize,
    /// Script that extends the page.
    tool: Option<&'static str>,
}

async fn run(
    args: &ViewArgs,
    work: Option<Work>,
    open: impl FnOnce(&str, &RendererInfo),
) -> Result<()> {
    let stop = Stop::default();
    stop.on_signals(false)?;
    // Before loading the scene, so that a used port is reported immediately.
    https::check_plain(args.http, true)?;
    let listener = listener::bind(args.http)?;
    let url = format!("http://{}", listener.local_addr().context("the page has no address")?);
    let loading = args.clone();
    let load = tokio::task::spawn_blocking(move || prepare(&loading, work));
    let (engine, welcome, panel) = tokio::select! {
        prepared = load => prepared.context("loading the scene failed")??,
        () = stop.wait() => return Ok(()),
    };
    open(&url, &welcome.renderer);
    let view = Arc::new(ViewState { engine, welcome, stop: stop.clone() });
    let router = router(view).merge(panel).into_make_service_with_connect_info::<SocketAddr>();
    tokio::select! {
        served = axum::serve(listener, router) => served.context("the page's server failed"),
        () = stop.wait() => Ok(()),
    }
}

/// Returns the engine, the first message, and the routes of the panel, if there is one.
fn prepare(args: &ViewArgs, work: Option<Work>) -> Result<(Arc<Mutex<Engine>>, Welcome, Router)> {
    let scene = match &work {
        Some(Work::Edit(editor, _)) => {
            scene::load_with(&args.scene, &args.bare, editor.splats().clone())
        }
        _ => scene::load(&args.scene, &args.bare),
    };
    let mut scene = scene?;
    if let Some(Work::Align(_)) = work {
        // Moving objects belong to the room, not to the scene, and must not move with it.
        scene.arena.objects.clear();
        scene.objects.clear();
    }
    args.antialiased.apply(&mut scene.splats);
    let Scene { arena, splats, objects, world_from_scene, .. } = &scene;
    let twin = vizflyt_splat::Scene { splats, objects };
    let Chosen { rasterizer, reason } = choose(twin, args.renderer, args.detail)?;
    let moving = MovingObjects::new(arena, args.seed);
    let placement = Placement::of(&arena.scene);
    let world_from_file = placement.world_from_scene;
    let setup = Setup::new(arena, Place::new(&world_from_file));
    let mut start_m = arena.spawn.position_m;
    start_m.z += arena.takeoff_height_m;
    let welcome = Welcome {
        name: arena.name.clone(),
        renderer: RendererInfo { name: rasterizer.name().into_owned(), reason },
        splats: splats.len(),
        start_m: start_m.to_array(),
        yaw_rad: arena.spawn.yaw_deg.to_radians(),
        fence_m: [arena.geofence.min_m.to_array(), arena.geofence.max_m.to_array()],
        objects: moving.len(),
        tool: work.as_ref().map(|work| match work {
            Work::Align(_) => "/align.js",
            Work::Course(_) => "/course.js",
            Work::Edit(..) => "/edit.js",
        }),
    };
    let engine = Engine::new(rasterizer, moving, *world_from_scene, world_from_file);
    let engine = Arc::new(Mutex::new(engine));
    let routes = match work {
        None => Router::new(),
        Some(Work::Align(aligner)) => {
            align::routes(align::Panel { engine: engine.clone(), aligner, setup })
        }
        Some(Work::Course(file)) => {
            course::routes(course::Panel::new(engine.clone(), scene, file, args.clone()))
        }
        Some(Work::Edit(editor, output)) => {
            let session = Session::new(editor, output, args.clone(), placement, scene.objects)?;
            edit::routes(edit::Panel { engine: engine.clone(), session: Mutex::new(session) })
        }
    };
    Ok((engine, welcome, routes))
}

fn router(view: Arc<ViewState>) -> Router {
    Router::new()
        .route("/", get(async || file("text/html; charset=utf-8", INDEX)))
        .route("/view.css", get(async || file("text/css; charset=utf-8", STYLE)))
        .route("/view.js", get(async || file("text/javascript; charset=utf-8", SCRIPT)))
        .route("/icon.svg", get(async || file("image/svg+xml", ICON)))
        .route("/ws", get(watch))
        .route("/panel.css", get(async || file("text/css; charset=utf-8", PANEL_STYLE)))
        .route("/overlay.js", get(async || file("text/javascript; charset=utf-8", OVERLAY)))
        .with_state(view)
}

async fn watch(
    State(view): State<Arc<ViewState>>,
    headers: HeaderMap,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    match upgrade {
        Ok(upgrade) => upgrade
            .max_message_size(4096)
            .on_upgrade(async move |socket| serve_socket(view, socket).await),
        Err(rejection) => rejection.into_response(),
    }
}

async fn serve_socket(view: Arc<ViewState>, mut socket: WebSocket) {
    tokio::select! {
        _ = serve_requests(&view, &mut socket) => {}
        () = view.stop.wait() => {}
    }
    let _ = timeout(Duration::from_millis(200), socket.send(Message::Close(None))).await;
}

/// Returns `None` when the page is gone.
async fn serve_requests(view: &Arc<ViewState>, socket: &mut WebSocket) -> Option<()> {
    send_json(socket, &view.welcome).await?;
    loop {
        let request: Request = match socket.recv().await?.ok()? {
            Message::Text(text) => match serde_json::from_str(&text) {
                Ok(request) => request,
                Err(error) => {
                    send_json(socket, &serde_json::json!({"error": error.to_string()})).await?;
                    continue;
                }
            },
            Message::Close(_) => return None,
            _ => continue,
        };
        let rendering = view.clone();
        let picture = tokio::task::spawn_blocking(move || lock(&rendering.engine).render(&request));
        match picture.await.ok()? {
            Ok(Picture { info, jpeg }) => {
                send_json(socket, &info).await?;
                send(socket, Message::Binary(Bytes::from(jpeg))).await?;
            }
            Err(error) => {
                debug!("view: {error:#}");
                send_json(socket, &serde_json::json!({"error": format!("{error:#}")})).await?;
            }
        }
    }
}

async fn send_json(socket: &mut WebSocket, message: &impl Serialize) -> Option<()> {
    send(socket, Message::Text(serde_json::to_string(message).ok()?.into())).await
}

async fn send(socket: &mut WebSocket, message: Message) -> Option<()> {
    timeout(PATIENCE, socket.send(message)).await.ok()?.ok()
}

const INDEX: &str = include_str!("page/view.html");
const STYLE: &str = include_str!("page/view.css");
const SCRIPT: &str = include_str!("page/view.js");
const PANEL_STYLE: &str = include_str!("page/panel.css");
const OVERLAY: &str = include_str!("page/overlay.js");
/// Timeout of a page that reads nothing.
const PATIENCE: Duration = Duration::from_secs(10);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_id_of_the_script_is_on_the_page() {
        let ids: Vec<_> =
            SCRIPT.split("$(\"").skip(1).filter_map(|part| part.split('"').next()).collect();
        assert!(ids.len() > 8);
        for id in ids {
            assert!(INDEX.contains(&format!("id=\"{id}\"")), "{id}");
        }
        assert!(INDEX.contains("/view.css") && INDEX.contains("/view.js"));
        // The content security policy forbids both.
        assert!(!INDEX.contains("style=") && !INDEX.contains("onclick="));
    }
}
