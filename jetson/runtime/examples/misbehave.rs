//! A plugin that does what its first argument says, well or badly: for tests, and to see what the
//! vehicle does.
//!
//! `vizflyt fly target/release/examples/misbehave --server ... -- forward`

use std::process::{ExitCode, abort, exit};
use std::thread;
use std::time::Duration;

use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::{ArenaInfo, Autonomy, Axes, Event, Observation, Setpoint, YawTarget};

struct Misbehave {
    how: String,
    images: u64,
    flying: bool,
}

/// Images flown well before the fault.
const GOOD_IMAGES: u64 = 30;

impl Autonomy for Misbehave {
    fn on_start(&mut self, info: &ArenaInfo) {
        println!("flying in {} as {}", info.name, self.how);
    }

    fn on_image(&mut self, obs: &Observation<'_>) -> Option<Setpoint> {
        let forward =
            Setpoint::Velocity { v_mps: DVec3::X * 0.5, axes: Axes::Heading, yaw: YawTarget::Keep };
        // On the ground everyone behaves, unless it shall fail there.
        let late = self.how.strip_prefix("late-");
        self.images += u64::from(self.flying || late.is_none());
        if self.images <= GOOD_IMAGES && late.is_some() {
            return Some(forward);
        }
        match late.unwrap_or(&self.how) {
            "hover" => Some(Setpoint::Hold),
            "land" => Some(Setpoint::Land),
            "exit" => exit(0),
            "exit-3" => {
                eprintln!("no model file");
                exit(3)
            }
            "panic" => panic!("index {} out of range", obs.seq()),
            "abort" => abort(),
            "hang" => loop {
                thread::sleep(Duration::from_secs(1));
            },
            "nan" => Some(Setpoint::velocity(DVec3::NAN, YawTarget::Keep)),
            "silent" => None,
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
        if let vizflyt_sdk::EventKind::Phase(phase) = &event.kind {
            self.flying = matches!(
                phase,
                vizflyt_sdk::FlightPhase::Flying | vizflyt_sdk::FlightPhase::Holding
            );
        }
    }

    fn on_stop(&mut self) {
        println!("stopped after {} images", self.images);
    }
}

fn main() -> ExitCode {
    let how = std::env::args().nth(1).unwrap_or_default();
    vizflyt_sdk::run(Misbehave { how, images: 0, flying: false })
}
