//! Companion computer of one vehicle, sans-IO: combines [`link`](crate::link), [`flight`](crate::flight),
//! [`guard`](crate::guard) and [`steering`](crate::steering) into one state machine.
//!
//! ```text
//! MAVLink bytes ──────▶┌───────────┐──▶ MAVLink bytes, setpoints (50 to 200 Hz)
//! arena, poses, events▶│ Companion │──▶ events, IMU readings for the server
//! plugin's replies ───▶│           │──▶ messages for the plugin
//! now ────────────────▶└───────────┘──▶ senses, written into every observation
//! ```
//! It has two drivers: [`control`](crate::control) on the wall clock, with threads, sockets, a log and a supervised
//! plugin, and [`lockstep`](crate::lockstep) on a virtual clock, which waits for the plugin. All decisions of a flight
//! are made here, so that graded and live flights decide in the same way; `control/tests.rs` feeds the same inputs to
//! both drivers and compares their outputs.

mod senses;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;

use glam::DVec3;
use vizflyt_protocol::flight_end::PluginFault;
use vizflyt_protocol::mavlink::{GuidedMotion, GuidedSetpoint};
use vizflyt_protocol::messages::{
    ArenaInfo, CameraInfo, Event, EventKind, ImuReading, PoseSample, Setpoint, ToPlugin, bounded,
};
use vizflyt_protocol::sensor::SensorInfo;
use vizflyt_protocol::time::{HostTime, ServerTime};
use vizflyt_sdk::{Battery, ImuSample, Vehicle};

use crate::airframe::AutopilotFence;
use crate::flight::{Flight, FlightSettings, LinkView, Views};
use crate::guard::VehicleMotion;
use crate::link::{Datagram, Link, LinkEvent, LinkSettings};
use crate::steering::Steering;
use crate::stream::{Reading, ServerClock};

pub use senses::Senses;

/// Period of ticks, in which the link runs its periodic tasks. [ns]
const TICK_NS: i64 = 20_000_000;

/// Setpoint that was passed to the link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SentSetpoint {
    pub setpoint: GuidedSetpoint,
    /// Number of the image that the plugin answered with this setpoint; unchanged while the reply is in force.
    pub replies_to: Option<u64>,
}

/// Companion computer of one vehicle; see the module.
pub struct Companion {
    settings: FlightSettings,
    clock: ServerClock,
    link: Link,
    flight: Flight,
    steering: Steering,
    arena: Option<Box<ArenaInfo>>,
    tick_due: HostTime,
    ticks: u64,
    /// Stamp of the newest IMU reading already drained.
    imu_drained: HostTime,
    vehicle: Option<Vehicle>,
    v_setpoint_mps: DVec3,
    setpoints_sent: u64,
    /// Whether the current plugin process has received the arena.
    is_greeted: bool,
    /// Whether the current plugin process replaced an earlier one.
    is_restarted: bool,
    link_events: VecDeque<LinkEvent>,
    events: VecDeque<Event>,
    to_plugin: VecDeque<ToPlugin>,
}

impl Companion {
    /// Creates the companion of a flight that begins at `now`; `clock` converts `now` to the server's stamps.
    pub fn new(
        now: HostTime,
        settings: FlightSettings,
        link: LinkSettings,
        clock: ServerClock,
    ) -> Self {
        Self {
            flight: Flight::new(settings.clone(), now),
            settings,
            clock,
            link: Link::with(now, link),
            steering: Steering::new(now),
            arena: None,
            tick_due: now,
            ticks: 0,
            imu_drained: HostTime::ZERO,
            vehicle: None,
            v_setpoint_mps: DVec3::ZERO,
            setpoints_sent: 0,
            is_greeted: false,
            is_restarted: false,
            link_events: VecDeque::new(),
            events: VecDeque::new(),
            to_plugin: VecDeque::new(),
        }
    }

    /// Keeps the vehicle on the ground until a person presses start.
    pub fn wait_for_start(&mut self) {
        self.flight.wait_for_start();
    }

    // ---- inputs: the autopilot ----

    /// Handles bytes from the autopilot, in chunks of any size.
    pub fn handle_mavlink(&mut self, now: HostTime, bytes: &[u8]) {
        self.link.handle_input(now, bytes);
        self.handle_link_events(now);
        // If the course gives the pose, the attitude is part of it.
        if let (Some(false), Some(stamp)) = (self.ground_truth(), self.link.attitude_at()) {
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

    /// Ends the flight because the guardian has failed: LAND must not wait for the next setpoint.
    pub fn guardian_failed(&mut self, now: HostTime) {
        self.flight.guardian_failed(now);
        self.steering.hurry();
    }

    /// Uploads the arena's fence to the autopilot, if the arena is known; reports boxes that polygons cannot express.
    pub fn upload_fence(&mut self, now: HostTime) {
        let Some(arena) = &self.arena else { return };
        let fence = AutopilotFence::of(arena);
        let warning = fence.warning(arena);
        self.link.set_fence(now, fence.polygons);
        if let Some(warning) = warning {
            self.note(now, &warning);
        }
    }

    // ---- inputs: the server ----

    /// Handles the server's greeting: at the start of a flight, or after an outage.
    pub fn handle_arena(&mut self, now: HostTime, mut arena: Box<ArenaInfo>) {
        // The plugin receives the limits that apply in this flight.
        self.settings.tighten(&mut arena);
        self.flight.handle_arena(now, arena.clone());
        self.arena.get_or_insert(arena);
    }

    /// Handles a change of camera `index`. Images contain the description of their camera; this one is for a plugin
    /// that has not been greeted yet.
    pub fn handle_camera(&mut self, index: u8, camera: &CameraInfo) {
        let arena = self.arena.as_mut().filter(|_| !self.is_greeted);
        if let Some(known) = arena.and_then(|arena| arena.cameras.get_mut(usize::from(index))) {
            *known = camera.clone();
        }
    }

    /// Handles a change of sensor `index`.
    pub fn handle_sensor(&mut self, index: u8, sensor: &SensorInfo) {
        let arena = self.arena.as_mut();
        if let Some(known) = arena.and_then(|arena| arena.sensors.get_mut(usize::from(index))) {
            *known = sensor.clone();
        }
    }

    /// Handles a reading of a sensor: forwards it to the autopilot, if enabled for the sensor.
    pub fn handle_reading(&mut self, now: HostTime, reading: &Reading) {
        let index = reading.header.sensor;
        let sensor = self.arena.as_ref().and_then(|arena| arena.sensors.get(usize::from(index)));
        if let Some(sensor) = sensor.filter(|sensor| sensor.to_autopilot) {
            self.link.reading(now, index, sensor, &reading.records);
        }
    }

    /// Handles a fused pose from the server; `stamp` is its time on this computer's clock.
    pub fn handle_pose(&mut self, now: HostTime, sample: &PoseSample, stamp: HostTime) {
        self.link.vision(now, sample, stamp);
        self.flight.handle_pose(VehicleMotion::of(sample, stamp));
        // Before the course is known, no pose is published.
        if self.ground_truth() == Some(true) {
            self.vehicle = Some(Vehicle {
                stamp,
                attitude: sample.world_from_body.rotation,
                omega_body_radps: sample.twist.angular_radps,
                world_from_body: Some(sample.world_from_body),
                v_world_mps: Some(sample.twist.linear_mps),
            });
        }
    }

    /// Handles an event of the server, such as one of the referee.
    pub fn handle_event(&mut self, now: HostTime, event: &Event) {
        self.send_to_plugin(event);
        let at = self.clock.to_host(event.stamp).unwrap_or(now);
        self.flight.handle_event(now, event, at);
        // The event may have ended the flight: LAND must not wait for the next setpoint.
        self.steering.hurry();
    }

    /// Records that the server is not connected, or that it rejects us temporarily; `why` is a sentence, used in place
    /// of the server's reply.
    pub fn server_down(&mut self, why: &str) {
        self.flight.server_down(why);
    }

    /// Ends the flight because it is impossible: the server rejected it, or the plugin's shared memory cannot be
    /// created; `why` is a sentence.
    pub fn refuse(&mut self, now: HostTime, why: &str) {
        self.flight.refuse(now, why);
    }

    /// Ends the flight because a person interrupts it.
    pub fn interrupt(&mut self, now: HostTime) {
        self.flight.interrupt(now);
    }

    // ---- inputs: the plugin ----

    /// Greets a plugin process that has attached: queues the arena before all other messages to it.
    pub fn greet_plugin(&mut self, now: HostTime) {
        let Some(arena) = &self.arena else { return };
        self.to_plugin.push_back(ToPlugin::Start((**arena).clone()));
        self.is_greeted = true;
        // A plugin that attaches later also needs the phase.
        if self.is_restarted {
            let stamp = self.clock.to_server(now);
            let kind = EventKind::Phase(self.flight.phase());
            let text = bounded("the plugin was started again");
            self.to_plugin.push_back(ToPlugin::Event(Event { stamp, kind, text }));
        }
    }

    /// Handles the end of the plugin process, if another one will be greeted.
    pub fn plugin_gone(&mut self) {
        (self.is_greeted, self.is_restarted) = (false, true);
        self.to_plugin.clear();
    }

    /// Records that the plugin waits for images.
    pub fn plugin_ready(&mut self) {
        self.flight.plugin_ready();
    }

    /// Records that observation `seq` was sent to the plugin; `views` contains the ages of its images.
    pub fn published(&mut self, now: HostTime, seq: u64, views: Views) {
        self.flight.published(now, seq, views);
    }

    /// Handles the plugin's reply to observation `seq`.
    pub fn replied(&mut self, now: HostTime, seq: u64, setpoint: Option<Setpoint>) {
        if setpoint.is_some() {
            self.steering.replied();
        }
        self.flight.replied(now, seq, setpoint);
    }

    /// Ends the flight because the plugin has failed permanently.
    pub fn plugin_failed(&mut self, now: HostTime, fault: PluginFault) {
        self.flight.plugin_failed(now, fault);
    }

    /// Records that the plugin is restarting; the vehicle holds until it replies. `why` is a sentence.
    pub fn plugin_restarts(&mut self, now: HostTime, why: String) {
        self.flight.plugin_restarts(now, why);
    }

    // ---- inputs: time, and notes of the driver ----

    /// Returns when [`Self::handle_timeout`] is due next.
    pub fn poll_timeout(&self) -> HostTime {
        self.steering.due().min(self.tick_due)
    }

    /// Runs everything due at `now`: the flight's decision, and a tick of the link. Returns the setpoint that was sent,
    /// if any. A call before the due time only collects events.
    pub fn handle_timeout(&mut self, now: HostTime) -> Option<SentSetpoint> {
        let sent = if now >= self.steering.due() { self.steer(now) } else { None };
        if now >= self.tick_due {
            // After a stall, missed ticks are not made up for.
            self.tick_due = self.tick_due.plus_ns(TICK_NS).max(now.plus_ns(1));
            self.ticks += 1;
            self.link.handle_timeout(now);
            self.handle_link_events(now);
        }
        while let Some(notice) = self.flight.poll_notice() {
            self.report(now, notice.kind, &notice.text);
        }
        sent
    }

    /// Reports an observation of the driver as an event of this companion.
    pub fn note(&mut self, now: HostTime, text: &str) {
        self.report(now, EventKind::Note, text);
    }

    // ---- outputs ----

    /// Returns the next datagram to send to the autopilot.
    pub fn poll_transmit(&mut self) -> Option<Datagram> {
        self.link.poll_transmit()
    }

    /// Returns the next event of the link, for the driver's log.
    pub fn poll_link_event(&mut self) -> Option<LinkEvent> {
        self.link_events.pop_front()
    }

    /// Returns the next event of this companion; events of the server are not repeated.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// Returns the next message for the plugin: the greeting, then events. Send them before the next observation.
    pub fn poll_plugin(&mut self) -> Option<ToPlugin> {
        self.to_plugin.pop_front()
    }

    /// Calls `push` with each new IMU reading of the autopilot, oldest first. Skips readings with a time that cannot be
    /// converted to the server's clock yet.
    pub fn drain_imu(&mut self, mut push: impl FnMut(&ImuSample, ImuReading)) {
        for sample in self.link.imu().iter().filter(|sample| sample.stamp > self.imu_drained) {
            let stamp = self.clock.to_server(sample.stamp);
            if stamp > ServerTime::ZERO {
                let ImuSample { accel_mps2, gyro_radps, .. } = *sample;
                push(sample, ImuReading { stamp, accel_mps2, gyro_radps });
            }
        }
        self.imu_drained = self.link.imu().back().map_or(self.imu_drained, |newest| newest.stamp);
    }

    /// Updates `senses`.
    pub fn update_senses(&self, senses: &mut Senses) {
        let state = self.link.state();
        let (fraction, voltage_v) = (f64::from(state.battery_fraction), f64::from(state.battery_v));
        senses.vehicle = self.vehicle;
        // Before the course is known, no pose is published.
        senses.gives_pose = self.ground_truth() == Some(true);
        senses.battery = Battery {
            fraction: (fraction >= 0.0).then_some(fraction),
            voltage_v: (voltage_v > 0.0).then_some(voltage_v),
        };
        let newest = |imu: Option<&ImuSample>| imu.map(|sample| sample.stamp);
        if newest(self.link.imu().back()) != newest(senses.imu.last()) {
            senses.imu.clear();
            senses.imu.extend(self.link.imu());
        }
    }

    /// Returns the flight: its phase and its end.
    pub fn flight(&self) -> &Flight {
        &self.flight
    }

    /// Returns the link: the vehicle's state.
    pub fn link(&self) -> &Link {
        &self.link
    }

    /// Returns the arena with the limits that apply in this flight.
    pub fn arena(&self) -> Option<&ArenaInfo> {
        self.arena.as_deref()
    }

    /// Whether the current plugin process has been greeted.
    pub fn is_plugin_greeted(&self) -> bool {
        self.is_greeted
    }

    /// Returns the number of ticks, one every 20 ms.
    pub fn ticks(&self) -> u64 {
        self.ticks
    }

    /// Returns the velocity of the newest setpoint. [m/s, world]
    pub fn v_setpoint_mps(&self) -> DVec3 {
        self.v_setpoint_mps
    }

    /// Returns the number of setpoints sent.
    pub fn setpoints_sent(&self) -> u64 {
        self.setpoints_sent
    }

    // ---- private ----

    /// Runs a tick of the flight and passes its orders to the link.
    fn steer(&mut self, now: HostTime) -> Option<SentSetpoint> {
        let orders = self.flight.tick(now, &LinkView::of(&self.link, now));
        self.steering.done(now);
        self.link.set_goal(now, orders.goal);
        let setpoint = orders.setpoint?;
        if !self.link.setpoint(now, &setpoint) {
            return None;
        }
        self.setpoints_sent += 1;
        if let GuidedMotion::Velocity(v_mps) = setpoint.motion {
            self.v_setpoint_mps = v_mps;
        }
        Some(SentSetpoint { setpoint, replies_to: orders.replies_to })
    }

    fn handle_link_events(&mut self, now: HostTime) {
        while let Some(event) = self.link.poll_event() {
            self.link_events.push_back(event.clone());
            self.flight.handle_link(now, event);
        }
    }

    fn report(&mut self, now: HostTime, kind: EventKind, text: &str) {
        let stamp = self.clock.to_server(now);
        let event = Event { stamp, kind, text: bounded(text) };
        self.send_to_plugin(&event);
        self.events.push_back(event);
    }

    fn send_to_plugin(&mut self, event: &Event) {
        if let (true, Some(arena)) = (self.is_greeted, &self.arena) {
            self.to_plugin.push_back(ToPlugin::Event(for_plugin(event, arena)));
        }
    }

    /// Whether the course gives the pose to the plugin; `None` before the course is known.
    fn ground_truth(&self) -> Option<bool> {
        self.arena.as_ref().map(|arena| arena.ground_truth)
    }
}

impl std::fmt::Debug for Companion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Companion").field("phase", &self.flight.phase()).finish_non_exhaustive()
    }
}

/// Returns the event for the plugin: if the course withholds the pose, without positions, also in the text.
fn for_plugin(event: &Event, arena: &ArenaInfo) -> Event {
    let mut event = event.clone();
    if !arena.ground_truth {
        if let Some(p_world_m) = event.kind.place_mut() {
            *p_world_m = DVec3::ZERO;
        }
        event.text = bounded(&without_points(&event.text));
    }
    event
}

/// Returns `text` without coordinates of points: "at (1.00, 2.00, 0.50) m" becomes "at (withheld) m". All texts pass
/// through here, because the text of a phase repeats the reason for the phase.
fn without_points(text: &str) -> String {
    let mut parts = text.split('(');
    let mut kept = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let (inside, after) = part.split_at(part.find(')').unwrap_or(part.len()));
        let is_point = inside.split(',').count() > 1
            && inside.split(',').all(|number| number.trim().parse::<f64>().is_ok());
        kept.extend(["(", if is_point { "withheld" } else { inside }, after]);
    }
    kept
}
