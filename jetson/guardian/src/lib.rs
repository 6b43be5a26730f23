//! The guardian: the last process of a flight to die. It owns the way to the autopilot, and it knows one thing to do:
//! where the vehicle is in the air and the runtime says nothing for half a second, or has ended, it orders LAND,
//! goes on with the heartbeats and, by a subscription of its own, with the poses, until the vehicle stands or a
//! pilot has taken it. It restarts nothing and plans nothing.
//!
//! ```text
//! runtime ── socket, one packet a message ──▶ watch ──▶ port ──▶ autopilot
//!         ◀────────────────────────────────────────── port ◀──
//! server ── sealed datagrams ── feed ────────▶ watch (where the runtime's poses have stopped)
//! ```
//! Three threads, one lock, no allocation once it runs (tested), no async. [`watch`] judges, sans-IO, by the same
//! rules as the bridge on the vehicle ([`vizflyt_protocol::failsafe`]); [`port`] carries bytes; [`client`] is the
//! runtime's end. Keys and signals that end the runtime do not reach it.

mod channel;
pub mod client;
mod feed;
pub mod port;
pub mod watch;

use std::io::{self, Write};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
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

use channel::{MAX_MESSAGE, MessageKind, Received, Setup, put, take};
use feed::Subscription;
use port::{MavlinkAddress, Port};
use watch::{Out, Watch};

/// Longest wait for the runtime: how late LAND may be. [ms]
const TICK_MS: i64 = 10;

/// What to do about a port that is in use.
const TAKEN: &str = ": by another runtime, a ground station, or the guardian of an earlier flight, which leaves when its vehicle stands";

/// What the threads share.
struct Shared {
    port: Port,
    watch: Mutex<Watch>,
    runtime: OwnedFd,
    feed: Mutex<Option<Feed>>,
    is_over: AtomicBool,
}

/// Guards one flight on the port at `address`, typed as after `--mavlink`, with the runtime on standard input.
/// Returns when nothing is left to do.
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
    // Before any thread: all of them are deaf to what ends the runtime.
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
    let shared = Arc::new(Shared {
        port,
        watch: Mutex::new(Watch::new(host_now(), wanted)),
        runtime,
        feed: Mutex::new(None),
        is_over: AtomicBool::new(false),
    });
    for (name, body) in [("port", hear_autopilot as fn(&Shared)), ("poses", hear_poses)] {
        let shared = Arc::clone(&shared);
        thread::Builder::new().name(name.into()).spawn(move || body(&shared))?;
    }
    hear_runtime(&shared);
    Ok(())
}

/// The main thread: the runtime's packets, and the clock.
fn hear_runtime(shared: &Shared) {
    let mut buffer = [0; MAX_MESSAGE];
    let mut has_ended = false;
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
        if watch.is_over(now) {
            shared.is_over.store(true, Ordering::Relaxed);
            return;
        }
    }
}

/// The autopilot's bytes: to the runtime first, whole as they came.
fn hear_autopilot(shared: &Shared) {
    let mut buffer = [0; MAX_MESSAGE - 1];
    while !shared.is_over.load(Ordering::Relaxed) {
        if let Some(intruder) = shared.port.poll_intruder() {
            let _ = put(shared.runtime.as_fd(), MessageKind::Note, intruder.to_string().as_bytes());
        }
        match shared.port.receive(&mut buffer) {
            Ok(Some(len)) => {
                // No room drops telemetry, as the network might.
                let _ = put(shared.runtime.as_fd(), MessageKind::Mavlink, &buffer[..len]);
                shared.watch().handle_autopilot(host_now(), &buffer[..len]);
            }
            Ok(None) => {}
            // A device that is gone comes back, perhaps.
            Err(_) => thread::sleep(Duration::from_millis(100)),
        }
    }
}

/// Poses, once the runtime has said where they come from.
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
        PortOut { port: &self.port, runtime: self.runtime.as_fd() }
    }
}

/// Where the watch's packets and sentences go.
struct PortOut<'a> {
    port: &'a Port,
    runtime: BorrowedFd<'a>,
}

impl Out for PortOut<'_> {
    fn send(&mut self, packet: &[u8]) {
        self.port.send(packet);
    }

    fn say(&mut self, sentence: &'static str) {
        complain(sentence);
        let _ = put(self.runtime, MessageKind::Note, sentence.as_bytes());
    }
}

/// A line for whoever still reads; nobody may.
fn complain(line: &str) {
    let _ = writeln!(io::stderr(), "{line}");
}

/// Returns the clock that the runtime stamps by: CLOCK_MONOTONIC.
fn host_now() -> HostTime {
    let time = clock_gettime(ClockId::CLOCK_MONOTONIC).expect("Linux has this clock");
    let ns = time.tv_sec() * 1_000_000_000 + time.tv_nsec();
    HostTime::from_ns(ns.unsigned_abs())
}
