//! Plugin with a selectable fault (first argument), for tests and to observe the vehicle's reaction.
//!
//! `vizflyt fly target/debug/examples/misbehave --server ... -- late-panic`
//!
//! With the prefix `late-` it flies well for a moment before. Several faults, separated by commas, follow
//! one another; the second argument names a file for the remaining ones, so that a restarted plugin
//! continues with the next. `world:3:0` requests 3 m/s east, regardless of the fence.

#![allow(unsafe_code, reason = "it misbehaves: a bad pointer, a fork")]

use std::ffi::OsString;
use std::fs;
use std::hint::black_box;
use std::path::PathBuf;
use std::process::{ExitCode, abort, exit};
use std::thread;
use std::time::Duration;

use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::ipc::{PluginEnd, SERVICE_OPTION};
use vizflyt_sdk::protocol::messages::{FromPlugin, ToPlugin, bounded};
use vizflyt_sdk::{
    ArenaInfo, Autonomy, Axes, Event, EventKind, FlightPhase, Observation, Setpoint, YawTarget,
    host_now,
};

struct Misbehave {
    how: Vec<String>,
    /// File that stores `how` for the next process.
    kept: Option<PathBuf>,
    images: u64,
    flying: bool,
    leaked: Vec<Vec<u8>>,
}

/// Number of images before the fault.
const GOOD_IMAGES: u64 = 20;
/// Size of the leak per image, for example by a list of all images. [bytes]
const LEAK: usize = 20_000_000;

impl Autonomy for Misbehave {
    fn on_start(&mut self, info: &ArenaInfo) {
        println!("flying in {} as {}", info.name, self.how.join(","));
    }

    fn on_image(&mut self, obs: &Observation<'_>) -> Option<Setpoint> {
        let forward =
            Setpoint::Velocity { v_mps: DVec3::X * 0.5, axes: Axes::Heading, yaw: YawTarget::Keep };
        // On the ground, only faults without `late-` occur.
        let now = self.how.first().map_or("forward", String::as_str);
        let late = now.strip_prefix("late-");
        self.images += u64::from(self.flying || late.is_none());
        if self.images <= GOOD_IMAGES && late.is_some() {
            return Some(forward);
        }
        let how = late.unwrap_or(now).to_owned();
        if self.images == GOOD_IMAGES + 1 {
            println!("now: {how}");
        }
        if self.how.len() > 1 {
            self.next();
        }
        if let Some(v_mps) = how.strip_prefix("world:").map(velocity) {
            return Some(Setpoint::velocity(v_mps, YawTarget::Keep));
        }
        match how.as_str() {
            "hover" => Some(Setpoint::Hold),
            "land" => Some(Setpoint::Land),
            "exit" => exit(0),
            "exit-3" => {
                eprintln!("no model file");
                exit(3)
            }
            "panic" => panic!("index {} out of range", obs.seq()),
            "abort" => abort(),
            "segfault" => {
                // SAFETY: none; the fault is intended.
                unsafe { black_box(std::ptr::without_provenance_mut::<u64>(8)).write_volatile(1) };
                None
            }
            "hang" => loop {
                thread::sleep(Duration::from_secs(1));
            },
            "spin" => loop {
                black_box(obs.seq());
            },
            "sleep" => {
                thread::sleep(Duration::from_secs(3));
                Some(forward)
            }
            "slow" => {
                thread::sleep(Duration::from_millis(150));
                Some(forward)
            }
            "leak" => {
                self.leaked.push(vec![1; LEAK]);
                Some(forward)
            }
            "fork" => loop {
                // SAFETY: the child runs only this loop.
                let _ = unsafe { nix::unistd::fork() };
            },
            "nan" => Some(Setpoint::velocity(DVec3::NAN, YawTarget::Keep)),
            "infinite" => Some(Setpoint::velocity(DVec3::INFINITY, YawTarget::Keep)),
            "outside" => {
                let p_world_m = DVec3::new(1000.0, 1000.0, 1000.0);
                Some(Setpoint::Position { p_world_m, yaw: YawTarget::Keep })
            }
            "lots" => {
                if self.images > 2 * GOOD_IMAGES {
                    let _ = nix::sys::signal::raise(nix::sys::signal::Signal::SIGKILL);
                }
                let since = std::time::UNIX_EPOCH.elapsed().unwrap_or_default();
                let drawn = f64::from(since.subsec_nanos()) * 1e-9;
                Some(Setpoint::Velocity {
                    v_mps: DVec3::X * drawn,
                    axes: Axes::Heading,
                    yaw: YawTarget::Keep,
                })
            }
            "silent" => None,
            "print" => loop {
                println!("{}", "x".repeat(5000));
            },
            "chatter" => {
                for line in 0..2000 {
                    println!("{line} {}", "x".repeat(5000));
                }
                Some(Setpoint::Hold)
            }
            _ => Some(forward),
        }
    }

    fn on_event(&mut self, event: &Event) {
        self.flying = flies(event).unwrap_or(self.flying);
    }

    fn on_stop(&mut self) {
        println!("stopped after {} images", self.images);
    }
}

impl Misbehave {
    /// Selects the next fault, after another moment of good flight.
    fn next(&mut self) {
        self.how.remove(0);
        self.images = 0;
        if let Some(kept) = &self.kept {
            fs::write(kept, self.how.join(",")).expect("the file can be written");
        }
    }
}

/// Parses a horizontal velocity `east:north`. [m/s, world]
fn velocity(text: &str) -> DVec3 {
    let (east, north) = text.split_once(':').expect("two numbers");
    let number = |text: &str| text.parse().expect("a number");
    DVec3::new(number(east), number(north), 0.0)
}

/// Whether the plugin flies the vehicle after this event; `None` for other events.
fn flies(event: &Event) -> Option<bool> {
    let EventKind::Phase(phase) = &event.kind else { return None };
    Some(matches!(phase, FlightPhase::Flying | FlightPhase::Holding))
}

/// Runs without the SDK's loop, and floods the runtime with setpoints or with invalid bytes.
fn go_round(how: &str, service: &str) -> ExitCode {
    let end = PluginEnd::open(service).expect("the runtime runs");
    let (mut flying, mut images) = (false, 0);
    loop {
        let _ = end.wait(Duration::from_millis(100));
        while let Ok(Some(message)) = end.receive() {
            match message {
                ToPlugin::Start(_) => {
                    let ready = FromPlugin::Ready { name: bounded(how) };
                    end.send(&ready).expect("the runtime reads");
                }
                ToPlugin::Event(event) => flying = flies(&event).unwrap_or(flying),
                ToPlugin::Stop => return ExitCode::SUCCESS,
            }
        }
        let Ok(Some(_)) = end.observation() else { continue };
        images += u64::from(flying);
        let (entered, returned, setpoint) = (host_now(), host_now(), Some(Setpoint::Hold));
        let answer = FromPlugin::Reply { seq: images, entered, returned, setpoint };
        if images <= GOOD_IMAGES {
            end.send(&answer).expect("the runtime reads");
            continue;
        }
        if images == GOOD_IMAGES + 1 {
            println!("now: {how}");
        }
        if how == "late-types" {
            let _ = end.send_bytes(b"\xff\xff\xff a list of strings, say");
        } else {
            // 10,000 a second.
            for _ in 0..10_000 {
                let _ = end.send(&answer);
                thread::sleep(Duration::from_micros(100));
            }
        }
    }
}

fn main() -> ExitCode {
    let arguments: Vec<OsString> = std::env::args_os().skip(1).collect();
    let text = |index: usize| arguments.get(index).map(|text| text.to_string_lossy().into_owned());
    let mut how = text(0).unwrap_or_default();
    let kept = text(1).filter(|text| !text.starts_with('-')).map(PathBuf::from);
    let service = arguments.iter().find_map(|argument| {
        Some(argument.to_str()?.strip_prefix(SERVICE_OPTION)?.strip_prefix('=')?.to_owned())
    });
    if let (Some(service), "late-flood" | "late-types") = (service, how.as_str()) {
        return go_round(&how, &service);
    }
    if let Some(left) = kept.as_ref().and_then(|kept| fs::read_to_string(kept).ok()) {
        how = left;
    }
    let how = how.split(',').map(str::to_owned).collect();
    vizflyt_sdk::run(Misbehave { how, kept, images: 0, flying: false, leaked: Vec::new() })
}
