//! Leases of a vehicle: one runtime at a time, and several watchers.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use tokio::sync::Notify;
use vizflyt_protocol::messages::{Hello, ReceivedEvents, Text};
use vizflyt_protocol::time::ServerTime;

use vizflyt_process::lock;

/// Leases of one vehicle, and the number of its flights, which changes with them.
#[derive(Debug, Default)]
pub struct Leases(Arc<Mutex<State>>);

#[derive(Debug, Default)]
struct State {
    sessions: u64,
    holder: Option<RuntimeInfo>,
    /// Index of the first event of the present flight.
    first_event: u64,
    /// Random number of the present or last runtime.
    boot: u64,
    /// Received events of that runtime.
    received: ReceivedEvents,
    watchers: usize,
    /// Number of flights begun; the pose thread restarts its referee with each.
    flights: u64,
}

/// Runtime that flies the vehicle.
#[derive(Clone, Debug)]
pub struct RuntimeInfo {
    pub id: u64,
    pub address: SocketAddr,
    /// Name and version of the program.
    pub program: Text,
    received_ns: Arc<AtomicU64>,
    evicted: Arc<Notify>,
}

impl Leases {
    /// Grants control of the vehicle `vehicle` to a runtime at `now`.
    ///
    /// A runtime that has been silent for [`SILENT_S`] loses its lease to the new one: it is the same runtime
    /// after an outage, or it has died. If the former flight is `under_way`, or the new runtime is the one of
    /// that flight, the flight is resumed. Otherwise a new flight begins: `begin` resets the flight's state and
    /// returns the index of its first event.
    ///
    /// # Errors
    /// Reason of the refusal, for the user.
    pub(super) fn take_control(
        &self,
        vehicle: &str,
        hello: &Hello,
        address: SocketAddr,
        now: ServerTime,
        under_way: bool,
        begin: impl FnOnce() -> u64,
    ) -> Result<ControlLease, String> {
        let mut state = lock(&self.0);
        if let Some(holder) = &state.holder {
            let received = ServerTime::from_ns(holder.received_ns.load(Ordering::Relaxed));
            if !(now.seconds_since(received) > SILENT_S) {
                return Err(format!(
                    "vehicle '{vehicle}' is flown by {} at {}; stop that runtime first",
                    holder.program, holder.address
                ));
            }
            holder.evicted.notify_one();
        }
        state.sessions += 1;
        let resumed = under_way || state.boot == hello.boot;
        state.boot = hello.boot;
        if !resumed {
            state.flights += 1;
            state.first_event = begin();
        }
        let info = RuntimeInfo {
            id: state.sessions,
            address,
            program: hello.program.clone(),
            received_ns: Arc::new(AtomicU64::new(now.as_ns())),
            evicted: Arc::new(Notify::new()),
        };
        state.holder = Some(info.clone());
        Ok(ControlLease {
            leases: self.0.clone(),
            info,
            resumed,
            first_event: state.first_event,
            boot: hello.boot,
            received_events: state.received,
        })
    }

    /// Adds a watcher to the vehicle `vehicle`.
    ///
    /// # Errors
    /// Reason of the refusal, for the user.
    pub(super) fn watch(&self, vehicle: &str) -> Result<WatchLease, String> {
        let mut state = lock(&self.0);
        if state.watchers >= MAX_WATCHERS {
            return Err(format!(
                "vehicle '{vehicle}' has {MAX_WATCHERS} watchers already; end one first"
            ));
        }
        state.watchers += 1;
        state.sessions += 1;
        let (id, first_event) = (state.sessions, state.first_event);
        Ok(WatchLease { leases: self.0.clone(), id, first_event })
    }

    /// Begins a new flight of the same runtime, like [`Self::take_control`], unless `refuse` returns a reason.
    pub(super) fn restart(
        &self,
        refuse: impl FnOnce() -> Option<String>,
        begin: impl FnOnce() -> u64,
    ) -> Result<(), String> {
        let mut state = lock(&self.0);
        if let Some(reason) = refuse() {
            return Err(reason);
        }
        state.flights += 1;
        state.first_event = begin();
        Ok(())
    }

    /// Returns the runtime that has control.
    pub(super) fn holder(&self) -> Option<RuntimeInfo> {
        lock(&self.0).holder.clone()
    }

    /// Returns the number of flights begun.
    pub(super) fn flights(&self) -> u64 {
        lock(&self.0).flights
    }

    /// Returns the index of the present flight's first event.
    pub(super) fn first_event(&self) -> u64 {
        lock(&self.0).first_event
    }
}

/// Exclusive control of a vehicle; released when dropped.
#[derive(Debug)]
pub struct ControlLease {
    leases: Arc<Mutex<State>>,
    /// Runtime that has control.
    pub info: RuntimeInfo,
    /// Whether the flight continues after an outage.
    pub resumed: bool,
    /// Index of the first event to send.
    pub first_event: u64,
    /// Distinguishes this runtime's events from those of another run.
    boot: u64,
    /// Received events of the runtime.
    pub received_events: ReceivedEvents,
}

/// Right to watch a vehicle; released when dropped.
#[derive(Debug)]
pub struct WatchLease {
    leases: Arc<Mutex<State>>,
    pub id: u64,
    /// Index of the first event to send.
    pub first_event: u64,
}

impl Drop for WatchLease {
    fn drop(&mut self) {
        lock(&self.leases).watchers -= 1;
    }
}

impl ControlLease {
    /// Records that the runtime's event `seq` was received; returns whether it is new.
    pub fn receive_event(&self, seq: u64) -> bool {
        lock(&self.leases).received.receive(self.boot, seq)
    }

    /// Records that the runtime sent a message at `now`.
    pub fn renew(&self, now: ServerTime) {
        self.info.received_ns.store(now.as_ns(), Ordering::Relaxed);
    }

    /// Completes when another runtime has taken control.
    pub async fn evicted(&self) {
        self.info.evicted.notified().await;
    }
}

impl Drop for ControlLease {
    fn drop(&mut self) {
        let mut state = lock(&self.leases);
        if state.holder.as_ref().is_some_and(|holder| holder.id == self.info.id) {
            state.holder = None;
        }
    }
}

/// Maximum number of watchers per vehicle; each costs a connection and bandwidth.
pub const MAX_WATCHERS: usize = 8;
/// Silence after which a runtime may be replaced: it reports ten times a second, so ten missed reports are an
/// outage. [s]
const SILENT_S: f64 = 1.0;
