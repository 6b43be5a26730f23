//! Flight of one vehicle: control, events, track, and outcome.
//!
//! ```text
//! pose thread -> track, samples, events --> session, page
//! previews ----> recent previews ---------> crash card
//! session -----> telemetry (watch), events -> page, pose thread (phase of flight)
//! page --------> events (stop button) ----> session
//! ```
//! Telemetry is latest-wins; events are a log that every reader reads completely.

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

/// Vehicle in the arena.
#[derive(Debug)]
pub struct VehicleFlight {
    /// Index of the vehicle in the state of every room.
    pub index: usize,
    /// Name of the vehicle, by default also of its object in the localization system.
    pub name: Name,
    /// Arena as sent to the runtime, with the cameras at the start.
    pub arena: ArenaInfo,
    /// Events of all flights.
    pub events: EventLog,
    /// Newest report of the runtime.
    pub telemetry: watch::Sender<Option<Telemetry>>,
    /// Limits and fence of the runtime's guard, as reported.
    pub guarded: watch::Sender<Option<Guarded>>,
    /// Number of the last server event that the newest runtime has received.
    pub received: watch::Sender<u64>,
    /// Previews of the last seconds.
    pub previews: Mutex<RecentPreviews>,
    /// Crash card of the last failed flight.
    pub crash: watch::Sender<Option<Arc<CrashCard>>>,
    /// Positions in this flight, for the page.
    pub track: Mutex<Track>,
    /// Positions in this flight, for its verdict.
    pub samples: Mutex<Samples>,
    /// Team of the next flights.
    pub checked_in: Mutex<Option<CheckIn>>,
    leases: Leases,
    flight: Mutex<Flight>,
}

/// State of the present flight.
#[derive(Clone, Debug, Default)]
pub struct Flight {
    /// Time of the runtime's first report of a take-off.
    pub took_off: Option<ServerTime>,
    /// Time of its first report after landing.
    pub landed: Option<ServerTime>,
    /// End of the flight, from all events so far.
    pub end: FlightEnd,
}

impl VehicleFlight {
    /// Creates the state of a vehicle before its first flight.
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
    /// Reason of the refusal, for the user.
    pub fn take_control(&self, hello: &Hello, address: SocketAddr) -> Result<ControlLease, String> {
        let (now, under_way) = (clock::now(), self.under_way());
        self.leases.take_control(&self.name, hello, address, now, under_way, || self.begin())
    }

    /// Adds a watcher.
    ///
    /// # Errors
    /// Reason of the refusal, for the user.
    pub fn watch(&self) -> Result<WatchLease, String> {
        self.leases.watch(&self.name)
    }

    /// Appends an event of the server or the runtime to the log.
    pub fn log(&self, origin: Origin, event: Event) {
        lock(&self.flight).end.handle(event.stamp, &event.kind);
        self.events.push(origin, event);
    }

    /// Processes the runtime's report.
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

    /// Returns the state of the present flight.
    pub fn flight(&self) -> Flight {
        lock(&self.flight).clone()
    }

    /// Returns the events of the present flight, in order; only the newest if there are too many.
    pub fn events_of_flight(&self) -> Vec<Event> {
        let mut cursor = self.first_event();
        let entries = self.events.read(&mut cursor).unwrap_or_else(|lagged| {
            cursor = lagged.oldest;
            self.events.read(&mut cursor).unwrap_or_default()
        });
        entries.into_iter().map(|entry| entry.event).collect()
    }

    /// Judges the present flight by all events so far.
    pub fn verdict(&self, arena: &ArenaConfig) -> Verdict {
        let events = self.events_of_flight();
        let samples = lock(&self.samples);
        let mut verdict = judge_ended(arena, &self.flight().end, &events, samples.kept());
        // Samples are 20 ms apart; the clearance between them was swept.
        if let (Some(sampled_m), Some(swept_m)) =
            (verdict.min_clearance_m, samples.least_clearance_m())
        {
            verdict.min_clearance_m = Some(sampled_m.min(swept_m));
        }
        verdict
    }

    /// Logs an event of this server, for the runtime, the page and standard output.
    pub fn publish(&self, kind: EventKind, text: &str) {
        let event = Event { stamp: clock::now(), kind, text: bounded(text) };
        self.log(Origin::Server, event);
    }

    /// Logs a note only for the page.
    pub fn note(&self, text: &str) {
        let event = Event { stamp: clock::now(), kind: EventKind::Note, text: bounded(text) };
        self.log(Origin::Page, event);
    }

    /// Returns the phase of flight from the runtime's newest report.
    pub fn phase(&self) -> FlightPhase {
        self.telemetry.borrow().as_ref().map_or(FlightPhase::Connecting, |report| report.phase)
    }

    /// Returns the runtime that has control.
    pub fn runtime(&self) -> Option<RuntimeInfo> {
        self.leases.holder()
    }

    /// Returns the number of flights begun; it rises when a runtime takes control on the ground.
    pub fn flights(&self) -> u64 {
        self.leases.flights()
    }

    /// Returns the index of the present flight's first event.
    pub fn first_event(&self) -> u64 {
        self.leases.first_event()
    }

    /// Triggers the emergency stop; returns whether a runtime is connected.
    pub fn emergency_stop(&self, by: &str) -> bool {
        self.publish(EventKind::EmergencyStop, &format!("emergency stop pressed on {by}: land"));
        self.runtime().is_some()
    }

    /// Starts a runtime that waits for its start.
    ///
    /// # Errors
    /// Reason of the refusal, for the user.
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
    /// Reason of the refusal, for the user.
    pub fn land(&self, by: &str) -> Result<(), String> {
        if self.runtime().is_none() {
            return Err(format!("no runtime flies '{}', so it cannot be landed", self.name));
        }
        self.publish(EventKind::Land, &format!("land pressed on {by}"));
        Ok(())
    }

    /// Restarts the run on the ground: course, clock, track and statistics.
    ///
    /// # Errors
    /// Reason of the refusal, for the user.
    pub fn reset(&self, by: &str) -> Result<(), String> {
        let refuse = || {
            self.under_way()
                .then(|| format!("'{}' is {}; land it first", self.name, word(self.phase())))
        };
        self.leases.restart(refuse, || self.begin())?;
        self.note(&format!("the run was reset on {by}"));
        Ok(())
    }

    /// Resets the flight's state; returns the index of the first event of the new flight.
    fn begin(&self) -> u64 {
        self.telemetry.send_replace(None);
        self.guarded.send_replace(None);
        lock(&self.track).clear();
        *lock(&self.samples) = Samples::default();
        *lock(&self.flight) = Flight::default();
        self.events.next_index()
    }

    /// Returns whether the runtime's newest report is of a flight in progress.
    pub fn under_way(&self) -> bool {
        use FlightPhase::{Flying, Holding, Landing, TakingOff};
        matches!(self.phase(), TakingOff | Flying | Holding | Landing)
    }
}

/// Returns the phase as text.
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
