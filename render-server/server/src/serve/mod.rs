//! Start and end of the server: creates all parts, prints when it is ready, and stops them in order.
//!
//! ```text
//! sockets -> load (scene, renderer, referees) -> rooms' states -> threads and tasks -> report
//! ```

mod load;
mod print;
mod threads;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use anyhow::{Context, Result};
use quinn::Endpoint;
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use tracing::warn;
use vizflyt_protocol::messages::Grant;
use vizflyt_trust::KeysFolder;

use self::load::{LoadedScene, prepare};
use self::print::{Ready, ReadySource, ReadyVehicle};
use crate::args::{RunStorage, ServeArgs};
use crate::authorization::Authorizer;
use crate::clock;
use crate::flights::leaderboard::{Database, Leaderboard};
use crate::flights::vehicle::VehicleFlight;
use crate::flights::{self, Flights};
use crate::poses::Localization;
use crate::poses::drivers::{self, Opened};
use crate::poses::settings::{self, Driver};
use crate::render::cameras::Cameras;
use crate::render::environment::Environment;
use crate::render::sensors::Sensors;
use crate::render::{RendererInfo, Rendering};
use crate::scene::Scenes;
use crate::stop::Stop;
use crate::stream::{Rooms, Streaming, transport};
use vizflyt_process::{descriptors, lock, print_fmt};

use crate::web::previews::Previews;
use crate::web::{self, Access, Lab, Logins, Page, PageTls, Rates, TwinPictures};

/// Runs the render server until SIGINT, SIGTERM or, with `--lifeline`, the end of stdin.
///
/// With `--json`, standard output has one JSON line when ready, one per event of the server, and one report at
/// the end. Without it, the same is printed as text.
///
/// # Errors
/// A scene or arena that cannot be used, or an address that cannot be bound.
#[allow(clippy::needless_pass_by_value)] // Why: a command consumes its arguments.
pub fn serve(args: ServeArgs) -> Result<()> {
    descriptors::raise_limit();
    let stop = Stop::default();
    let mut args = args;
    // Sets names for the threads, which would otherwise inherit the first user's. Fails only if the pool
    // already exists.
    let _ = rayon::ThreadPoolBuilder::new().thread_name(|i| format!("render-{i}")).build_global();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("net")
        .enable_all()
        .build()
        .context("cannot start tokio")?;
    let result = runtime.block_on(rounds(&mut args, &stop));
    stop.set();
    // Does not wait, because a task may be blocked in a system call.
    runtime.shutdown_background();
    result
}

/// Serves one scene after another, until the program ends.
async fn rounds(args: &mut ServeArgs, stop: &Stop) -> Result<()> {
    stop.on_signals(args.lifeline)?;
    let logins = Logins::new().map_err(anyhow::Error::msg)?;
    let mut former = None;
    loop {
        let scenes = Arc::new(Scenes::new(args.scenes.as_deref(), &args.arena));
        let round = run(args, &scenes, &logins, former.is_some(), &stop.child()).await;
        if stop.is_set() {
            return round;
        }
        match (round, scenes.take_chosen(), former.take()) {
            (Ok(()), Some(arena), _) => former = Some(std::mem::replace(&mut args.arena, arena)),
            // If the new scene cannot be loaded, the previous one is served again.
            (Err(error), _, Some(arena)) => {
                warn!("{error:#}; back to {}", arena.display());
                args.arena = arena;
            }
            (round, _, _) => return round,
        }
    }
}

/// Serves one scene, until the program ends or another scene is chosen. `again`: a previous round has just
/// ended, and its last tasks may still hold the sockets.
async fn run(
    args: &mut ServeArgs,
    scenes: &Arc<Scenes>,
    logins: &Arc<Logins>,
    again: bool,
    stop: &Stop,
) -> Result<()> {
    // Sockets first: a taken port is reported before the scene is loaded.
    let authorizer = Arc::new(Authorizer::open(KeysFolder::open(args.keys.as_deref())?)?);
    let Sockets { endpoint, listener, tls, sources } =
        open_sockets(args, &authorizer, again).await?;
    let quic = endpoint.local_addr().context("QUIC has no address")?;
    let http = listener.local_addr().context("the page has no address")?;
    let vicon = sources.iter().find(|source| source.driver() == Driver::Vicon);
    let vicon = vicon.and_then(Opened::socket);
    // The next round uses the same addresses.
    (args.quic, args.http) = (quic, http);
    args.vicon = args.vicon.and(vicon);
    let pose = sources.iter().map(ReadySource::of).collect();

    let loading = args.clone();
    let load = tokio::task::spawn_blocking(move || prepare(&loading));
    let mut scene = tokio::select! {
        scene = load => scene.context("loading the scene failed")??,
        () = stop.wait() => return Ok(()),
    };
    let rooms = make_rooms(args, &mut scene, &sources, stop).await;
    let names: Vec<_> = rooms.flights.vehicles.iter().map(|v| v.name.as_str()).collect();
    let cameras: Vec<_> = scene.flying.iter().map(|(_, arena)| arena.cameras.len()).collect();
    let previews = Arc::new(Previews::new(&cameras));
    let source = drivers::track(sources, &names)?;
    let threads =
        threads::Threads { rooms: &rooms, previews: &previews, neighbours: scene.neighbours };
    let threads = threads.start(
        args,
        scene.renderer.rasterizer,
        scene.referees,
        source,
        scene.sensor_scene.take(),
    )?;

    let renderer = lock(&rooms.rendering.renderer).clone();
    let url = format!("{}://{http}", if tls.is_some() { "https" } else { "http" });
    print::ready(
        args.json,
        &Ready {
            ready: "server",
            quic,
            http: url.clone(),
            page_certificate: tls.as_ref().map(|tls| tls.fingerprint().to_string()),
            vicon,
            pose,
            fingerprint: authorizer.identity.fingerprint().to_string(),
            paired: authorizer.paired().clients.len(),
            spawn: scene.flying.first().map_or([0.0; 4], |(_, arena)| print::spawn(arena)),
            vehicles: scene.flying.iter().map(ReadyVehicle::of).collect(),
            arena: &scene.arena.name,
            renderer: &renderer.name,
            renderer_reason: &renderer.reason,
        },
    );
    let access = Arc::new(Access::new(&authorizer.folder, &names, args.login, logins.clone())?);
    if args.print_page_keys || !args.http.ip().is_loopback() {
        print::page_keys(access.keys(), &url, &names, args.json);
    }
    let localization = args.localization(settings::of_arena(&args.arena)?);
    let lab = Arc::new(Lab::open(args.lab_day_file(), localization.into_iter().next()));
    let fence = &scene.arena.geofence;
    let page = Page {
        rooms: rooms.clone(),
        lab: lab.clone(),
        previews,
        top_view: scene.top_view,
        twin_pictures: TwinPictures::new(scene.twin.clone(), fence.min_m, fence.max_m),
        twin: scene.twin,
        stages: scene.arena.stages,
        boot: clock::now(),
        rates: Rates::of(rooms.flights.vehicles.len()),
        access,
        authorizer: authorizer.clone(),
        quic_port: quic.port(),
        scenes: scenes.clone(),
        team_tries: Mutex::default(),
        watchers: Mutex::default(),
    };
    let mut tasks = JoinSet::new();
    tasks.spawn(web::serve(page, listener, tls));
    tasks.spawn(web::follow_lab(rooms.clone(), lab.clone()));
    if let Some(grant) = args.pair.take() {
        open_pairing(&authorizer, &grant, quic.port(), args.json)?;
    }
    for (vehicle, (_, arena)) in rooms.flights.vehicles.iter().zip(&scene.flying) {
        tasks.spawn(flights::crash::follow(vehicle.clone(), arena.clone(), scene.field.clone()));
        if let Some(board) = &rooms.flights.leaderboard {
            let (board, vehicle) = (board.clone(), vehicle.clone());
            tasks.spawn(flights::record(board, vehicle, arena.clone(), args.official_attempts));
        }
        let alone = names.len() == 1;
        tasks.spawn(print::events(vehicle.clone(), alone, args.json));
    }
    let following = authorizer.clone();
    tasks.spawn(async move { following.follow().await });
    transport::serve(rooms.clone(), endpoint, authorizer, args.congestion).await;
    rooms.streaming.subscriptions.shut();
    tasks.shutdown().await;
    lab.close();
    for thread in threads {
        // A thread that panicked has reported it on standard error; the report is still printed.
        let _ = tokio::task::spawn_blocking(move || thread.join()).await;
    }
    print::report(args.json, &print::ServerReport::of(&rooms));
    Ok(())
}

/// All sockets of the server.
struct Sockets {
    endpoint: Endpoint,
    listener: TcpListener,
    tls: Option<PageTls>,
    sources: Vec<Opened>,
}

/// Binds all addresses. `again`: a previous round may still hold them for a moment.
async fn open_sockets(args: &ServeArgs, authorizer: &Authorizer, again: bool) -> Result<Sockets> {
    let folder = &authorizer.folder;
    let tls = PageTls::open(args.tls.as_deref(), args.tls_key.as_deref(), folder)?;
    let mut tries = if again { BIND_TRIES } else { 0 };
    loop {
        let bound = async {
            let endpoint = transport::bind(args.quic, &authorizer.identity, args.congestion)?;
            let listener = web::bind(args.http, tls.as_ref(), args.plain_http)?;
            let sources = drivers::open(&args.localization(settings::of_arena(&args.arena)?))?;
            anyhow::Ok(Sockets { endpoint, listener, tls: tls.clone(), sources })
        };
        match bound.await {
            Err(_) if tries > 0 => tries -= 1,
            bound => return bound,
        }
        tokio::time::sleep(BIND_EVERY).await;
    }
}

/// Creates the state of every room at the start.
async fn make_rooms(
    args: &ServeArgs,
    scene: &mut LoadedScene,
    sources: &[Opened],
    stop: &Stop,
) -> Rooms {
    let vehicles = scene.flying.iter().enumerate();
    let vehicles =
        vehicles.map(|(index, (name, arena))| VehicleFlight::new(index, name, arena.info()));
    let flights = Flights::new(vehicles.collect(), open_leaderboard(args).await);
    let cameras: Vec<_> = scene.flying.iter().map(|(_, arena)| arena.cameras.len()).collect();
    let name = |source: &Opened| format!("{} {}", source.driver(), source.address());
    let rendering = Rendering {
        cameras: scene
            .flying
            .iter()
            .map(|(_, arena)| Cameras::new(arena.cameras.clone()))
            .collect(),
        sensors: std::mem::take(&mut scene.sensors).into_iter().map(Sensors::new).collect(),
        environment: Environment::new(scene.arena.environment),
        seed: args.seed,
        dynamic_objects: std::mem::take(&mut scene.dynamic_objects),
        predict: scene.arena.pose.predict,
        renderer: Mutex::new(RendererInfo {
            name: scene.renderer.rasterizer.name().into_owned(),
            reason: std::mem::take(&mut scene.renderer.reason),
        }),
        ..Rendering::default()
    };
    Rooms {
        localization: Arc::new(Localization::new(
            flights.vehicles.len(),
            sources.iter().map(name).collect(),
        )),
        flights: Arc::new(flights),
        rendering: Arc::new(rendering),
        streaming: Arc::new(Streaming::new(&cameras, args.adapt)),
        stop: stop.clone(),
    }
}

/// Opens the database of runs. If it fails, a warning is printed, and flights are possible without it.
async fn open_leaderboard(args: &ServeArgs) -> Option<Leaderboard> {
    let database = match &args.leaderboard {
        Some(RunStorage::Nowhere) => return None,
        Some(RunStorage::In(database)) => database.clone(),
        None => Database::File(Database::default_file()?),
    };
    match Leaderboard::open(&database).await {
        Ok(board) => Some(board),
        Err(error) => {
            warn!("flights are not recorded: {error}");
            None
        }
    }
}

/// Opens the pairing of `--pair`, and prints its code and its progress.
fn open_pairing(authorizer: &Arc<Authorizer>, grant: &Grant, port: u16, json: bool) -> Result<()> {
    let window = authorizer.open_pairing(grant.clone()).map_err(anyhow::Error::msg)?;
    if json {
        print::line(&serde_json::json!({ "pairing": { "code": window.code.to_string() } }));
    } else {
        print_fmt!(
            "pairing      code {}, good for {} s: on the other computer `vizflyt pair HOST:{port}`",
            window.code,
            window.left.as_secs()
        );
    }
    let mut news = authorizer.pairing_news();
    news.mark_unchanged();
    tokio::spawn(async move {
        while news.changed().await.is_ok() {
            let text = news.borrow_and_update().clone();
            if json {
                print::line(&serde_json::json!({ "pairing": { "news": text } }));
            } else {
                print_fmt!("pairing      {text}");
            }
        }
    });
    Ok(())
}

/// Interval and maximum number of attempts to bind a socket that a previous round may still hold.
const BIND_EVERY: Duration = Duration::from_millis(100);
const BIND_TRIES: u32 = 50;
