//! One vehicle: what a runtime is told of it, its cameras, its lease, and how its flight goes.
//!
//! ```text
//! pose thread ----> pose (watch), track, events ----> session, page
//! previews -------> previews (watch) ---------------> page
//! session --------> telemetry (watch), events ------> page, pose thread (phase of flight)
//! page -----------> events (stop button) -----------> session
//! ```
//! Poses, telemetry and previews are latest-wins; events are a log that every reader reads whole.

mod control_lease;
mod track;

pub use control_lease::{ControlLease, RuntimeInfo, WatchLease};
pub use track::Track;

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

use tokio::sync::watch;
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::pose::PoseQuality;
use vizflyt_arena::verdict::{Verdict, judge};
use vizflyt_protocol::messages::{
    ArenaInfo, CameraInfo, Event, EventKind, FlightPhase, ImuReading, MAX_CAMERAS, Name,
    PoseSample, Telemetry, Timing, bounded,
};
use vizflyt_protocol::time::ServerTime;

use crate::clock;
use crate::flights::crash::{CrashCard, RecentPreviews};
use crate::flights::events::{EventLog, Origin};
use crate::flights::leaderboard::{Attempt, Samples};
use crate::lock::lock;
use crate::poses::drivers::SourceCounters;
use crate::render::cameras::{CameraSet, Cameras};
use crate::stats::{CameraDelivery, Connection};
use crate::stream::delivery::{CameraCounters, DeliveryStats};
use crate::stream::rate_control::{self, Level};
use crate::web::previews::Preview;

use control_lease::LeaseState;

/// One vehicle in the arena.
#[derive(Debug)]
pub struct Vehicle {
    /// Its place in [`Hub::vehicles`](crate::hub::Hub::vehicles).
    pub index: usize,
    /// The object in the localization system.
    pub name: Name,
    /// What the runtime gets to know; its cameras are those of the start, see [`Self::welcome`].
    pub arena: ArenaInfo,
    /// The cameras of this moment.
    pub cameras: Cameras,
    /// What happened to it.
    pub events: EventLog,
    /// The newest pose.
    pub pose: watch::Sender<Option<PoseSample>>,
    /// The runtime's newest report.
    pub telemetry: watch::Sender<Option<Telemetry>>,
    /// Where images get their age, by the runtime's newest report.
    pub timing: watch::Sender<Option<Timing>>,
    /// The newest previews, by camera.
    pub previews: Vec<watch::Sender<Option<Arc<Preview>>>>,
    /// The previews of the last seconds.
    pub shots: Mutex<RecentPreviews>,
    /// What its last failed flight looked like at its end.
    pub crash: watch::Sender<Option<Arc<CrashCard>>>,
    /// Where the vehicle was.
    pub track: Mutex<Track>,
    /// Where the present flight was, for its verdict.
    pub samples: Mutex<Samples>,
    /// Whose its next flights are.
    pub checked_in: Mutex<Option<CheckIn>>,
    /// What the localization delivered of it.
    pub source: Mutex<SourceCounters>,
    /// How good it is, by the pose filter.
    pub quality: Mutex<PoseQuality>,
    /// What its autopilot's IMU felt that the pose thread has not taken yet, oldest first.
    imu: Mutex<VecDeque<ImuReading>>,
    /// From the start of drawing until the plugin is given the image, by the runtime's newest
    /// report; 0 is not known. [ns]
    seen_after_ns: AtomicU64,
    /// Its images on their way.
    pub images: ImageCounters,
    /// How its images are made, by what its runtime's link carries: number of a [`pace::level`].
    pub level: AtomicUsize,
    lease: Mutex<LeaseState>,
    flight: Mutex<Flight>,
    delivery: Mutex<DeliveryStats>,
}

/// What became of a vehicle's images.
#[derive(Debug, Default)]
pub struct ImageCounters {
    /// Images that the runtime acknowledged.
    pub sent: AtomicU64,
    /// Images reset past their deadline or refused by the runtime.
    pub late: AtomicU64,
    /// Bytes of images acknowledged.
    pub bytes: AtomicU64,
    /// What became of each, by camera.
    pub cameras: [CameraCounters; MAX_CAMERAS],
}

/// A team that flies a vehicle.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckIn {
    /// Its name.
    pub team: String,
    /// What its flights count as.
    pub attempt: Attempt,
}

/// How the present flight goes.
#[derive(Clone, Debug, Default)]
pub struct Flight {
    /// When the runtime first reported taking off.
    pub took_off: Option<ServerTime>,
    /// When it first reported having landed.
    pub landed: Option<ServerTime>,
    /// The event that decided it: the first that makes the guard land.
    pub outcome: Option<Event>,
}

impl Vehicle {
    /// Makes the state of a vehicle of which nothing has been heard yet.
    pub fn new(index: usize, name: &str, arena: ArenaInfo, cameras: Cameras) -> Self {
        let count = cameras.newest().configs.len();
        Self {
            index,
            name: bounded(name),
            arena,
            cameras,
            events: EventLog::default(),
            pose: watch::Sender::new(None),
            telemetry: watch::Sender::new(None),
            timing: watch::Sender::new(None),
            previews: (0..count).map(|_| watch::Sender::new(None)).collect(),
            shots: Mutex::new(RecentPreviews::of(count)),
            crash: watch::Sender::new(None),
            track: Mutex::default(),
            samples: Mutex::default(),
            checked_in: Mutex::default(),
            source: Mutex::default(),
            quality: Mutex::default(),
            imu: Mutex::new(VecDeque::with_capacity(IMU_WAITING)),
            seen_after_ns: AtomicU64::new(0),
            images: ImageCounters::default(),
            level: AtomicUsize::new(0),
            lease: Mutex::default(),
            flight: Mutex::default(),
            delivery: Mutex::default(),
        }
    }

    /// Returns how its images are made now.
    pub fn level(&self) -> &'static Level {
        rate_control::level(self.level.load(Ordering::Relaxed))
    }

    /// Returns what a runtime is told of the arena, with the cameras `set`.
    pub fn welcome(&self, set: &CameraSet) -> ArenaInfo {
        ArenaInfo { cameras: set.infos.iter().cloned().collect(), ..self.arena.clone() }
    }

    /// Appends to the log what the server or the runtime noticed.
    pub fn log(&self, origin: Origin, event: Event) {
        self.judge(&event);
        self.events.push(origin, event);
    }

    /// Notes what decides the flight: the first event of those that end one. A lost pose decides
    /// only if nothing else does and it does not come back before the guard lands.
    fn judge(&self, event: &Event) {
        let phase = self.phase();
        let under_way = self.under_way();
        let mut flight = lock(&self.flight);
        let provisional =
            flight.outcome.as_ref().is_none_or(|e| matches!(e.kind, EventKind::PoseLost { .. }));
        match event.kind {
            EventKind::Collision { .. }
            | EventKind::Geofence { .. }
            | EventKind::Finished { .. }
            | EventKind::TimeLimit
            | EventKind::EmergencyStop
            | EventKind::PluginFailed
            | EventKind::Land
                if provisional =>
            {
                flight.outcome = Some(event.clone());
            }
            // On the ground a pose may come and go.
            EventKind::PoseLost { .. } if under_way => {
                flight.outcome.get_or_insert_with(|| event.clone());
            }
            EventKind::PoseRegained if provisional && phase != FlightPhase::Landing => {
                flight.outcome = None;
            }
            _ => {}
        }
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

    /// Takes the runtime's report of times.
    pub fn report_timing(&self, timing: Timing) {
        lock(&self.delivery).report(&timing.cameras);
        let seen = &timing.waterfall;
        let seen_after_ms = seen.age.p50 - seen.stages.pose.p50;
        if seen.images > 0 && seen_after_ms > 0.0 {
            self.seen_after_ns.store((f64::from(seen_after_ms) * 1e6) as u64, Ordering::Relaxed);
        }
        self.timing.send_replace(Some(timing));
    }

    /// Returns how long after the start of drawing the plugin is given an image, by the runtime's
    /// newest report. [s]
    pub fn seen_after_s(&self) -> Option<f64> {
        let ns = self.seen_after_ns.load(Ordering::Relaxed);
        (ns > 0).then_some(ns as f64 * 1e-9)
    }

    /// Takes what the autopilot's IMU felt; of more than wait, the oldest go.
    pub fn feel(&self, readings: &[ImuReading]) {
        let mut waiting = lock(&self.imu);
        for &reading in readings {
            if waiting.len() == IMU_WAITING {
                waiting.pop_front();
            }
            waiting.push_back(reading);
        }
    }

    /// Returns the oldest reading of the IMU that waits.
    pub fn next_feeling(&self) -> Option<ImuReading> {
        lock(&self.imu).pop_front()
    }

    /// Returns what became of the images of the present flight, by camera.
    pub fn accounts(&self) -> Vec<CameraDelivery> {
        let delivery = lock(&self.delivery);
        let cameras = self.arena.cameras.iter().zip(&self.images.cameras).enumerate();
        let account =
            |(index, (info, counters)): (usize, (&CameraInfo, &CameraCounters))| CameraDelivery {
                camera: info.name.as_str().to_owned(),
                account: delivery.account(index, counters),
            };
        cameras.map(account).collect()
    }

    /// Returns how the runtime's connection fares, if there is one.
    pub fn connection(&self) -> Option<Connection> {
        let state = self.lock_lease();
        let (connection, since) = state.connection.as_ref()?;
        Some(Connection::of(connection, *since))
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
        let mut verdict = judge(arena, &events, samples.kept());
        // Samples are 20 ms apart; what lay between them was swept.
        if let (Some(sampled_m), Some(swept_m)) =
            (verdict.min_clearance_m, samples.least_clearance_m())
        {
            verdict.min_clearance_m = Some(sampled_m.min(swept_m));
        }
        verdict
    }

    /// Logs something this server noticed; it goes to the runtime, the page and standard output.
    pub fn tell(&self, kind: EventKind, text: &str) {
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

    /// Returns the runtime that holds the lease.
    pub fn runtime(&self) -> Option<RuntimeInfo> {
        self.lock_lease().taken.clone()
    }

    /// Returns how many flights have begun: rises when a runtime takes the lease on the ground.
    pub fn flights(&self) -> u64 {
        self.lock_lease().flights
    }

    /// Returns the index of the present flight's first event.
    pub fn first_event(&self) -> u64 {
        self.lock_lease().flight_start
    }

    /// Presses the stop button; returns whether a runtime is there to obey.
    pub fn emergency_stop(&self, by: &str) -> bool {
        self.tell(EventKind::EmergencyStop, &format!("emergency stop pressed on {by}: land"));
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
        self.tell(EventKind::Start, &format!("start pressed on {by}"));
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
        self.tell(EventKind::Land, &format!("land pressed on {by}"));
        Ok(())
    }

    /// Begins the run anew, on the ground: course, clock, path and figures.
    ///
    /// # Errors
    /// The reason to refuse, for a person.
    pub fn reset(&self, by: &str) -> Result<(), String> {
        let mut state = self.lock_lease();
        if self.under_way() {
            return Err(format!("'{}' is {}; land it first", self.name, word(self.phase())));
        }
        self.begin(&mut state);
        drop(state);
        self.note(&format!("the run was reset on {by}"));
        Ok(())
    }

    /// Begins a flight.
    fn begin(&self, state: &mut LeaseState) {
        state.flights += 1;
        state.flight_start = self.events.next_index();
        self.telemetry.send_replace(None);
        self.timing.send_replace(None);
        lock(&self.delivery).begin(&self.images.cameras);
        lock(&self.track).clear();
        *lock(&self.samples) = Samples::default();
        *lock(&self.flight) = Flight::default();
    }

    /// Whether a flight had begun and not ended when its runtime was last heard.
    pub fn under_way(&self) -> bool {
        use FlightPhase::{Flying, Holding, Landing, TakingOff};
        matches!(self.phase(), TakingOff | Flying | Holding | Landing)
    }

    fn lock_lease(&self) -> MutexGuard<'_, LeaseState> {
        lock(&self.lease)
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

/// Readings of the IMU that wait for the pose thread at most: 0.6 s at 100 Hz.
const IMU_WAITING: usize = 64;
#[cfg(test)]
pub(crate) mod tests;
