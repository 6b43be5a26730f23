//! Who flies a vehicle, and who watches: one runtime at a time, some watchers beside it.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::Notify;
use vizflyt_protocol::messages::{HeardEvents, Hello, Text};
use vizflyt_protocol::time::ServerTime;

use super::Vehicle;
use crate::clock;
use crate::stream::subscriptions::MOST_WATCHERS;

#[derive(Debug, Default)]
pub(super) struct LeaseState {
    sessions: u64,
    pub(super) taken: Option<RuntimeInfo>,
    /// The runtime's connection, and when it began.
    pub(super) connection: Option<(quinn::Connection, ServerTime)>,
    /// Index of the first event of the present flight.
    pub(super) flight_start: u64,
    /// Drawn by lot by the runtime that sits, or sat last.
    boot: u64,
    /// What was heard of its events.
    heard: HeardEvents,
    watchers: usize,
    /// How many flights have begun; the pose thread starts its referee anew with each.
    pub(super) flights: u64,
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
    /// Gives the lease of the vehicle to a runtime.
    ///
    /// A runtime that has been silent for [`SILENT_S`] loses it to the newcomer: it is the same
    /// one after an outage, or it is dead. If the former flight was under way, or the newcomer is
    /// the runtime of that flight, it is told every event since that flight's start that it has not
    /// heard, so that no collision is lost with a connection. Otherwise a new flight begins.
    ///
    /// # Errors
    /// The reason to refuse, for a person.
    pub fn take_control(
        self: &Arc<Self>,
        hello: &Hello,
        address: SocketAddr,
    ) -> Result<ControlLease, String> {
        let now = clock::now();
        let mut state = self.lock_lease();
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
            self.begin(&mut state);
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
        Ok(ControlLease {
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
    pub fn watch(self: &Arc<Self>) -> Result<WatchLease, String> {
        let mut state = self.lock_lease();
        if state.watchers >= MOST_WATCHERS {
            return Err(format!(
                "vehicle '{}' has {MOST_WATCHERS} watchers already; end one first",
                self.name
            ));
        }
        state.watchers += 1;
        state.sessions += 1;
        let (id, first_event) = (state.sessions, state.flight_start);
        Ok(WatchLease { vehicle: self.clone(), id, first_event })
    }
}

/// The right to fly the vehicle; given back when dropped.
#[derive(Debug)]
pub struct ControlLease {
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
pub struct WatchLease {
    /// Which vehicle.
    pub vehicle: Arc<Vehicle>,
    /// Session number.
    pub id: u64,
    /// The first event to tell.
    pub first_event: u64,
}

impl Drop for WatchLease {
    fn drop(&mut self) {
        self.vehicle.lock_lease().watchers -= 1;
    }
}

impl ControlLease {
    /// Takes note of the runtime's event `seq`; returns whether it is new.
    pub fn hear(&self, seq: u64) -> bool {
        self.vehicle.lock_lease().heard.hear(self.boot, seq)
    }

    /// Notes that the runtime has been heard at `now`.
    pub fn heard(&self, now: ServerTime) {
        self.info.heard_ns.store(now.as_ns(), Ordering::Relaxed);
    }

    /// Notes over which connection the runtime speaks.
    pub fn speaks_over(&self, connection: &quinn::Connection) {
        let mut state = self.vehicle.lock_lease();
        if state.taken.as_ref().is_some_and(|taken| taken.id == self.info.id) {
            state.connection = Some((connection.clone(), clock::now()));
        }
    }

    /// Completes when a newcomer has taken the lease.
    pub async fn evicted(&self) {
        self.info.evicted.notified().await;
    }
}

impl Drop for ControlLease {
    fn drop(&mut self) {
        let mut state = self.vehicle.lock_lease();
        if state.taken.as_ref().is_some_and(|taken| taken.id == self.info.id) {
            state.taken = None;
            state.connection = None;
        }
    }
}

/// Runtimes report ten times a second; ten reports missed are an outage. [s]
const SILENT_S: f64 = 1.0;
