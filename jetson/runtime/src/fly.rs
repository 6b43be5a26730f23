//! Starts all parts of a flight, flies, and writes the report.

use std::fs;
use std::hash::{BuildHasher, RandomState};
use std::net::SocketAddr;
use std::process;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;
use vizflyt_process::lock;

use anyhow::Context;
use serde_json::json;
use tokio::runtime::{Builder, Runtime};
use vizflyt_guardian::client::BUFFER;
use vizflyt_guardian::{Feed, Guardian, Message};
use vizflyt_process::{descriptors, on_interrupt, on_orphaned, print_line};
use vizflyt_protocol::flight_end::EndReason;
use vizflyt_protocol::messages::{PoseSample, Purpose, bounded};
use vizflyt_protocol::packet::feed::FeedKey;
use vizflyt_protocol::time::HostTime;

use crate::args::{FlyArgs, ServerAddress};
use crate::console::Screen;
use crate::control::{Control, ControlInput, QUEUE};
use crate::flight::FlightSettings;
use crate::log::{FlightLog, Live, keep_going_when_files_are_full};
use crate::report::FlightReport;
use crate::stream::{self, Outbox, ServerClock, Shared, StreamEvent, StreamSettings};

/// Timeout for sending the last events to the server.
const GOODBYE: Duration = Duration::from_millis(500);
/// Exit status after a second signal during the landing: 128 + SIGINT, as in shells.
const CUT_SHORT: i32 = 130;

/// Flies one flight to its end and returns its outcome. Blocks. Call it on a thread that lives as long as the flight,
/// because the plugin ends with that thread.
///
/// # Errors
/// Fails if sockets or threads cannot be created, or the report cannot be written. Every later problem is an
/// [`EndReason`].
pub fn fly(mut args: FlyArgs) -> anyhow::Result<EndReason> {
    args.settle()?;
    let command = args.plugin_command();
    fly_command(&args, command, None)
}

/// As [`fly`], with settled `args` and the plugin's command as a list; [`FlyArgs::plugin`] is only its name. Each
/// message from `reloads` restarts the plugin, while the vehicle holds.
///
/// # Errors
/// As [`fly`].
pub fn fly_command(
    args: &FlyArgs,
    plugin_command: Vec<std::ffi::OsString>,
    reloads: Option<Receiver<()>>,
) -> anyhow::Result<EndReason> {
    keep_going_when_files_are_full();
    descriptors::raise_limit();
    let mut plugin_limits = args.jetson.plugin.limits();
    if let Some(path) = &args.map {
        plugin_limits.hand_map_file(path)?;
    }
    let server = args.server.address()?;
    let (fingerprint, identity) = args.server.known()?;
    let mavlink = args.mavlink_address();
    let link = args.link_settings()?;
    // Before any thread starts: the guardian must outlive this process.
    let program = std::env::current_exe().context("cannot find this program's path")?;
    let guardian = Guardian::start(&program, &mavlink, &link.wanted())
        .with_context(|| format!("{mavlink}: cannot open the connection to the autopilot"))?;
    let guardian = Arc::new(guardian);
    let tokio = Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let live = args.foxglove.map(|address| listen(&tokio, address)).transpose()?;
    let log = FlightLog::open(&args.log.settings(&args.jetson.log), live);
    log.flight(&args.plugin.clone().unwrap_or_default(), &args.plugin_arguments);
    let (sender, inputs) = sync_channel(QUEUE);
    let stop = Arc::new(AtomicBool::new(false));
    receive_mavlink(Arc::clone(&guardian), sender.clone(), Arc::clone(&stop))?;
    if args.lifeline {
        let sender = sender.clone();
        on_orphaned(move || _ = sender.send(ControlInput::Interrupt))?;
    }
    if let Some(reloads) = reloads {
        forward_reloads(reloads, sender.clone())?;
    }

    let shared =
        Shared { clock: ServerClock::default(), mailbox: Arc::default(), readings: Arc::default() };
    let to_server = Arc::new(Outbox::default());
    watch_signals(sender.clone())?;
    let settings = StreamSettings {
        server: server.address,
        fingerprint,
        identity,
        vehicle: bounded(args.vehicle_name()),
        purpose: Purpose::Fly,
        program: bounded(concat!("vizflyt-runtime ", env!("CARGO_PKG_VERSION"))),
    };
    let outbox = Arc::clone(&to_server);
    let talk = stream::run(
        settings,
        shared.clone(),
        to_server,
        tell_stream(sender.clone(), Arc::clone(&guardian)),
    );
    let talk = tokio.spawn(talk);
    print_ready(args.json, server, guardian.local(), &log);

    let control = Control {
        plugin_command,
        plugin_limits,
        settings: FlightSettings {
            ready_within_s: if args.attach { 0.0 } else { args.ready_within },
            time_limit_s: args.seconds,
            limits: args.limits,
            slip_seed: RandomState::new().hash_one(()),
            cameras: args.jetson.plugin.cameras.clone(),
        },
        waits_for_start: args.wait,
        to_autopilot: Box::new({
            let guardian = Arc::clone(&guardian);
            move |bytes| guardian.send(bytes)
        }),
        link,
        shared,
        to_server: Arc::clone(&outbox),
        log,
        json: args.json,
        screen: Screen::default(),
    };
    let flown = control.run(sender, &inputs);
    stop.store(true, Ordering::Relaxed);
    guardian.leave();

    let mut report = FlightReport::new(&flown.outcome, &flown.times, &flown.counters);
    report.log = flown.log.path().map(|path| path.display().to_string());
    drop(flown.log);
    // The stream ends when the server has acknowledged every event, and closes the connection.
    outbox.close();
    let _ = tokio.block_on(async { tokio::time::timeout(GOODBYE, talk).await });
    tokio.shutdown_background();
    print_outcome(args, &report);
    if let Some(file) = &args.report {
        let text = serde_json::to_string_pretty(&report)?;
        fs::write(file, text + "\n")
            .with_context(|| format!("report {} cannot be written", file.display()))?;
    }
    Ok(flown.outcome)
}

/// Serves the log's channels to live viewers.
fn listen(tokio: &Runtime, address: SocketAddr) -> anyhow::Result<Live> {
    let live = tokio.block_on(Live::start(address)).with_context(|| {
        format!("--foxglove={address}: cannot listen there; give another address or port")
    })?;
    tracing::info!("foxglove: open a connection to ws://{}", live.address());
    Ok(live)
}

fn receive_mavlink(
    guardian: Arc<Guardian>,
    sender: SyncSender<ControlInput>,
    stop: Arc<AtomicBool>,
) -> std::io::Result<()> {
    let receive = move || {
        let mut buffer = BUFFER;
        while !stop.load(Ordering::Relaxed) {
            match guardian.receive(&mut buffer) {
                Ok(Some(Message::Mavlink(bytes))) => {
                    // A full queue drops telemetry, as the network might.
                    let _ = sender.try_send(ControlInput::Mavlink(bytes.to_vec()));
                }
                Ok(Some(Message::Note(text))) => {
                    tracing::warn!("mavlink: {text}");
                    let _ = sender.try_send(ControlInput::Note(text));
                }
                Ok(Some(Message::Failed(failure))) => {
                    tracing::error!("{failure}: the runtime lands the vehicle");
                    let _ = sender.send(ControlInput::GuardianFailed);
                }
                Ok(None) => {}
                Err(error) => {
                    tracing::error!("{error}");
                    let _ = sender.try_send(ControlInput::Note(error.to_string()));
                    let _ = sender.send(ControlInput::GuardianFailed);
                }
            }
        }
    };
    thread::Builder::new().name("mavlink".into()).spawn(receive)?;
    Ok(())
}

/// The first signal lands and ends the flight; the second ends the process at once.
fn watch_signals(sender: SyncSender<ControlInput>) -> anyhow::Result<()> {
    let mut count = 0;
    on_interrupt(move || {
        count += 1;
        if count > 1 {
            process::exit(CUT_SHORT);
        }
        tracing::info!("landing, then ending; interrupt again to end at once");
        let _ = sender.try_send(ControlInput::Interrupt);
        true
    })
}

fn forward_reloads(reloads: Receiver<()>, sender: SyncSender<ControlInput>) -> std::io::Result<()> {
    let forward = move || {
        while reloads.recv().is_ok() && sender.send(ControlInput::Reload).is_ok() {}
    };
    thread::Builder::new().name("reloads".into()).spawn(forward)?;
    Ok(())
}

fn tell_stream(
    sender: SyncSender<ControlInput>,
    guardian: Arc<Guardian>,
) -> impl Fn(StreamEvent) -> bool + Send + Sync {
    let feed = Mutex::new(FeedTeller::default());
    move |event| {
        let is_pose = match &event {
            StreamEvent::Feed(server, key) => {
                lock(&feed).source = Some((*server, *key));
                return true;
            }
            StreamEvent::Pose(sample, stamp) => {
                let mut feed = lock(&feed);
                if let Some(told) = feed.due(sample, *stamp) {
                    guardian.feed(&told);
                }
                true
            }
            _ => false,
        };
        // Poses are frequent and soon outdated, so they may be dropped. The server sends an event again if the queue
        // was full.
        let taken = sender.try_send(ControlInput::Stream(event)).is_ok();
        if !taken && !is_pose {
            tracing::error!("the control loop is stalled");
        }
        taken
    }
}

/// Sends the source of poses and the offset of the server's clock to the guardian, once a second.
#[derive(Default)]
struct FeedTeller {
    source: Option<(SocketAddr, FeedKey)>,
    told_at: Option<HostTime>,
}

impl FeedTeller {
    fn due(&mut self, sample: &PoseSample, stamp: HostTime) -> Option<Feed> {
        let (server, key) = self.source?;
        if self.told_at.is_some_and(|at| stamp.seconds_since(at) < 1.0) {
            return None;
        }
        self.told_at = Some(stamp);
        let server_ahead_ns = sample.stamp.as_ns().wrapping_sub(stamp.as_ns()).cast_signed();
        Some(Feed { server, key, server_ahead_ns })
    }
}

fn print_ready(json: bool, server: &ServerAddress, mavlink: &str, log: &FlightLog) {
    let log = log.path().map(|path| path.display().to_string());
    if json {
        print_line(json!({"ready": "runtime", "mavlink": mavlink, "log": log}));
    } else {
        print_line(format!("waiting for server {server} and an autopilot on {mavlink}"));
    }
}

fn print_outcome(args: &FlyArgs, report: &FlightReport) {
    if args.json {
        print_line(json!({"report": report}));
        return;
    }
    print_line(format!("{}: {}", report.outcome.name(), report.reason));
    print_line(format!(
        "{:.1} s in the air, {} images at {:.1} Hz, age {:.1} ms (p99 {:.1}), {} setpoints",
        report.seconds,
        report.images_delivered,
        report.image_hz,
        report.age_ms_p50,
        report.age_ms_p99,
        report.setpoints_sent
    ));
    if let Some(log) = &report.log {
        print_line(format!("log: {log}"));
    }
}
