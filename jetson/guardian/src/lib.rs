//! Guardian: process that owns the connection to the autopilot and outlives the runtime. If the runtime is silent for
//! 0.5 s in flight, or has ended, the guardian orders LAND. It then continues the heartbeats and, with its own
//! subscription, the poses, until the vehicle is on the ground or a pilot has taken over. It does not restart or plan
//! anything.
//!
//! ```text
//! runtime ── socket, one packet a message ──▶ watch ──▶ port ──▶ autopilot
//!         ◀────────────────────────────────────────── port ◀──
//! server ── sealed datagrams ── feed ────────▶ watch (if the runtime sends no poses)
//! ```
//! The guardian hands its open port to the runtime. If it ends, or does not report for 0.3 s ([`pulse`]), the runtime
//! kills it and lands the vehicle over this port. Nothing else is sent that way.
//!
//! Four threads (one only prints), one lock, no allocation after the start (tested), no async. [`watch`] decides, sans-IO, by the same
//! rules as the bridge on the vehicle ([`vizflyt_protocol::failsafe`]). [`port`] carries bytes. [`client`] is the
//! runtime's end. Signals and keys that end the runtime do not reach the guardian.

mod channel;
pub mod client;
mod feed;
pub mod port;
pub mod pulse;
pub mod watch;

use std::io::{self, Write};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use nix::sys::signal::SigSet;
use nix::sys::socket::setsockopt;
use nix::sys::socket::sockopt::ReceiveTimeout;
use nix::sys::time::{TimeVal, TimeValLike};
use nix::time::{ClockId, clock_gettime};
use vizflyt_protocol::time::HostTime;

pub use channel::Feed;
pub use client::{Guardian, Message, SUBCOMMAND};

use channel::{MAX_MESSAGE, MessageKind, Received, Setup, put, put_port, take};
use feed::Subscription;
use port::{MavlinkAddress, Port};
use pulse::ALIVE_EVERY_S;
use watch::{Out, Watch};

/// Maximum wait for a message of the runtime: maximum delay of LAND. [ms]
const TICK_MS: i64 = 10;

/// Explanation and remedy if the port is in use.
const TAKEN: &str = ": by another runtime, a ground station, or the guardian of an earlier flight, which leaves when its vehicle stands";

/// State shared by the threads.
struct Shared {
    port: Port,
    watch: Mutex<Watch>,
    runtime: OwnedFd,
    feed: Mutex<Option<Feed>>,
    is_over: AtomicBool,
    /// Notes for standard error. Printed on a separate thread, because its reader may have stopped reading.
    notes: SyncSender<&'static str>,
}

/// Maximum number of notes that wait for the reader of standard error; further ones are dropped.
const NOTES: usize = 16;

/// Guards one flight on the port at `address`, in the format of `--mavlink`, with the runtime on standard input.
/// Returns when the flight is over and the vehicle is on the ground or lost.
pub fn run(address: &str) -> ExitCode {
    match try_run(address) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            complain(&error.to_string());
            ExitCode::FAILURE
        }
    }
}

fn try_run(address: &str) -> io::Result<()> {
    // Before any thread starts: every thread must inherit the blocked signals that end the runtime.
    SigSet::all().thread_block()?;
    let runtime = io::stdin().as_fd().try_clone_to_owned()?;
    let mut buffer = [0; MAX_MESSAGE];
    let Received::Message(MessageKind::Setup, setup) = take(runtime.as_fd(), &mut buffer) else {
        return Err(io::Error::other("the guardian is started by `vizflyt fly`, not by hand"));
    };
    let setup: Setup = postcard::from_bytes(setup).map_err(io::Error::other)?;
    let wanted = setup.wanted();
    let opened = address
        .parse::<MavlinkAddress>()
        .map_err(io::Error::other)
        .and_then(|address| Port::open(&address, wanted.clone()));
    let port = match opened {
        Ok(port) => port,
        Err(error) => {
            let advice = if error.kind() == io::ErrorKind::AddrInUse { TAKEN } else { "" };
            put(runtime.as_fd(), MessageKind::Refused, format!("{error}{advice}").as_bytes())?;
            return Ok(());
        }
    };
    put(runtime.as_fd(), MessageKind::Ready, port.local()?.as_bytes())?;
    setsockopt(&runtime, ReceiveTimeout, &TimeVal::milliseconds(TICK_MS))?;
    let (notes, printed) = sync_channel(NOTES);
    thread::Builder::new()
        .name("notes".into())
        .spawn(move || printed.iter().for_each(|note: &str| complain(note)))?;
    let shared = Arc::new(Shared {
        port,
        watch: Mutex::new(Watch::new(host_now(), wanted)),
        runtime,
        feed: Mutex::new(None),
        is_over: AtomicBool::new(false),
        notes,
    });
    for (name, body) in [("port", hear_autopilot as fn(&Shared)), ("poses", hear_poses)] {
        let shared = Arc::clone(&shared);
        thread::Builder::new().name(name.into()).spawn(move || body(&shared))?;
    }
    hear_runtime(&shared);
    Ok(())
}

/// Main thread: handles the runtime's packets and runs the clock.
fn hear_runtime(shared: &Shared) {
    let mut buffer = [0; MAX_MESSAGE];
    let mut has_ended = false;
    let mut alive_at = HostTime::ZERO;
    loop {
        let received = if has_ended {
            thread::sleep(Duration::from_millis(TICK_MS.unsigned_abs()));
            Received::Nothing
        } else {
            take(shared.runtime.as_fd(), &mut buffer)
        };
        let now = host_now();
        let mut watch = shared.watch();
        match received {
            Received::Message(MessageKind::Mavlink, packet) => {
                watch.handle_runtime(now, packet, &mut shared.out());
            }
            Received::Message(MessageKind::Feed, body) => {
                if let Ok(feed) = postcard::from_bytes(body) {
                    *shared.feed.lock().unwrap_or_else(PoisonError::into_inner) = Some(feed);
                }
            }
            Received::Message(..) | Received::Nothing => {}
            Received::Ended => {
                has_ended = true;
                watch.handle_end();
            }
        }
        watch.handle_timeout(now, &mut shared.out());
        if now >= alive_at {
            alive_at = now.plus_seconds(ALIVE_EVERY_S);
            let _ = put(shared.runtime.as_fd(), MessageKind::Alive, &[]);
        }
        if watch.is_over(now) {
            shared.is_over.store(true, Ordering::Relaxed);
            return;
        }
    }
}

/// Receives the autopilot's bytes, and forwards them to the runtime unchanged before decoding them.
fn hear_autopilot(shared: &Shared) {
    let mut buffer = [0; MAX_MESSAGE - 1];
    let mut shared_at = None;
    while !shared.is_over.load(Ordering::Relaxed) {
        let received = shared.port.receive(&mut buffer);
        // Before the packet: a runtime that knows the autopilot can also reach it without this process.
        let changes = Some(shared.port.changes());
        if shared_at != changes {
            let sent = shared.port.share().and_then(|port| put_port(shared.runtime.as_fd(), &port));
            shared_at = changes.filter(|_| sent.is_ok());
        }
        if let Some(intruder) = shared.port.poll_intruder() {
            let _ = put(shared.runtime.as_fd(), MessageKind::Note, intruder.to_string().as_bytes());
        }
        match received {
            Ok(Some(len)) => {
                // If the socket is full, telemetry is dropped, as on a network.
                let _ = put(shared.runtime.as_fd(), MessageKind::Mavlink, &buffer[..len]);
                shared.watch().handle_autopilot(host_now(), &buffer[..len]);
            }
            Ok(None) => {}
            // An unplugged device may come back.
            Err(_) => thread::sleep(Duration::from_millis(100)),
        }
    }
}

/// Receives poses once the runtime has sent their source.
fn hear_poses(shared: &Shared) {
    let mut subscription = None;
    while !shared.is_over.load(Ordering::Relaxed) {
        let Some(open) = &mut subscription else {
            subscription = Subscription::new(&shared.feed).ok().flatten();
            if subscription.is_none() {
                thread::sleep(Duration::from_millis(100));
            }
            continue;
        };
        if let Some((sample, stamp)) = open.receive(host_now, &shared.feed) {
            shared.watch().handle_pose(host_now(), &sample, stamp, &mut shared.out());
        }
    }
}

impl Shared {
    fn watch(&self) -> MutexGuard<'_, Watch> {
        self.watch.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn out(&self) -> PortOut<'_> {
        PortOut { port: &self.port, runtime: self.runtime.as_fd(), notes: &self.notes }
    }
}

/// Output of the watch: packets to the port, notes to standard error and to the runtime.
struct PortOut<'a> {
    port: &'a Port,
    runtime: BorrowedFd<'a>,
    notes: &'a SyncSender<&'static str>,
}

impl Out for PortOut<'_> {
    fn send(&mut self, packet: &[u8]) {
        self.port.send(packet);
    }

    fn say(&mut self, sentence: &'static str) {
        let _ = self.notes.try_send(sentence);
        let _ = put(self.runtime, MessageKind::Note, sentence.as_bytes());
    }
}

/// Writes a line to standard error; ignores errors, because the reader may have ended.
fn complain(line: &str) {
    let _ = writeln!(io::stderr(), "{line}");
}

/// Returns the time of the clock that also stamps the runtime's events: CLOCK_MONOTONIC.
fn host_now() -> HostTime {
    let time = clock_gettime(ClockId::CLOCK_MONOTONIC).expect("Linux has this clock");
    let ns = time.tv_sec() * 1_000_000_000 + time.tv_nsec();
    HostTime::from_ns(ns.unsigned_abs())
}
