//! The runtime on a virtual clock: the same [`link`](crate::link), [`flight`](crate::flight),
//! [`guard`](crate::guard) and [`steering`](crate::steering) as in
//! [`control`](crate::control), without threads, sockets and clock, and a plugin that is waited for.
//!
//! ```text
//! MAVLink bytes, poses, events, answers, now ──▶ Companion ──▶ MAVLink bytes, events,
//!                                                    │         what the plugin is told
//!                                                    └──▶ write(): senses into an observation
//! observation ──▶ PluginProcess (its own process, confined) ──▶ answer, after any time of ours
//! ```
//! Whoever calls it owns time: here nothing waits but [`PluginProcess`], for the plugin alone. So what
//! is decided depends on what goes in, not on how fast a computer is. Graded flights run on it
//! (`vizflyt grade`), and replays use the same process. Server and runtime are one computer here: their
//! clocks are one.

mod process;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;

use glam::DVec3;
use vizflyt_protocol::mavlink::{GuidedMotion, GuidedSetpoint};
use vizflyt_protocol::messages::{
    ArenaInfo, Event, EventKind, FlightPhase, ImuReading, PoseSample, Setpoint, ToPlugin, bounded,
};
use vizflyt_protocol::time::{HostTime, ServerTime};
use vizflyt_sdk::{Battery, ObservationWriter, Vehicle};

use crate::flight::{Flight, FlightSettings, Input, LinkView, Outcome};
use crate::guard::Fix;
use crate::link::{Datagram, Link, LinkSettings};
use crate::steering::Steering;

pub use process::{Hears, PluginProcess, ProcessError};

/// Chores of the link, as often as the control loop's. [ns]
const TICK_NS: i64 = 20_000_000;

/// A vehicle's runtime, sans-IO. See the module.
pub struct Companion {
    link: Link,
    flight: Flight,
    steering: Steering,
    arena: Box<ArenaInfo>,
    tick_due: HostTime,
    /// When the newest IMU reading was made that was passed on.
    imu_told: HostTime,
    vehicle: Option<Vehicle>,
    v_setpoint_mps: DVec3,
    setpoints_sent: u64,
    events: VecDeque<Event>,
    to_plugin: VecDeque<ToPlugin>,
}

impl Companion {
    /// Makes the runtime of a flight in `arena` that begins at `now`.
    pub fn new(now: HostTime, arena: &ArenaInfo, settings: FlightSettings) -> Self {
        let mut arena = Box::new(arena.clone());
        // The plugin gets the limits that it is flown within.
        settings.tighten(&mut arena);
        let mut flight = Flight::new(settings, now);
        flight.handle(now, Input::Arena(arena.clone()));
        let to_plugin = VecDeque::from([ToPlugin::Start((*arena).clone())]);
        Self {
            link: Link::with(now, LinkSettings::default()),
            flight,
            steering: Steering::new(now),
            arena,
            tick_due: now,
            imu_told: HostTime::ZERO,
            vehicle: None,
            v_setpoint_mps: DVec3::ZERO,
            setpoints_sent: 0,
            events: VecDeque::new(),
            to_plugin,
        }
    }

    // ---- what goes in ----

    /// Takes bytes from the autopilot.
    pub fn handle_mavlink(&mut self, now: HostTime, bytes: &[u8]) {
        self.link.handle_input(now, bytes);
        self.take_link_events(now);
        // Where the course gives the pose, attitude comes with it.
        if let (false, Some(stamp)) = (self.arena.ground_truth, self.link.attitude_at()) {
            let state = self.link.state();
            self.vehicle = Some(Vehicle {
                stamp,
                attitude: state.world_from_body,
                omega_body_radps: state.omega_body_radps,
                world_from_body: None,
                v_world_mps: None,
            });
        }
    }

    /// Takes a pose that the server has fused.
    pub fn handle_pose(&mut self, now: HostTime, sample: &PoseSample) {
        let stamp = HostTime::from_ns(sample.stamp.as_ns());
        self.link.vision(now, sample, stamp);
        self.flight.handle(now, Input::Pose(Fix::of(sample, stamp)));
        if self.arena.ground_truth {
            self.vehicle = Some(Vehicle {
                stamp,
                attitude: sample.world_from_body.rotation,
                omega_body_radps: sample.twist.angular_radps,
                world_from_body: Some(sample.world_from_body),
                v_world_mps: Some(sample.twist.linear_mps),
            });
        }
    }

    /// Takes what the server's referee noticed.
    pub fn handle_event(&mut self, now: HostTime, event: Event) {
        self.to_plugin.push_back(ToPlugin::Event(for_plugin(&event, &self.arena)));
        self.flight.handle(now, Input::Server(event));
        // As in flight: LAND does not wait for the next setpoint's turn.
        self.steering.hurry();
    }

    /// Takes note that the plugin waits for images.
    pub fn plugin_ready(&mut self, now: HostTime) {
        self.flight.handle(now, Input::PluginReady);
    }

    /// Takes note that observation `seq` went to the plugin.
    pub fn published(&mut self, now: HostTime, seq: u64) {
        self.flight.handle(now, Input::ImagePublished { seq });
    }

    /// Takes the plugin's answer to observation `seq`.
    pub fn answered(&mut self, now: HostTime, seq: u64, setpoint: Option<Setpoint>) {
        if setpoint.is_some() {
            self.steering.answered();
        }
        self.flight.handle(now, Input::Answered { seq, setpoint });
    }

    /// Takes note that the plugin is no more; why, in a sentence.
    pub fn plugin_failed(&mut self, now: HostTime, why: String) {
        self.flight.handle(now, Input::PluginFailed(why));
    }

    /// Does what is due at `now`. Call it at least every few milliseconds of virtual time; a call
    /// before anything is due changes nothing.
    pub fn handle_timeout(&mut self, now: HostTime) {
        if now >= self.steering.due() {
            self.steer(now);
        }
        if now >= self.tick_due {
            self.tick_due = self.tick_due.plus_ns(TICK_NS).max(now.plus_ns(1));
            self.link.handle_timeout(now);
            self.take_link_events(now);
        }
        while let Some(notice) = self.flight.poll_notice() {
            let stamp = ServerTime::from_ns(now.as_ns());
            let event = Event { stamp, kind: notice.kind, text: bounded(&notice.text) };
            self.to_plugin.push_back(ToPlugin::Event(for_plugin(&event, &self.arena)));
            self.events.push_back(event);
        }
    }

    // ---- what comes out ----

    /// Returns the next datagram to send to the autopilot.
    pub fn poll_transmit(&mut self) -> Option<Datagram> {
        self.link.poll_transmit()
    }

    /// Returns the next event that this runtime made, not those it was told.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// Returns the next message for the plugin: the greeting, then events. They go before the next
    /// observation.
    pub fn poll_plugin(&mut self) -> Option<ToPlugin> {
        self.to_plugin.pop_front()
    }

    /// Calls `take` with each of the autopilot's IMU readings that is new, oldest first.
    pub fn drain_imu(&mut self, mut take: impl FnMut(ImuReading)) {
        for sample in self.link.imu().iter().filter(|sample| sample.stamp > self.imu_told) {
            take(ImuReading {
                stamp: ServerTime::from_ns(sample.stamp.as_ns()),
                accel_mps2: sample.accel_mps2,
                gyro_radps: sample.gyro_radps,
            });
        }
        self.imu_told = self.link.imu().back().map_or(self.imu_told, |newest| newest.stamp);
    }

    /// Writes what the plugin may know beside images, as of now. What the course withholds is not
    /// in it.
    pub fn write(&self, writer: &mut ObservationWriter<'_>) {
        if let Some(vehicle) = &self.vehicle {
            writer.vehicle(vehicle);
        }
        let state = self.link.state();
        let (fraction, voltage_v) = (f64::from(state.battery_fraction), f64::from(state.battery_v));
        writer.battery(&Battery {
            fraction: (fraction >= 0.0).then_some(fraction),
            voltage_v: (voltage_v > 0.0).then_some(voltage_v),
        });
        writer.imu(self.link.imu());
    }

    /// Returns the phase of flight.
    pub fn phase(&self) -> FlightPhase {
        self.flight.phase()
    }

    /// Returns how the flight ended, once it is over.
    pub fn outcome(&self) -> Option<&Outcome> {
        self.flight.outcome()
    }

    /// Returns the velocity last asked of the autopilot. [m/s, world]
    pub fn v_setpoint_mps(&self) -> DVec3 {
        self.v_setpoint_mps
    }

    /// Returns how many setpoints were sent.
    pub fn setpoints_sent(&self) -> u64 {
        self.setpoints_sent
    }

    /// Lets the flight decide, and sends what it orders.
    fn steer(&mut self, now: HostTime) {
        let orders = self.flight.tick(now, &LinkView::of(&self.link, now));
        self.steering.done(now);
        self.link.set_goal(now, orders.goal);
        let Some(setpoint) = orders.setpoint else { return };
        if self.link.setpoint(now, &setpoint) {
            self.setpoints_sent += 1;
            let GuidedSetpoint { motion: GuidedMotion::Velocity(v_mps), .. } = setpoint else {
                return;
            };
            self.v_setpoint_mps = v_mps;
        }
    }

    fn take_link_events(&mut self, now: HostTime) {
        while let Some(event) = self.link.poll_event() {
            self.flight.handle(now, Input::Link(event));
        }
    }
}

impl std::fmt::Debug for Companion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Companion").field("phase", &self.flight.phase()).finish_non_exhaustive()
    }
}

/// Returns the event as the plugin may know it: without the place where the course withholds it.
pub(crate) fn for_plugin(event: &Event, arena: &ArenaInfo) -> Event {
    let mut event = event.clone();
    if !arena.ground_truth
        && let EventKind::Collision { p_world_m, .. } | EventKind::Geofence { p_world_m, .. } =
            &mut event.kind
    {
        *p_world_m = DVec3::ZERO;
    }
    event
}
