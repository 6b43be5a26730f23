//! One vehicle's flight: who controls it, its events, its course through the room, and its outcome.
//!
//! ```text
//! pose thread -> track, samples, events --> session, page
//! previews ----> recent previews ---------> crash card
//! session -----> telemetry (watch), events -> page, pose thread (phase of flight)
//! page --------> events (stop button) ----> session
//! ```
//! Telemetry is latest-wins; events are a log that every reader reads whole.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use tokio::sync::watch;
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::verdict::{Verdict, judge_ended};
use vizflyt_protocol::flight_end::FlightEnd;
use vizflyt_protocol::messages::{
    ArenaInfo, Event, EventKind, FlightPhase, Guarded, Hello, Name, Telemetry, bounded,
};
use vizflyt_protocol::time::ServerTime;

use super::check_in::CheckIn;
use super::control_lease::{ControlLease, Leases, RuntimeInfo, WatchLease};
use super::crash_card::CrashCard;
use super::events::{EventLog, Origin};
use super::recent_previews::RecentPreviews;
use super::samples::Samples;
use super::track::Track;
use crate::clock;
use vizflyt_process::lock;

/// One vehicle in the arena.
#[derive(Debug)]
pub struct VehicleFlight {
    /// Its index in the state of every room.
    pub index: usize,
    /// The object in the localization system.
    pub name: Name,
    /// The arena as the runtime receives it; its cameras are those of the start.
    pub arena: ArenaInfo,
    /// The events of all its flights.
    pub events: EventLog,
    /// The runtime's newest report.
    pub telemetry: watch::Sender<Option<Telemetry>>,
    /// What the runtime's guard keeps it within, as reported.
    pub guarded: watch::Sender<Option<Guarded>>,
    /// The server's events up to this number have reached the runtime; of the newest runtime.
    pub received: watch::Sender<u64>,
    /// The previews of the last seconds.
    pub previews: Mutex<RecentPreviews>,
    /// The crash card of its last failed flight.
    pub crash: watch::Sender<Option<Arc<CrashCard>>>,
    /// Where it was in this flight, for the page.
    pub track: Mutex<Track>,
    /// Where it was in this flight, for its verdict.
    pub samples: Mutex<Samples>,
    /// The team whose its next flights are.
    pub checked_in: Mutex<Option<CheckIn>>,
    leases: Leases,
    flight: Mutex<Flight>,
}

/// How the present flight goes.
#[derive(Clone, Debug, Default)]
pub struct Flight {
    /// When the runtime first reported taking off.
    pub took_off: Option<ServerTime>,
    /// When it first reported having landed.
    pub landed: Option<ServerTime>,
    /// How it ends, by all that happened so far.
    pub end: FlightEnd,
}

impl VehicleFlight {
    /// Returns the state of a vehicle that has not flown yet.
    pub fn new(index: usize, name: &str, arena: ArenaInfo) -> Self {
        let cameras = arena.cameras.len();
        Self {
            index,
            name: bounded(name),
            arena,
            events: EventLog::default(),
            telemetry: watch::Sender::new(None),
            guarded: watch::Sender::new(None),
            received: watch::Sender::new(0),
            previews: Mutex::new(RecentPreviews::of(cameras)),
            crash: watch::Sender::new(None),
            track: Mutex::default(),
            samples: Mutex::default(),
            checked_in: Mutex::default(),
            leases: Leases::default(),
            flight: Mutex::default(),
        }
    }

    /// Grants control to a runtime; see [`Leases::take_control`].
    ///
    /// # Errors
    /// The reason to refuse, for a person.
    pub fn take_control(&self, hello: &Hello, address: SocketAddr) -> Result<ControlLease, String> {
        let (now, under_way) = (clock::now(), self.under_way());
        self.leases.take_control(&self.name, hello, address, now, under_way, || self.begin())
    }

    /// Lets a watcher join.
    ///
    /// # Errors
    /// The reason to refuse, for a person.
    pub fn watch(&self) -> Result<WatchLease, String> {
        self.leases.watch(&self.name)
    }

    /// Appends to the log what the server or the runtime noticed.
    pub fn log(&self, origin: Origin, event: Event) {
        lock(&self.flight).end.handle(event.stamp, &event.kind);
        self.events.push(origin, event);
    }

    /// Takes the runtime's report.
    pub fn report(&self, report: Telemetry) {
        let now = clock::now();
        let phase = report.phase;
        self.telemetry.send_replace(Some(report));
        let mut flight = lock(&self.flight);
        if self.under_way() {
            flight.took_off.get_or_insert(now);
        } else if phase == FlightPhase::Landed && flight.took_off.is_some() {
            flight.landed.get_or_insert(now);
        }
    }

    /// Returns how the present flight goes.
    pub fn flight(&self) -> Flight {
        lock(&self.flight).clone()
    }

    /// Returns what happened in the present flight, in order; of a very long story the end.
    pub fn events_of_flight(&self) -> Vec<Event> {
        let mut cursor = self.first_event();
        let entries = self.events.read(&mut cursor).unwrap_or_else(|lagged| {
            cursor = lagged.oldest;
            self.events.read(&mut cursor).unwrap_or_default()
        });
        entries.into_iter().map(|entry| entry.event).collect()
    }

    /// Judges the present flight by all that happened so far.
    pub fn verdict(&self, arena: &ArenaConfig) -> Verdict {
        let events = self.events_of_flight();
        let samples = lock(&self.samples);
        let mut verdict = judge_ended(arena, &self.flight().end, &events, samples.kept());
        // Samples are 20 ms apart; what lay between them was swept.
        if let (Some(sampled_m), Some(swept_m)) =
            (verdict.min_clearance_m, samples.least_clearance_m())
        {
            verdict.min_clearance_m = Some(sampled_m.min(swept_m));
        }
        verdict
    }

    /// Logs something this server noticed; it goes to the runtime, the page and standard output.
    pub fn publish(&self, kind: EventKind, text: &str) {
        let event = Event { stamp: clock::now(), kind, text: bounded(text) };
        self.log(Origin::Server, event);
    }

    /// Logs something for the page alone; the runtime has no use for it.
    pub fn note(&self, text: &str) {
        let event = Event { stamp: clock::now(), kind: EventKind::Note, text: bounded(text) };
        self.log(Origin::Page, event);
    }

    /// Returns the phase of flight by the runtime's newest report.
    pub fn phase(&self) -> FlightPhase {
        self.telemetry.borrow().as_ref().map_or(FlightPhase::Connecting, |report| report.phase)
    }

    /// Returns the runtime that has control.
    pub fn runtime(&self) -> Option<RuntimeInfo> {
        self.leases.holder()
    }

    /// Returns how many flights have begun: rises when a runtime takes control on the ground.
    pub fn flights(&self) -> u64 {
        self.leases.flights()
    }

    /// Returns the index of the present flight's first event.
    pub fn first_event(&self) -> u64 {
        self.leases.first_event()
    }

    /// Presses the stop button; returns whether a runtime is there to obey.
    pub fn emergency_stop(&self, by: &str) -> bool {
        self.publish(EventKind::EmergencyStop, &format!("emergency stop pressed on {by}: land"));
        self.runtime().is_some()
    }

    /// Lets a runtime that waits for it take off.
    ///
    /// # Errors
    /// The reason to refuse, for a person.
    pub fn start(&self, by: &str) -> Result<(), String> {
        if self.runtime().is_none() {
            return Err(format!("no runtime flies '{}'; start one with --wait", self.name));
        }
        let phase = self.phase();
        if phase != FlightPhase::Waiting {
            return Err(format!(
                "'{}' does not wait for a start: it is {}",
                self.name,
                word(phase)
            ));
        }
        self.publish(EventKind::Start, &format!("start pressed on {by}"));
        Ok(())
    }

    /// Ends the flight: the vehicle brakes, then lands.
    ///
    /// # Errors
    /// The reason to refuse, for a person.
    pub fn land(&self, by: &str) -> Result<(), String> {
        if self.runtime().is_none() {
            return Err(format!("no runtime flies '{}': nobody to land it", self.name));
        }
        self.publish(EventKind::Land, &format!("land pressed on {by}"));
        Ok(())
    }

    /// Begins the run anew, on the ground: course, clock, path and figures.
    ///
    /// # Errors
    /// The reason to refuse, for a person.
    pub fn reset(&self, by: &str) -> Result<(), String> {
        let refuse = || {
            self.under_way()
                .then(|| format!("'{}' is {}; land it first", self.name, word(self.phase())))
        };
        self.leases.restart(refuse, || self.begin())?;
        self.note(&format!("the run was reset on {by}"));
        Ok(())
    }

    /// Forgets the former flight; returns the index of the first event of the new one.
    fn begin(&self) -> u64 {
        self.telemetry.send_replace(None);
        self.guarded.send_replace(None);
        lock(&self.track).clear();
        *lock(&self.samples) = Samples::default();
        *lock(&self.flight) = Flight::default();
        self.events.next_index()
    }

    /// Whether a flight had begun and not ended by its runtime's newest report.
    pub fn under_way(&self) -> bool {
        use FlightPhase::{Flying, Holding, Landing, TakingOff};
        matches!(self.phase(), TakingOff | Flying | Holding | Landing)
    }
}

/// Returns the phase in a word or two.
fn word(phase: FlightPhase) -> &'static str {
    match phase {
        FlightPhase::Connecting => "connecting",
        FlightPhase::Preparing => "preparing",
        FlightPhase::Waiting => "waiting for its start",
        FlightPhase::TakingOff => "taking off",
        FlightPhase::Flying => "flying",
        FlightPhase::Holding => "holding",
        FlightPhase::Landing => "landing",
        FlightPhase::Landed => "landed",
    }
}

#[cfg(test)]
pub(crate) mod tests;
