//! The control loop: one thread that owns link, flight and plugin, ticks at 50 Hz, sends each answer
//! of the plugin at once ([`crate::steering`]), and otherwise waits for what the other threads send. All safety decisions are made here, one at a time.
//!
//! ```text
//! stream (tokio) ─┐                             ┌─▶ MAVLink socket
//! MAVLink socket ─┤                             ├─▶ plugin (events, stop)
//! images ─────────┼─▶ Happening queue ─▶ loop ──┼─▶ server (telemetry 10 Hz, events)
//! plugin answers ─┤                             ├─▶ log
//! supervisor ─────┤                             └─▶ standard output
//! signals ────────┘
//! ```
//!
//! Why longer than most: it is where everything meets, and holds no logic of its own.

mod plugin;
mod telling;

use std::ffi::OsString;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender};
use std::sync::{Arc, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use glam::DVec3;
use serde_json::json;
use vizflyt_protocol::messages::{
    CameraInfo, Event, EventKind, FlightPhase, FromPlugin, ImuReading, PoseSample, ToPlugin,
    bounded,
};
use vizflyt_protocol::time::{HostTime, ServerTime};
use vizflyt_sdk::{Battery, ImuSample, Vehicle, host_now};

use crate::airframe::ArenaFence;
use crate::console::Screen;
use crate::flight::{Flight, FlightSettings, Input, LinkView, Outcome};
use crate::guard::Fix;
use crate::images::{Published, SharedSenses};
use crate::link::port::Port;
use crate::link::{Link, LinkEvent, LinkSettings};
use crate::log::{Channel, FlightLog};
use crate::report::Counters;
use crate::stats::ImageTimes;
use crate::steering::Steering;
use crate::stream::{Outbox, Shared, StreamEvent};
use crate::supervisor::{PluginEvent, PluginLimits, Stream};

use plugin::PluginSide;
pub use telling::print_line;

/// Something another thread tells the control loop.
#[derive(Debug)]
#[allow(clippy::large_enum_variant)] // Why: the queue of 0.7 MB is there anyway; a box is one per image.
pub enum Happening {
    /// Bytes from the autopilot.
    Mavlink(Vec<u8>),
    /// The server's side.
    Stream(StreamEvent),
    /// An observation is about to reach the plugin.
    Published(Published),
    /// The plugin says something.
    FromPlugin(Box<FromPlugin>),
    /// The plugin's process; the first is 0, each one started after it one more.
    Plugin(u32, PluginEvent),
    /// A person wants the plugin started anew; the vehicle holds until it is back.
    Reload,
    /// A person wants it to end.
    Interrupt,
}

/// Control ticks. Setpoints have a rhythm of their own.
const TICK: Duration = Duration::from_millis(20);
/// Reports to the server every so many ticks: 10 Hz.
const TELEMETRY_TICKS: u64 = 5;
/// Where images get their age, to the server every so many ticks: 1 Hz.
const TIMING_TICKS: u64 = 50;
/// Lines of the plugin that the page gets in a second; console and log get more.
const PAGE_LINES_PER_SECOND: u64 = 50;
/// Happenings waiting at most. Poses and telemetry come at some 300 a second, the loop takes them
/// within a tick.
pub const QUEUE: usize = 1024;

/// What the loop works with.
pub struct Control {
    /// The command that starts the plugin; empty if a person starts it.
    pub plugin_command: Vec<OsString>,
    /// What the plugin may use, and when it is started again.
    pub plugin_limits: PluginLimits,
    /// Limits of the flight as a whole.
    pub settings: FlightSettings,
    /// A person must press start before it takes off.
    pub waits_for_start: bool,
    /// The way to the autopilot.
    pub port: Arc<Port>,
    /// What a person has set of the link.
    pub link: LinkSettings,
    /// Clock and mailbox of the stream.
    pub shared: Shared,
    /// To the server.
    pub to_server: Arc<Outbox>,
    /// The log.
    pub log: FlightLog,
    /// Prints events as JSON.
    pub json: bool,
    /// Where people read, if not.
    pub screen: Screen,
}

/// What a flight leaves behind.
#[derive(Debug)]
pub struct Flown {
    /// How it ended.
    pub outcome: Outcome,
    /// The images.
    pub times: ImageTimes,
    /// The counters.
    pub counters: Counters,
    /// The log, still open.
    pub log: FlightLog,
}

struct Loop {
    control: Control,
    sender: SyncSender<Happening>,
    link: Link,
    flight: Flight,
    plugin: Option<PluginSide>,
    senses: SharedSenses,
    times: ImageTimes,
    published: u64,
    image_seq: u64,
    /// The server's tick of the newest image.
    image_tick: u64,
    image_size_px: (u32, u32),
    /// Answers that took longer than the plugin's deadline.
    overruns: u64,
    restarts: u32,
    /// Lines that went to the page in this second of ticks.
    page_lines: u64,
    setpoints_sent: u64,
    v_setpoint_mps: DVec3,
    steering: Steering,
    ticks: u64,
    /// When the newest IMU reading was made that the server was told of.
    imu_told: HostTime,
}

impl Control {
    /// Flies to the end. Call it on a thread that lives as long: the plugin dies with it.
    pub fn run(self, sender: SyncSender<Happening>, happenings: &Receiver<Happening>) -> Flown {
        let now = host_now();
        let mut flight = Flight::new(self.settings, now);
        if self.waits_for_start {
            flight.wait_for_start();
        }
        let link = Link::with(now, self.link.clone());
        let mut state = Loop {
            control: self,
            sender,
            link,
            flight,
            plugin: None,
            senses: SharedSenses::default(),
            times: ImageTimes::default(),
            published: 0,
            image_seq: 0,
            image_tick: 0,
            image_size_px: (0, 0),
            overruns: 0,
            restarts: 0,
            page_lines: 0,
            setpoints_sent: 0,
            v_setpoint_mps: DVec3::ZERO,
            steering: Steering::new(now),
            ticks: 0,
            imu_told: HostTime::ZERO,
        };
        let outcome = state.fly(happenings);
        state.finish(outcome, happenings)
    }
}

impl Loop {
    fn fly(&mut self, happenings: &Receiver<Happening>) -> Outcome {
        let mut next = Instant::now();
        loop {
            let to_steering_s = self.steering.due().seconds_since(host_now()).max(0.0);
            let to_tick = next.saturating_duration_since(Instant::now());
            match happenings.recv_timeout(to_tick.min(Duration::from_secs_f64(to_steering_s))) {
                Ok(happening) => {
                    self.take(happening);
                    self.transmit();
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => thread::sleep(TICK),
            }
            let now = host_now();
            if now >= self.steering.due() {
                self.steer(now);
            }
            if Instant::now() >= next {
                next += TICK;
                if next < Instant::now() {
                    // The machine stalled: do not make up for lost ticks.
                    next = Instant::now() + TICK;
                }
                self.tick(host_now());
            }
            if let Some(outcome) = self.flight.outcome() {
                return outcome.clone();
            }
        }
    }

    /// Lets the flight decide, and sends what it orders.
    fn steer(&mut self, now: HostTime) {
        let orders = self.flight.tick(now, &LinkView::of(&self.link, now));
        self.steering.done(now);
        self.link.set_goal(now, orders.goal);
        let Some(setpoint) = orders.setpoint else { return self.transmit() };
        let is_sent = self.link.setpoint(now, &setpoint);
        self.transmit();
        if is_sent {
            if let Some(seq) = orders.answers {
                self.times.sent(seq, host_now());
            }
            self.setpoints_sent += 1;
            self.log_sent(now, &setpoint);
        }
    }

    fn tick(&mut self, now: HostTime) {
        self.ticks += 1;
        self.link.handle_timeout(now);
        self.transmit();
        self.tend_plugin();
        self.tend_by_hand(now);
        self.tell_notices(now);
        if self.ticks.is_multiple_of(TELEMETRY_TICKS) {
            self.report(now);
        }
        if self.ticks.is_multiple_of(TIMING_TICKS) {
            self.page_lines = 0;
            self.report_timing(now);
        }
    }

    fn transmit(&mut self) {
        while let Some(datagram) = self.link.poll_transmit() {
            self.control.port.send(&datagram);
        }
        let now = host_now();
        while let Some(event) = self.link.poll_event() {
            match &event {
                LinkEvent::Text { text, .. } => tracing::info!("autopilot: {text}"),
                event => tracing::info!("link: {event:?}"),
            }
            self.flight.handle(now, Input::Link(event));
        }
    }

    // ---- what others tell ----

    fn take(&mut self, happening: Happening) {
        let now = host_now();
        match happening {
            Happening::Mavlink(bytes) => {
                self.link.handle_input(now, &bytes);
                self.sense();
            }
            Happening::Stream(event) => self.take_stream(now, event),
            Happening::Published(published) => {
                self.published += 1;
                (self.image_seq, self.image_tick) = (published.seq, published.tick);
                let Published { seq, pose, ready, mut images, .. } = published.clone();
                let clock_error_ns = self.control.shared.clock.error_bound_ns(now).unwrap_or(0);
                for image in &mut images {
                    image.clock_error_ns = clock_error_ns;
                }
                self.times.published(seq, pose, ready, images);
                self.flight.handle(now, Input::ImagePublished { seq: published.seq });
                self.control.log.write(
                    Channel::Image,
                    published.ready,
                    &json!({
                        "seq": published.seq, "tick": published.tick, "pose_ns": published.pose.as_ns(),
                        "received_ns": published.received.as_ns(),
                        "ready_ns": published.ready.as_ns()
                    }),
                );
            }
            Happening::FromPlugin(message) => self.take_plugin(now, *message),
            Happening::Plugin(_, PluginEvent::Line(stream, line)) => {
                self.take_line(now, stream, &line);
            }
            Happening::Plugin(_, PluginEvent::Note(text)) => {
                self.tell_event(now, EventKind::Note, &format!("plugin: {text}"));
            }
            Happening::Plugin(run, PluginEvent::Exited(sentence)) => {
                self.plugin_exited(now, run, sentence);
            }
            Happening::Reload => self.replace_plugin(now, "reloading the plugin".to_owned()),
            Happening::Interrupt => self.flight.handle(now, Input::Interrupt),
        }
    }

    fn take_stream(&mut self, now: HostTime, event: StreamEvent) {
        match event {
            StreamEvent::Welcome(mut arena) => {
                // The plugin gets the limits that it is flown within.
                self.control.settings.tighten(&mut arena);
                tracing::info!("server: arena {}", arena.name);
                self.flight.handle(now, Input::Arena(arena.clone()));
                let fence = ArenaFence::of(&arena);
                if let Some(gap) = fence.gap(&arena) {
                    self.tell_event(now, EventKind::Note, &gap);
                }
                self.link.set_fence(now, fence.polygons);
                if self.plugin.is_none() && self.flight.outcome().is_none() {
                    self.start_plugin(now, arena);
                }
            }
            StreamEvent::Refused(why) => self.flight.handle(now, Input::ServerRefused(why)),
            StreamEvent::Down(why) => tracing::warn!("{why}; trying again"),
            StreamEvent::Pose(sample, stamp) => self.take_pose(now, &sample, stamp),
            StreamEvent::Event(event) => {
                self.publish_event(now, &event);
                self.flight.handle(now, Input::Server(event));
                // It may have ended the flight: LAND does not wait for the next setpoint's turn.
                self.steering.hurry();
            }
            StreamEvent::Camera(index, camera) => self.take_camera(index, &camera),
        }
    }

    /// A camera was changed. Images say themselves how they were drawn; this is for a plugin that
    /// has not been greeted yet, and for the report.
    fn take_camera(&mut self, index: u8, camera: &CameraInfo) {
        let k = &camera.intrinsics;
        tracing::info!("camera {} is now {}x{} px", camera.name, k.width_px, k.height_px);
        if index == 0 {
            self.image_size_px = (k.width_px, k.height_px);
        }
        let side = self.plugin.as_mut().filter(|side| !side.started);
        if let Some(known) = side.and_then(|side| side.arena.cameras.get_mut(usize::from(index))) {
            *known = camera.clone();
        }
    }

    fn take_pose(&mut self, now: HostTime, sample: &PoseSample, stamp: HostTime) {
        self.link.vision(now, sample, stamp);
        self.flight.handle(now, Input::Pose(Fix::of(sample, stamp)));
        if self.gives_ground_truth() {
            let vehicle = Vehicle {
                stamp,
                attitude: sample.world_from_body.rotation,
                omega_body_radps: sample.twist.angular_radps,
                world_from_body: Some(sample.world_from_body),
                v_world_mps: Some(sample.twist.linear_mps),
            };
            self.senses.lock().unwrap_or_else(PoisonError::into_inner).vehicle = Some(vehicle);
        }
        self.control.log.pose(now, stamp, sample);
    }

    /// Whether the course lets the plugin know where the vehicle is. Before it is known, nothing is
    /// let out.
    fn gives_ground_truth(&self) -> bool {
        self.plugin.as_ref().is_some_and(|side| side.arena.ground_truth)
    }

    /// Passes on what the autopilot has told of battery, IMU and attitude.
    fn sense(&mut self) {
        let clock = &self.control.shared.clock;
        for sample in self.link.imu().iter().filter(|sample| sample.stamp > self.imu_told) {
            let stamp = clock.to_server(sample.stamp);
            if stamp > ServerTime::ZERO {
                let ImuSample { accel_mps2, gyro_radps, .. } = *sample;
                self.control.to_server.imu(ImuReading { stamp, accel_mps2, gyro_radps });
            }
        }
        self.imu_told = self.link.imu().back().map_or(self.imu_told, |newest| newest.stamp);
        let state = self.link.state();
        let (fraction, voltage_v) = (f64::from(state.battery_fraction), f64::from(state.battery_v));
        let withheld = self.plugin.is_some() && !self.gives_ground_truth();
        let mut senses = self.senses.lock().unwrap_or_else(PoisonError::into_inner);
        senses.battery = Battery {
            fraction: (fraction >= 0.0).then_some(fraction),
            voltage_v: (voltage_v > 0.0).then_some(voltage_v),
        };
        let newest = |imu: Option<&ImuSample>| imu.map(|sample| sample.stamp);
        if newest(self.link.imu().back()) != newest(senses.imu.last()) {
            senses.imu.clear();
            senses.imu.extend(self.link.imu());
        }
        // Where the course gives the pose, attitude comes with it.
        if let (true, Some(stamp)) = (withheld, self.link.attitude_at()) {
            senses.vehicle = Some(Vehicle {
                stamp,
                attitude: state.world_from_body,
                omega_body_radps: state.omega_body_radps,
                world_from_body: None,
                v_world_mps: None,
            });
        }
    }

    fn take_plugin(&mut self, now: HostTime, message: FromPlugin) {
        self.control.log.from_plugin(now, &message);
        // What a process said that is gone or going counts no more.
        let counts =
            self.plugin.as_ref().is_some_and(|side| side.started && side.leaving.is_none());
        match message {
            FromPlugin::Ready { .. } | FromPlugin::Answer { .. } if !counts => {}
            FromPlugin::Ready { name } => {
                tracing::info!("plugin {name} is ready");
                self.flight.handle(now, Input::PluginReady);
            }
            FromPlugin::Answer { seq, entered, returned, setpoint } => {
                let age_ms = self.times.answered(seq, entered, returned);
                if let Some(side) = &mut self.plugin {
                    side.by_hand_answered = side.by_hand_answered.map(|_| now);
                }
                self.check_deadline(now, seq, returned.seconds_since(entered) * 1e3);
                let asked = json!({"seq": seq, "setpoint": &setpoint});
                self.control.log.write(Channel::Asked, returned, &asked);
                if setpoint.is_some() {
                    self.steering.answered();
                }
                self.flight.handle(now, Input::Answered { seq, setpoint });
                self.control.log.write(
                    Channel::Image,
                    returned,
                    &json!({
                        "seq": seq, "entered_ns": entered.as_ns(),
                        "returned_ns": returned.as_ns(), "age_ms": age_ms
                    }),
                );
            }
            FromPlugin::Failed { reason } => {
                self.plugin_failed(now, format!("the plugin failed: {reason}"));
            }
        }
    }

    /// Shows by how much an answer was late: the first, then ever fewer.
    fn check_deadline(&mut self, now: HostTime, seq: u64, took_ms: f64) {
        let deadline_ms = self.control.plugin_limits.deadline_ms;
        if took_ms <= deadline_ms {
            return;
        }
        self.overruns += 1;
        if self.overruns.is_power_of_two() {
            let over_ms = took_ms - deadline_ms;
            let count = self.overruns;
            let text = format!(
                "on_image took {took_ms:.0} ms for image {seq}, {over_ms:.0} ms longer than the \
                 {deadline_ms:.0} ms of deadline_ms in [plugin] ({count} so far)"
            );
            self.tell_event(now, EventKind::Note, &text);
        }
    }

    fn take_line(&mut self, now: HostTime, stream: Stream, line: &str) {
        let stream = match stream {
            Stream::Stdout => "stdout",
            Stream::Stderr => "stderr",
        };
        let (tick, image_seq) = (self.image_tick, self.image_seq);
        let record = json!({"stream": stream, "line": line, "image_seq": image_seq, "tick": tick});
        self.control.log.line(now, stream, line, tick);
        if self.control.json {
            print_line(&json!({"plugin": record}).to_string());
        } else {
            self.control.screen.line(&format!("tick {tick} | {line}"));
        }
        self.page_lines += 1;
        if self.page_lines <= PAGE_LINES_PER_SECOND {
            let stamp = self.control.shared.clock.to_server(now);
            let text = bounded(&format!("tick {tick} | {line}"));
            self.control.to_server.tell(Event { stamp, kind: EventKind::PluginOutput, text });
        }
    }

    fn tell_event(&mut self, now: HostTime, kind: EventKind, text: &str) {
        let stamp = self.control.shared.clock.to_server(now);
        let event = Event { stamp, kind, text: bounded(text) };
        tracing::info!(target: "flight", "{text}");
        self.publish_event(now, &event);
        self.control.to_server.tell(event);
    }

    // ---- the end ----

    fn finish(mut self, outcome: Outcome, happenings: &Receiver<Happening>) -> Flown {
        let now = host_now();
        self.tell_notices(now);
        self.report(now);
        self.report_timing(now);
        let (clock, arrived) = (self.control.shared.clock.state(now), self.arrived());
        let whole = self.times.whole(now, clock, &arrived);
        self.control.log.write(Channel::Timing, now, &whole);
        debug_assert_eq!(self.flight.phase(), FlightPhase::Landed);
        if let Some(side) = self.plugin.take() {
            if side.ipc.plugin_attached() {
                let _ = side.ipc.send(&ToPlugin::Stop);
            }
            if let Some(supervisor) = &side.supervisor {
                supervisor.end();
            }
            side.ipc.clean_up();
            side.stop.store(true, Ordering::Relaxed);
            // Who drops the shared memory last removes its files, so they are waited for; and
            // heard out, as they may be waiting for room in the queue.
            for thread in side.threads {
                while !thread.is_finished() {
                    let _ = happenings.recv_timeout(Duration::from_millis(5));
                }
            }
        }
        self.control.screen.end();
        let counters = Counters {
            seconds: self.flight.seconds(now),
            image_size_px: self.image_size_px,
            setpoints_sent: self.setpoints_sent,
            mavlink_packets: self.link.packets(),
            plugin_overruns: self.overruns,
            plugin_restarts: self.restarts,
            clock,
            cameras: self.times.arrivals(&arrived).to_vec(),
        };
        Flown { outcome, times: self.times, counters, log: self.control.log }
    }
}
