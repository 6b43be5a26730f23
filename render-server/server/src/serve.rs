//! Starts everything, says when it is ready, and ends it in order.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, Result};
use glam::DVec2;
use serde::Serialize;
use tracing::warn;
use vizflyt_arena::config::Driver;
use vizflyt_arena::{ArenaConfig, DistanceField, Referee};
use vizflyt_protocol::messages::Grant;
use vizflyt_splat::{Chosen, Rasterizer, Scene as Drawn, Splats};
use vizflyt_trust::KeysFolder;

use crate::args::{Kept, ServeArgs};
use crate::authorization::Authorizer;
use crate::flights::events::Origin;
use crate::flights::leaderboard::{Database, Leaderboard, record};
use crate::flights::vehicle::Vehicle;
use crate::hub::{Hub, RendererInfo};
use crate::lock::lock;
use crate::mailbox::Mailbox;
use crate::poses::drivers::{self, Opened, PoseSource};
use crate::render::cameras::Cameras;
use crate::render::choose;
use crate::render::dynamic_objects::{DynamicObjects, vehicle_models};
use crate::render::environment::Environment;
use crate::render::rendered::RenderQueue;
use crate::scene::{self, Scene, Scenes};
use crate::stats::Report;
use crate::stop::Stop;
use crate::stream::transport;
use crate::web::messages::Rates;
use crate::web::top_view::{self, Obstacles, TopView};
use crate::web::{Access, Logins, Page, PageKeys};
use crate::{clock, flights, poses, render, stream, web};

/// Runs the render server until SIGINT, SIGTERM or, with `--lifeline`, the end of stdin.
///
/// With `--json` standard output carries one JSON line when ready, one per event of the server and
/// one report at the end; without, the same for people.
///
/// # Errors
/// Scene or arena that cannot be used, an address that cannot be bound.
#[allow(clippy::needless_pass_by_value)] // Why: a command consumes its arguments.
pub fn serve(args: ServeArgs) -> Result<()> {
    let stop = Stop::default();
    let mut args = args;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("net")
        .enable_all()
        .build()
        .context("cannot start tokio")?;
    let result = runtime.block_on(rounds(&mut args, &stop));
    stop.set();
    // Not awaited: a task stuck in a system call must not hold up the end.
    runtime.shutdown_background();
    result
}

/// What is printed when the server is ready.
#[derive(Debug, Serialize)]
#[allow(clippy::struct_field_names)] // Why: the key that every program's first line begins with.
struct Ready<'a> {
    ready: &'static str,
    quic: SocketAddr,
    http: String,
    /// Where Vicon's stream must be sent, if that is a source.
    #[serde(skip_serializing_if = "Option::is_none")]
    vicon: Option<SocketAddr>,
    /// Where poses come from.
    pose: Vec<ReadySource>,
    fingerprint: &'a str,
    /// How many computers may connect.
    paired: usize,
    /// Where the first vehicle is expected to start: x, y, z [m, world], yaw [deg].
    spawn: [f64; 4],
    vehicles: Vec<ReadyVehicle>,
    arena: &'a str,
    /// What draws: `cpu avx2`.
    renderer: &'a str,
    /// Why it is this renderer.
    renderer_reason: &'a str,
}

/// A source of poses, as it is printed when the server is ready.
#[derive(Debug, Serialize)]
struct ReadySource {
    driver: Driver,
    address: String,
}

/// A vehicle, as it is printed when the server is ready.
#[derive(Debug, Serialize)]
struct ReadyVehicle {
    name: String,
    /// Where it is expected to start: x, y, z [m, world], yaw [deg].
    spawn: [f64; 4],
    cameras: Vec<String>,
}

impl ReadyVehicle {
    fn of(vehicle: &Vehicle, arena: &ArenaConfig) -> Self {
        let [x, y, z] = arena.spawn.position_m.to_array();
        let cameras = arena.cameras.iter().map(|camera| camera.name.clone()).collect();
        Self { name: vehicle.name.to_string(), spawn: [x, y, z, arena.spawn.yaw_deg], cameras }
    }
}

/// Serves one scene after another, until the end of the program.
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
            // The new one cannot be loaded: the lab goes on with the one that could.
            (Err(error), _, Some(arena)) => {
                warn!("{error:#}; back to {}", arena.display());
                args.arena = arena;
            }
            (round, _, _) => return round,
        }
    }
}

/// Serves one scene, until it is to end or another one is chosen. With `again`, a former round was
/// a moment ago, and its last tasks may still hold the sockets.
async fn run(
    args: &mut ServeArgs,
    scenes: &Arc<Scenes>,
    logins: &Arc<Logins>,
    again: bool,
    stop: &Stop,
) -> Result<()> {
    // Sockets first: a taken port is told before the scene is loaded.
    let authorizer = Arc::new(Authorizer::open(KeysFolder::open(args.keys.as_deref())?)?);
    let mut tries = if again { BIND_TRIES } else { 0 };
    let (endpoint, listener, sources) = loop {
        let bound = async {
            let endpoint = transport::bind(args.quic, &authorizer.identity, args.congestion)?;
            let listener = web::bind(args.http).await?;
            let sources = drivers::open(&args.localization(scene::localization(&args.arena)?))?;
            anyhow::Ok((endpoint, listener, sources))
        };
        match bound.await {
            Err(_) if tries > 0 => tries -= 1,
            bound => break bound?,
        }
        tokio::time::sleep(BIND_EVERY).await;
    };
    let quic = endpoint.local_addr().context("QUIC has no address")?;
    let http = listener.local_addr().context("the page has no address")?;
    let vicon = sources.iter().find(|source| source.driver() == Driver::Vicon);
    let vicon = vicon.and_then(Opened::socket);
    // The next round is found where this one is.
    (args.quic, args.http) = (quic, http);
    args.vicon = args.vicon.and(vicon);
    let http = format!("http://{http}");
    let pose = sources
        .iter()
        .map(|source| ReadySource { driver: source.driver(), address: source.address() });
    let pose = pose.collect();

    let loading = args.clone();
    let load = tokio::task::spawn_blocking(move || prepare(&loading));
    let scene = tokio::select! {
        scene = load => scene.context("loading the scene failed")??,
        () = stop.wait() => return Ok(()),
    };
    let Chosen { rasterizer, reason } = scene.renderer;
    let renderer = RendererInfo { name: rasterizer.name().into_owned(), reason };
    let vehicles = scene.flying.iter().enumerate().map(|(index, (name, arena))| {
        Vehicle::new(index, name, arena.info(), Cameras::new(arena.cameras.clone()))
    });
    let mut hub = Hub::new(vehicles.collect(), renderer, stop.clone());
    hub.adapt = args.adapt;
    hub.predict = scene.arena.pose.predict;
    hub.environment = Environment::new(scene.arena.environment);
    hub.dynamic_objects = scene.moving;
    hub.leaderboard = open_leaderboard(args).await;
    hub.source_names =
        sources.iter().map(|source| format!("{} {}", source.driver(), source.address())).collect();
    let hub = Arc::new(hub);
    let renderer = lock(&hub.renderer).clone();
    let names: Vec<_> = hub.vehicles.iter().map(|vehicle| vehicle.name.as_str()).collect();
    let threads =
        start_threads(args, &hub, rasterizer, scene.referees, drivers::track(sources, &names)?)?;

    let fingerprint = authorizer.identity.fingerprint().to_string();
    let vehicles = hub.vehicles.iter().zip(&scene.flying);
    let vehicles: Vec<_> =
        vehicles.map(|(vehicle, (_, arena))| ReadyVehicle::of(vehicle, arena)).collect();
    announce(
        args.json,
        &Ready {
            ready: "server",
            quic,
            http: http.clone(),
            vicon,
            pose,
            fingerprint: &fingerprint,
            paired: authorizer.paired().clients.len(),
            spawn: vehicles.first().map_or([0.0; 4], |vehicle| vehicle.spawn),
            vehicles,
            arena: &scene.arena.name,
            renderer: &renderer.name,
            renderer_reason: &renderer.reason,
        },
    );

    let access = Arc::new(Access::new(&authorizer.folder, &names, args.login, logins.clone())?);
    if args.print_page_keys || !args.http.ip().is_loopback() {
        print_page_keys(access.keys(), &http, &names, args.json);
    }
    let page = Page {
        hub: hub.clone(),
        top_view: scene.top_view,
        stages: scene.arena.stages,
        boot: clock::now(),
        rates: Rates::of(hub.vehicles.len()),
        access,
        authorizer: authorizer.clone(),
        quic_port: quic.port(),
        scenes: scenes.clone(),
        team_tries: Mutex::default(),
    };
    let page = tokio::spawn(web::serve(page, listener));
    if let Some(grant) = args.pair.take() {
        open_pairing(&authorizer, &grant, quic.port(), args.json)?;
    }
    let mut recorders = tokio::task::JoinSet::new();
    for (vehicle, (_, arena)) in hub.vehicles.iter().zip(&scene.flying) {
        recorders.spawn(flights::crash::follow(
            vehicle.clone(),
            arena.clone(),
            scene.field.clone(),
        ));
        if let Some(board) = &hub.leaderboard {
            let (board, vehicle) = (board.clone(), vehicle.clone());
            recorders.spawn(record(board, vehicle, arena.clone(), args.official_attempts));
        }
    }
    let rights = tokio::spawn({
        let authorizer = authorizer.clone();
        async move { authorizer.follow().await }
    });
    let mut printers = tokio::task::JoinSet::new();
    for vehicle in &hub.vehicles {
        let alone = hub.vehicles.len() == 1;
        printers.spawn(print_events(vehicle.clone(), alone, args.json));
    }
    transport::serve(hub.clone(), endpoint, authorizer, args.congestion).await;
    hub.subscriptions.shut();
    rights.abort();
    page.abort();
    printers.shutdown().await;
    recorders.shutdown().await;
    for thread in threads {
        // A thread that panicked has said so on stderr; the report still comes.
        let _ = tokio::task::spawn_blocking(move || thread.join()).await;
    }
    report(args.json, &hub.report());
    Ok(())
}

/// Opens the database of runs. Without one the lab flies all the same: a warning says why.
async fn open_leaderboard(args: &ServeArgs) -> Option<Leaderboard> {
    let database = match &args.leaderboard {
        Some(Kept::Nowhere) => return None,
        Some(Kept::In(database)) => database.clone(),
        None => Database::File(Database::default_file()?),
    };
    match Leaderboard::open(&database).await {
        Ok(board) => Some(board),
        Err(error) => {
            warn!("flights are not written down: {error}");
            None
        }
    }
}

/// Prints the addresses by which others open the page.
fn print_page_keys(keys: &PageKeys, http: &str, names: &[&str], json: bool) {
    // Bound to all addresses, none of which is more right than another.
    let page = http.replace("//0.0.0.0:", "//HOST:").replace("//[::]:", "//HOST:");
    for (whose, link) in keys.links(&page, names) {
        if json {
            line(&serde_json::json!({ "page_key": { "for": whose, "link": link } }));
        } else {
            say(&format!("page key     {link} ({whose})"));
        }
    }
}

/// Opens the pairing that `--pair` asks for, and prints its code and what comes of it.
fn open_pairing(authorizer: &Arc<Authorizer>, grant: &Grant, port: u16, json: bool) -> Result<()> {
    let window = authorizer.open_pairing(grant.clone()).map_err(anyhow::Error::msg)?;
    if json {
        line(&serde_json::json!({ "pairing": { "code": window.code.to_string() } }));
    } else {
        say(&format!(
            "pairing      code {}, good for {} s: on the other computer `vizflyt pair HOST:{port}`",
            window.code,
            window.left.as_secs()
        ));
    }
    let mut news = authorizer.pairing_news();
    news.mark_unchanged();
    tokio::spawn(async move {
        while news.changed().await.is_ok() {
            let text = news.borrow_and_update().clone();
            if json {
                line(&serde_json::json!({ "pairing": { "news": text } }));
            } else {
                say(&format!("pairing      {text}"));
            }
        }
    });
    Ok(())
}

/// Everything made from the scene.
struct LoadedScene {
    arena: ArenaConfig,
    renderer: Chosen,
    /// Each vehicle's name, and the arena as it has it.
    flying: Vec<(String, ArenaConfig)>,
    referees: Vec<Referee>,
    moving: DynamicObjects,
    top_view: TopView,
    /// What stands still.
    field: Arc<DistanceField>,
}

fn prepare(args: &ServeArgs) -> Result<LoadedScene> {
    let Scene { arena, splats, mut objects, .. } = scene::load(&args.arena, args.up, args.scale)?;
    let flying: Vec<_> = arena
        .flying(&args.vehicles)?
        .iter()
        .map(|vehicle| (vehicle.name.clone(), arena.of_vehicle(vehicle)))
        .collect();
    let field = Arc::new(scene::bake(&splats, &arena));
    let top_view = render_top_view(&splats, &arena, &field);
    let obstacles = scene::obstacles(&arena, &objects, field.clone(), args.seed);
    let together = if args.apart { 0 } else { flying.len() };
    objects.extend(vehicle_models(together));
    let renderer = choose(Drawn { splats: &splats, objects: &objects }, args.renderer)?;
    // The renderer holds its own form of the scene; the file's form is no longer needed.
    drop(splats);
    // Pictures and referees count what moves from the same instant.
    let epoch = clock::now();
    let moving = DynamicObjects::new(epoch, obstacles.objects.clone(), &objects, together);
    let referees =
        flying.iter().map(|(_, arena)| Referee::new(arena, obstacles.clone()).counting_from(epoch));
    let referees = referees.collect();
    Ok(LoadedScene { arena, renderer, flying, referees, moving, top_view, field })
}

fn render_top_view(splats: &Splats, arena: &ArenaConfig, field: &DistanceField) -> TopView {
    let (min, max) = (arena.geofence.min_m.truncate(), arena.geofence.max_m.truncate());
    let flight_m = arena.spawn.position_m.z + arena.takeoff_height_m;
    let obstacles = Obstacles::scan(min, max, arena.occupancy.voxel_m, |p: DVec2| {
        field.obstacle_distance_m(p.extend(flight_m)) < 0.0
    });
    let jpeg = top_view::picture(splats, min, max, flight_m + MAP_HEADROOM_M);
    let (low, high) = (arena.geofence.min_m, arena.geofence.max_m);
    let shell = top_view::shell(low, high, arena.occupancy.voxel_m, |p, within_m| {
        field.obstacle_distance_m(p) < within_m
    });
    TopView {
        shell,
        jpeg: jpeg.unwrap_or_default(),
        min_m: min.to_array(),
        max_m: max.to_array(),
        obstacles,
    }
}

fn start_threads(
    args: &ServeArgs,
    hub: &Arc<Hub>,
    mut renderer: Box<dyn Rasterizer>,
    mut referees: Vec<Referee>,
    mut source: Box<dyn PoseSource>,
) -> Result<Vec<JoinHandle<()>>> {
    let newest = Arc::new(Mailbox::default());
    let ticks = Arc::new(RenderQueue::default());
    let start = |name: &str, run: Box<dyn FnOnce() + Send>| {
        std::thread::Builder::new()
            .name(name.to_owned())
            .spawn(run)
            .with_context(|| format!("cannot start the {name} thread"))
    };
    let (pose_hub, pose_newest) = (hub.clone(), newest.clone());
    let (draw_hub, draw_ticks, max_rate) = (hub.clone(), ticks.clone(), args.max_rate);
    let (encode_hub, encode_ticks, options) = (hub.clone(), ticks.clone(), args.encode_options());
    let previews_hub = hub.clone();
    Ok(vec![
        start(
            "pose",
            Box::new(move || {
                poses::thread::run(&pose_hub, &mut *source, &mut referees, &pose_newest);
            }),
        )?,
        start(
            "render",
            Box::new(move || {
                render::thread::run(&draw_hub, &mut *renderer, &newest, &draw_ticks, max_rate);
            }),
        )?,
        start(
            "encode",
            Box::new(move || stream::encode::run(&encode_hub, &encode_ticks, options)),
        )?,
        start("previews", Box::new(move || web::previews::run(&previews_hub, &ticks)))?,
    ])
}

/// Prints what happens to a vehicle; unless it is `alone`, each line names it.
async fn print_events(vehicle: Arc<Vehicle>, alone: bool, json: bool) {
    let mut log = vehicle.events.subscribe();
    log.mark_changed();
    let mut cursor = 0;
    while log.changed().await.is_ok() {
        log.mark_unchanged();
        let entries = match vehicle.events.read(&mut cursor) {
            Ok(entries) => entries,
            Err(lagged) => {
                cursor = lagged.oldest;
                continue;
            }
        };
        for entry in entries.into_iter().filter(|entry| entry.origin == Origin::Server) {
            match (json, alone) {
                (true, true) => line(&serde_json::json!({ "event": entry.event })),
                (true, false) => {
                    line(&serde_json::json!({ "vehicle": vehicle.name, "event": entry.event }));
                }
                (false, true) => say(&entry.event.text),
                (false, false) => say(&format!("{}: {}", vehicle.name, entry.event.text)),
            }
        }
    }
}

fn announce(json: bool, ready: &Ready<'_>) {
    if json {
        return line(ready);
    }
    say(&format!("arena        {}", ready.arena));
    say(&format!("renderer     {} ({})", ready.renderer, ready.renderer_reason));
    say(&format!("page         {}", ready.http));
    for source in &ready.pose {
        say(&format!("{:<12} {} (poses)", source.driver.name(), source.address));
    }
    for vehicle in &ready.vehicles {
        let named = match &*ready.vehicles {
            [one] if one.name == "vizflyt" => String::new(),
            _ => format!(" --vehicle {}", vehicle.name),
        };
        say(&format!("runtime      vizflyt fly PLUGIN --server HOST:{}{named}", ready.quic.port()));
    }
    say(&format!("identity     {} ({} paired)", ready.fingerprint, ready.paired));
}

fn report(json: bool, report: &Report) {
    if json {
        return line(&serde_json::json!({ "report": report }));
    }
    say(&format!(
        "{} images sent, {} ticks drawn ({} skipped); render {:.1} ms, p99 {:.1}; peak memory {:.0} MB; {}",
        report.images_sent,
        report.ticks,
        report.ticks_skipped,
        report.render_ms_p50,
        report.render_ms_p99,
        report.peak_rss_mb,
        report.renderer
    ));
}

fn line(value: &impl Serialize) {
    match serde_json::to_string(value) {
        Ok(text) => say(&text),
        Err(error) => tracing::warn!("a line was not printed: {error}"),
    }
}

/// Prints a line; unlike `println!` it does not panic when the reader has gone.
fn say(text: &str) {
    use std::io::Write;
    let mut out = std::io::stdout().lock();
    let _ = writeln!(out, "{text}").and_then(|()| out.flush());
}

/// How often a socket that a former round may still hold is asked for, and how often at most.
const BIND_EVERY: Duration = Duration::from_millis(100);
const BIND_TRIES: u32 = 50;
/// What hangs this far above the flight is still drawn on the map. [m]
const MAP_HEADROOM_M: f64 = 0.4;
