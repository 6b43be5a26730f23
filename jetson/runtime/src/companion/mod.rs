//! The companion computer of one vehicle, sans-IO: [`link`](crate::link), [`flight`](crate::flight),
//! [`guard`](crate::guard) and [`steering`](crate::steering) joined into one state machine.
//!
//! ```text
//! MAVLink bytes ──────▶┌───────────┐──▶ MAVLink bytes, setpoints (50 to 200 Hz)
//! arena, poses, events▶│ Companion │──▶ events, IMU readings for the server
//! plugin's replies ───▶│           │──▶ messages for the plugin
//! now ────────────────▶└───────────┘──▶ senses, which go into every observation
//! ```
//! Two drivers run it: [`control`](crate::control) on the wall clock, with threads, sockets, a log and a
//! supervised plugin, and [`lockstep`](crate::lockstep) on a virtual clock, with a plugin that is waited
//! for. Every decision of a flight is made here, so the graded flight and the live one decide alike;
//! `control/tests.rs` feeds both drivers the same inputs and compares what they send.

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

/// Period of the ticks, in which the link does its chores. [ns]
const TICK_NS: i64 = 20_000_000;

/// A setpoint that was handed to the link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SentSetpoint {
    /// The setpoint.
    pub setpoint: GuidedSetpoint,
    /// The image whose reply it carries; the same as long as that reply is in force.
    pub replies_to: Option<u64>,
}

/// The companion computer of one vehicle. See the module.
pub struct Companion {
    settings: FlightSettings,
    clock: ServerClock,
    link: Link,
    flight: Flight,
    steering: Steering,
    arena: Option<Box<ArenaInfo>>,
    tick_due: HostTime,
    ticks: u64,
    /// Stamp of the newest IMU reading that was drained.
    imu_drained: HostTime,
    vehicle: Option<Vehicle>,
    v_setpoint_mps: DVec3,
    setpoints_sent: u64,
    /// Whether the present plugin process was greeted.
    is_greeted: bool,
    /// Whether the present plugin process took the place of another one.
    is_restarted: bool,
    link_events: VecDeque<LinkEvent>,
    events: VecDeque<Event>,
    to_plugin: VecDeque<ToPlugin>,
}

impl Companion {
    /// Makes the companion of a flight that begins at `now`; `clock` relates `now` to the server's stamps.
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

    /// Handles bytes from the autopilot, in any portions.
    pub fn handle_mavlink(&mut self, now: HostTime, bytes: &[u8]) {
        self.link.handle_input(now, bytes);
        self.handle_link_events(now);
        // Where the course gives the pose, attitude comes with it.
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

    /// Uploads the arena's fence to the autopilot, once the arena is known; reports what polygons cannot
    /// express.
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

    /// Handles the server's greeting, the first of a flight or one after an outage.
    pub fn handle_arena(&mut self, now: HostTime, mut arena: Box<ArenaInfo>) {
        // The plugin gets the limits that it is flown within.
        self.settings.tighten(&mut arena);
        self.flight.handle_arena(now, arena.clone());
        self.arena.get_or_insert(arena);
    }

    /// Handles a change of camera `index`. Images carry their own camera's description; this one is for a
    /// plugin that has not been greeted yet.
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

    /// Handles a sensor's reading: passes it on to the autopilot where the sensor says so.
    pub fn handle_reading(&mut self, now: HostTime, reading: &Reading) {
        let index = reading.header.sensor;
        let sensor = self.arena.as_ref().and_then(|arena| arena.sensors.get(usize::from(index)));
        if let Some(sensor) = sensor.filter(|sensor| sensor.to_autopilot) {
            self.link.reading(now, index, sensor, &reading.records);
        }
    }

    /// Handles a pose that the server has fused; `stamp` is its time on this computer's clock.
    pub fn handle_pose(&mut self, now: HostTime, sample: &PoseSample, stamp: HostTime) {
        self.link.vision(now, sample, stamp);
        self.flight.handle_pose(VehicleMotion::of(sample, stamp));
        // Before the course is known, no pose is let out.
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

    /// Handles an event of the server's, such as one of the referee.
    pub fn handle_event(&mut self, now: HostTime, event: &Event) {
        self.send_to_plugin(event);
        let at = self.clock.to_host(event.stamp).unwrap_or(now);
        self.flight.handle_event(now, event, at);
        // It may have ended the flight: LAND does not wait for the next setpoint's turn.
        self.steering.hurry();
    }

    /// Takes note that there is no connection to the server, or that it refuses us for now; `why` in a
    /// sentence, which stands in for the server's answer until it comes.
    pub fn server_down(&mut self, why: &str) {
        self.flight.server_down(why);
    }

    /// Ends the flight because it cannot be flown: the server refused it, or the plugin's shared memory
    /// cannot be made; `why` in a sentence.
    pub fn refuse(&mut self, now: HostTime, why: &str) {
        self.flight.refuse(now, why);
    }

    /// Ends the flight because a person interrupts it.
    pub fn interrupt(&mut self, now: HostTime) {
        self.flight.interrupt(now);
    }

    // ---- inputs: the plugin ----

    /// Greets a plugin process that has attached: puts the arena before all other messages to it.
    pub fn greet_plugin(&mut self, now: HostTime) {
        let Some(arena) = &self.arena else { return };
        self.to_plugin.push_back(ToPlugin::Start((**arena).clone()));
        self.is_greeted = true;
        // One that comes later learns where the flight is.
        if self.is_restarted {
            let stamp = self.clock.to_server(now);
            let kind = EventKind::Phase(self.flight.phase());
            let text = bounded("the plugin was started again");
            self.to_plugin.push_back(ToPlugin::Event(Event { stamp, kind, text }));
        }
    }

    /// The plugin process is gone, and another one will be greeted.
    pub fn plugin_gone(&mut self) {
        (self.is_greeted, self.is_restarted) = (false, true);
        self.to_plugin.clear();
    }

    /// The plugin waits for images.
    pub fn plugin_ready(&mut self) {
        self.flight.plugin_ready();
    }

    /// Observation `seq` went to the plugin; `views` tells how old its images are.
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

    /// The plugin has failed for good.
    pub fn plugin_failed(&mut self, now: HostTime, fault: PluginFault) {
        self.flight.plugin_failed(now, fault);
    }

    /// The plugin is being started again, and the vehicle holds until it replies; `why` in a sentence.
    pub fn plugin_restarts(&mut self, now: HostTime, why: String) {
        self.flight.plugin_restarts(now, why);
    }

    // ---- inputs: time, and notes of the driver's ----

    /// Returns when [`Self::handle_timeout`] is due next.
    pub fn poll_timeout(&self) -> HostTime {
        self.steering.due().min(self.tick_due)
    }

    /// Does what is due at `now`: lets the flight decide, and ticks the link. Returns the setpoint that was
    /// sent, if one was. A call before anything is due only collects events.
    pub fn handle_timeout(&mut self, now: HostTime) -> Option<SentSetpoint> {
        let sent = if now >= self.steering.due() { self.steer(now) } else { None };
        if now >= self.tick_due {
            // A stalled driver does not make up for lost ticks.
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

    /// Reports something that the driver noticed as an event of this companion.
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

    /// Returns the next event that this companion made; the server's are not repeated.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// Returns the next message for the plugin: the greeting, then events. They go before the next
    /// observation.
    pub fn poll_plugin(&mut self) -> Option<ToPlugin> {
        self.to_plugin.pop_front()
    }

    /// Calls `push` with each of the autopilot's IMU readings that is new, oldest first. Readings that
    /// cannot be placed on the server's clock yet are left out.
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

    /// Brings `senses` up to date.
    pub fn update_senses(&self, senses: &mut Senses) {
        let state = self.link.state();
        let (fraction, voltage_v) = (f64::from(state.battery_fraction), f64::from(state.battery_v));
        senses.vehicle = self.vehicle;
        // Before the course is known, no pose is let out.
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

    /// Returns the flight, for its phase and its end.
    pub fn flight(&self) -> &Flight {
        &self.flight
    }

    /// Returns the link, for the vehicle's state.
    pub fn link(&self) -> &Link {
        &self.link
    }

    /// Returns the arena, with the limits that are flown within.
    pub fn arena(&self) -> Option<&ArenaInfo> {
        self.arena.as_deref()
    }

    /// Whether the present plugin process was greeted.
    pub fn is_plugin_greeted(&self) -> bool {
        self.is_greeted
    }

    /// Returns the number of ticks so far; one every 20 ms.
    pub fn ticks(&self) -> u64 {
        self.ticks
    }

    /// Returns the velocity of the newest setpoint. [m/s, world]
    pub fn v_setpoint_mps(&self) -> DVec3 {
        self.v_setpoint_mps
    }

    /// Returns how many setpoints were sent.
    pub fn setpoints_sent(&self) -> u64 {
        self.setpoints_sent
    }

    // ---- private ----

    /// Lets the flight decide, and hands its orders to the link.
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

    /// Returns whether the course lets the plugin know where the vehicle is; `None` before the course is
    /// known.
    fn ground_truth(&self) -> Option<bool> {
        self.arena.as_ref().map(|arena| arena.ground_truth)
    }
}

impl std::fmt::Debug for Companion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Companion").field("phase", &self.flight.phase()).finish_non_exhaustive()
    }
}

/// Returns the event as the plugin may know it: without the place, in words too, where the course withholds
/// it.
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

/// Returns `text` without the coordinates of points: "at (1.00, 2.00, 0.50) m" becomes "at (withheld) m". A
/// phase's text repeats the sentence of what led to it, so all texts pass here.
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
