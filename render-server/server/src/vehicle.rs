//! One vehicle: what a runtime is told of it, its cameras, its seat, and how its flight goes.
//!
//! ```text
//! pose thread ----> pose (watch), trail, events ----> session, page
//! previews -------> previews (watch) ---------------> page
//! session --------> telemetry (watch), events ------> page, pose thread (phase of flight)
//! page -----------> events (stop button) -----------> session
//! ```
//! Poses, telemetry and previews are latest-wins; events are a log that every reader reads whole.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

use tokio::sync::{Notify, watch};
use vizflyt_protocol::messages::{
    ArenaInfo, CameraInfo, Event, EventKind, FlightPhase, HeardEvents, Hello, MAX_CAMERAS, Name,
    PoseSample, Telemetry, Text, Timing, bounded,
};
use vizflyt_protocol::time::ServerTime;

use crate::accounts::{Ledger, Tally};
use crate::cameras::{CameraSet, Cameras};
use crate::clock;
use crate::drivers::SourceCounters;
use crate::events::{EventLog, Origin};
use crate::hub::lock;
use crate::outlet::MOST_WATCHERS;
use crate::pace::{self, Level};
use crate::previews::Preview;
use crate::stats::{CameraAccount, Connection};

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
    /// Where the vehicle was.
    pub trail: Mutex<Trail>,
    /// What the localization delivered of it.
    pub source: Mutex<SourceCounters>,
    /// Its images on their way.
    pub images: ImageCounters,
    /// How its images are made, by what its runtime's link carries: number of a [`pace::level`].
    pub level: AtomicUsize,
    seat: Mutex<SeatState>,
    flight: Mutex<Flight>,
    ledger: Mutex<Ledger>,
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
    pub cameras: [Tally; MAX_CAMERAS],
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

#[derive(Debug, Default)]
struct SeatState {
    sessions: u64,
    taken: Option<RuntimeInfo>,
    /// The runtime's connection, and when it began.
    connection: Option<(quinn::Connection, ServerTime)>,
    /// Index of the first event of the present flight.
    flight_start: u64,
    /// Drawn by lot by the runtime that sits, or sat last.
    boot: u64,
    /// What was heard of its events.
    heard: HeardEvents,
    watchers: usize,
    /// How many flights have begun; the pose thread starts its referee anew with each.
    flights: u64,
}

/// The runtime that flies.
#[derive(Clone, Debug)]
pub struct RuntimeInfo {
    /// Session number.
    pub id: u64,
    /// Where it is.
    pub address: SocketAddr,
    /// Which program.
    pub program: Text,
    heard_ns: Arc<AtomicU64>,
    evicted: Arc<Notify>,
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
            trail: Mutex::default(),
            source: Mutex::default(),
            images: ImageCounters::default(),
            level: AtomicUsize::new(0),
            seat: Mutex::default(),
            flight: Mutex::default(),
            ledger: Mutex::default(),
        }
    }

    /// Returns how its images are made now.
    pub fn level(&self) -> &'static Level {
        pace::level(self.level.load(Ordering::Relaxed))
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
        lock(&self.ledger).report(&timing.cameras);
        self.timing.send_replace(Some(timing));
    }

    /// Returns what became of the images of the present flight, by camera.
    pub fn accounts(&self) -> Vec<CameraAccount> {
        let ledger = lock(&self.ledger);
        let cameras = self.arena.cameras.iter().zip(&self.images.cameras).enumerate();
        let account = |(index, (info, tally)): (usize, (&CameraInfo, &Tally))| CameraAccount {
            camera: info.name.as_str().to_owned(),
            account: ledger.account(index, tally),
        };
        cameras.map(account).collect()
    }

    /// Returns how the runtime's connection fares, if there is one.
    pub fn connection(&self) -> Option<Connection> {
        let state = self.lock_seat();
        let (connection, since) = state.connection.as_ref()?;
        Some(Connection::of(connection, *since))
    }

    /// Returns how the present flight goes.
    pub fn flight(&self) -> Flight {
        lock(&self.flight).clone()
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

    /// Returns the runtime that holds the seat.
    pub fn runtime(&self) -> Option<RuntimeInfo> {
        self.lock_seat().taken.clone()
    }

    /// Returns how many flights have begun: rises when a runtime takes the seat on the ground.
    pub fn flights(&self) -> u64 {
        self.lock_seat().flights
    }

    /// Presses the stop button; returns whether a runtime is there to obey.
    pub fn emergency_stop(&self, by: &str) -> bool {
        self.tell(EventKind::EmergencyStop, &format!("emergency stop pressed on {by}: land"));
        self.runtime().is_some()
    }

    /// Gives the seat of the vehicle to a runtime.
    ///
    /// A runtime that has been silent for [`SILENT_S`] loses it to the newcomer: it is the same
    /// one after an outage, or it is dead. If the former flight was under way, or the newcomer is
    /// the runtime of that flight, it is told every event since that flight's start that it has not
    /// heard, so that no collision is lost with a connection. Otherwise a new flight begins.
    ///
    /// # Errors
    /// The reason to refuse, for a person.
    pub fn sit(self: &Arc<Self>, hello: &Hello, address: SocketAddr) -> Result<Seat, String> {
        let now = clock::now();
        let mut state = self.lock_seat();
        if let Some(first) = &state.taken {
            let heard = ServerTime::from_ns(first.heard_ns.load(Ordering::Relaxed));
            if !(now.seconds_since(heard) > SILENT_S) {
                return Err(format!(
                    "vehicle '{}' is flown by {} at {}; stop that runtime first",
                    self.name, first.program, first.address
                ));
            }
            first.evicted.notify_one();
        }
        state.sessions += 1;
        let resumed = self.under_way() || state.boot == hello.boot;
        state.boot = hello.boot;
        if !resumed {
            state.flights += 1;
            state.flight_start = self.events.next_index();
            self.telemetry.send_replace(None);
            self.timing.send_replace(None);
            lock(&self.ledger).begin(&self.images.cameras);
            lock(&self.trail).clear();
            *lock(&self.flight) = Flight::default();
        }
        let info = RuntimeInfo {
            id: state.sessions,
            address,
            program: hello.program.clone(),
            heard_ns: Arc::new(AtomicU64::new(now.as_ns())),
            evicted: Arc::new(Notify::new()),
        };
        state.taken = Some(info.clone());
        state.connection = None;
        let heard_events = state.heard;
        let first_event = state.flight_start;
        Ok(Seat {
            vehicle: self.clone(),
            info,
            resumed,
            first_event,
            boot: hello.boot,
            heard_events,
        })
    }

    /// Lets someone watch.
    ///
    /// # Errors
    /// The reason to refuse, for a person.
    pub fn watch(self: &Arc<Self>) -> Result<WatcherSeat, String> {
        let mut state = self.lock_seat();
        if state.watchers >= MOST_WATCHERS {
            return Err(format!(
                "vehicle '{}' has {MOST_WATCHERS} watchers already; end one first",
                self.name
            ));
        }
        state.watchers += 1;
        state.sessions += 1;
        let (id, first_event) = (state.sessions, state.flight_start);
        Ok(WatcherSeat { vehicle: self.clone(), id, first_event })
    }

    /// Whether a flight had begun and not ended when its runtime was last heard.
    fn under_way(&self) -> bool {
        use FlightPhase::{Flying, Holding, Landing, TakingOff};
        matches!(self.phase(), TakingOff | Flying | Holding | Landing)
    }

    fn lock_seat(&self) -> MutexGuard<'_, SeatState> {
        lock(&self.seat)
    }
}

/// The right to fly the vehicle; given back when dropped.
#[derive(Debug)]
pub struct Seat {
    /// Which vehicle.
    pub vehicle: Arc<Vehicle>,
    /// Who sits.
    pub info: RuntimeInfo,
    /// Whether the flight goes on after an outage.
    pub resumed: bool,
    /// The first event to tell.
    pub first_event: u64,
    /// Tells this runtime's events from those of another run.
    boot: u64,
    /// What had been heard of the runtime's events.
    pub heard_events: HeardEvents,
}

/// The right to watch the vehicle; given back when dropped.
#[derive(Debug)]
pub struct WatcherSeat {
    /// Which vehicle.
    pub vehicle: Arc<Vehicle>,
    /// Session number.
    pub id: u64,
    /// The first event to tell.
    pub first_event: u64,
}

impl Drop for WatcherSeat {
    fn drop(&mut self) {
        self.vehicle.lock_seat().watchers -= 1;
    }
}

impl Seat {
    /// Takes note of the runtime's event `seq`; returns whether it is new.
    pub fn hear(&self, seq: u64) -> bool {
        self.vehicle.lock_seat().heard.hear(self.boot, seq)
    }

    /// Notes that the runtime has been heard at `now`.
    pub fn heard(&self, now: ServerTime) {
        self.info.heard_ns.store(now.as_ns(), Ordering::Relaxed);
    }

    /// Notes over which connection the runtime speaks.
    pub fn speaks_over(&self, connection: &quinn::Connection) {
        let mut state = self.vehicle.lock_seat();
        if state.taken.as_ref().is_some_and(|taken| taken.id == self.info.id) {
            state.connection = Some((connection.clone(), clock::now()));
        }
    }

    /// Completes when a newcomer has taken the seat.
    pub async fn evicted(&self) {
        self.info.evicted.notified().await;
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        let mut state = self.vehicle.lock_seat();
        if state.taken.as_ref().is_some_and(|taken| taken.id == self.info.id) {
            state.taken = None;
            state.connection = None;
        }
    }
}

/// The path of the vehicle since the flight began, thinned so that it stays small for ever.
#[derive(Debug)]
pub struct Trail {
    /// (x, y, z [m, world], speed [m/s]), oldest first.
    pub points: Vec<[f32; 4]>,
    spacing_m: f32,
}

impl Default for Trail {
    fn default() -> Self {
        Self { points: Vec::new(), spacing_m: LEAST_SPACING_M }
    }
}

impl Trail {
    /// Adds where the vehicle is, if it has moved enough.
    pub fn add(&mut self, sample: &PoseSample) {
        let p = sample.world_from_body.translation_m.as_vec3();
        let far = self
            .points
            .last()
            .is_none_or(|&[x, y, z, _]| p.distance(glam::Vec3::new(x, y, z)) >= self.spacing_m);
        if !far {
            return;
        }
        if self.points.len() >= MOST_POINTS {
            let mut keep = false;
            self.points.retain(|_| {
                keep = !keep;
                keep
            });
            self.spacing_m *= 2.0;
        }
        self.points.push([p.x, p.y, p.z, sample.twist.linear_mps.length() as f32]);
    }

    fn clear(&mut self) {
        *self = Self::default();
    }
}

/// Runtimes report ten times a second; ten reports missed are an outage. [s]
const SILENT_S: f64 = 1.0;
/// About the vehicle's radius. [m]
const LEAST_SPACING_M: f32 = 0.05;
/// 32 KB; 100 m of path at the finest spacing.
const MOST_POINTS: usize = 2048;

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use glam::{DQuat, DVec3};
    use vizflyt_protocol::geometry::{Pose, Twist, Volume};
    use vizflyt_protocol::messages::{Limits, Purpose};

    pub(crate) fn named(index: usize, name: &str) -> Vehicle {
        let arena = ArenaInfo {
            name: bounded("test"),
            geofence: Volume::aabb(DVec3::ZERO, DVec3::ONE),
            limits: Limits::new(1.0, 1.0),
            body_radius_m: 0.1,
            takeoff_height_m: 1.0,
            goal_m: None,
            goal_radius_m: 1.0,
            time_limit_s: 0.0,
            ground_truth: true,
            attitude_rate: false,
            cameras: [].into_iter().collect(),
        };
        let cameras = Cameras::new(Vec::new());
        Vehicle::new(index, name, arena, cameras)
    }

    fn vehicle() -> Arc<Vehicle> {
        Arc::new(named(0, "vizflyt"))
    }

    fn hello(boot: u64) -> Hello {
        Hello {
            vehicle: bounded("vizflyt"),
            purpose: Purpose::Fly,
            program: bounded("runtime 0.1"),
            boot,
            heard_events: HeardEvents::default(),
        }
    }

    fn address() -> SocketAddr {
        "127.0.0.1:9".parse().unwrap()
    }

    #[test]
    fn one_vehicle_has_one_runtime() {
        let vehicle = vehicle();
        let first = vehicle.sit(&hello(1), address()).unwrap();
        let refusal = vehicle.sit(&hello(2), address()).unwrap_err();
        assert_eq!(
            refusal,
            "vehicle 'vizflyt' is flown by runtime 0.1 at 127.0.0.1:9; stop that runtime first"
        );
        drop(first);
        assert!(vehicle.runtime().is_none());
        assert!(vehicle.sit(&hello(3), address()).is_ok());
    }

    #[tokio::test]
    async fn a_silent_runtime_loses_its_seat_and_the_newcomer_hears_the_flights_events() {
        let vehicle = vehicle();
        vehicle.tell(EventKind::Note, "before the flight");
        let first = vehicle.sit(&hello(4), address()).unwrap();
        assert_eq!((first.first_event, first.resumed, vehicle.flights()), (1, false, 1));
        vehicle.report(Telemetry { phase: FlightPhase::Flying, ..Telemetry::default() });
        vehicle.tell(EventKind::EmergencyStop, "stop");
        // As if it had last been heard two seconds ago.
        first.heard(clock::now().plus_seconds(-2.0));
        let second = vehicle.sit(&hello(5), address()).unwrap();
        first.evicted().await;
        assert_eq!((second.first_event, second.resumed, vehicle.flights()), (1, true, 1));
        drop(first);
        assert_eq!(vehicle.runtime().map(|runtime| runtime.id), Some(second.info.id));
        drop(second);
        // After the landing the next runtime begins a new flight.
        assert!(vehicle.flight().outcome.is_some_and(|event| event.text == "stop"));
        vehicle.report(Telemetry { phase: FlightPhase::Landed, ..Telemetry::default() });
        let third = vehicle.sit(&hello(6), address()).unwrap();
        assert_eq!((third.first_event, third.resumed, vehicle.flights()), (2, false, 2));
        assert!(vehicle.flight().outcome.is_none() && vehicle.telemetry.borrow().is_none());
    }

    #[test]
    fn the_same_runtime_goes_on_with_its_flight_and_tells_each_event_once() {
        let vehicle = vehicle();
        let first = vehicle.sit(&hello(7), address()).unwrap();
        assert!(first.hear(1) && first.hear(2) && !first.hear(1));
        drop(first);
        // An outage on the ground; the stop button is pressed meanwhile.
        vehicle.tell(EventKind::EmergencyStop, "stop");
        let second = vehicle.sit(&hello(7), address()).unwrap();
        assert_eq!((second.first_event, second.resumed, vehicle.flights()), (0, true, 1));
        assert_eq!(second.heard_events, HeardEvents { boot: 7, seq: 2 });
        assert!(!second.hear(2) && second.hear(3));
        drop(second);
        // Another run of the runtime: a new flight, and its events count anew.
        let third = vehicle.sit(&hello(8), address()).unwrap();
        assert_eq!((third.first_event, third.resumed, vehicle.flights()), (1, false, 2));
        assert_eq!(third.heard_events.of(8), 0);
        assert!(third.hear(1));
    }

    #[test]
    fn watchers_are_bounded_and_leave_room_behind() {
        let vehicle = vehicle();
        let mut watchers: Vec<_> = (0..MOST_WATCHERS).map(|_| vehicle.watch().unwrap()).collect();
        let refusal = vehicle.watch().unwrap_err();
        assert!(refusal.starts_with("vehicle 'vizflyt' has 8 watchers already"), "{refusal}");
        assert!(vehicle.sit(&hello(1), address()).is_ok(), "the runtime's seat is another");
        watchers.pop();
        assert!(vehicle.watch().is_ok());
    }

    #[test]
    fn the_first_decisive_event_is_the_outcome_and_a_lost_pose_only_if_it_stays_lost() {
        let vehicle = vehicle();
        let outcome = || vehicle.flight().outcome.map(|event| event.text.as_str().to_owned());
        let lost = EventKind::PoseLost { age_s: 0.2 };
        vehicle.tell(lost.clone(), "on the ground");
        assert_eq!(outcome(), None);
        vehicle.report(Telemetry { phase: FlightPhase::Flying, ..Telemetry::default() });
        vehicle.tell(lost.clone(), "a hiccup");
        assert_eq!(outcome().as_deref(), Some("a hiccup"));
        vehicle.tell(EventKind::PoseRegained, "back");
        assert_eq!(outcome(), None);
        vehicle.tell(lost.clone(), "lost");
        vehicle.tell(EventKind::Finished { seconds: 9.0 }, "goal");
        vehicle.tell(EventKind::EmergencyStop, "later");
        vehicle.tell(lost, "later still");
        assert_eq!(outcome().as_deref(), Some("goal"));
    }

    #[test]
    fn a_trail_keeps_its_ends_and_stays_small() {
        let mut trail = Trail::default();
        for k in 0..20_000 {
            trail.add(&PoseSample {
                stamp: ServerTime::ZERO,
                world_from_body: Pose::new(DVec3::X * 0.02 * f64::from(k), DQuat::IDENTITY),
                twist: Twist::default(),
                resets: 0,
            });
        }
        assert!(trail.points.len() <= MOST_POINTS);
        assert_eq!(trail.points[0][0], 0.0);
        assert!(trail.points.last().unwrap()[0] > 398.0);
        assert!(trail.points.is_sorted_by(|a, b| a[0] < b[0]));
    }
}
