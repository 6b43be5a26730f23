//! Driver of the companion on the wall clock: one thread drives a [`Companion`], waits for inputs of the other threads,
//! and forwards the outputs.
//!
//! ```text
//! stream (tokio) ─┐                                ┌─▶ MAVLink socket
//! MAVLink socket ─┤                                ├─▶ plugin (messages, stop)
//! images ─────────┼─▶ ControlInput queue ─▶ loop ──┼─▶ server (telemetry 10 Hz, events)
//! plugin replies ─┤                                ├─▶ log
//! supervisor ─────┤                                └─▶ standard output
//! signals ────────┘
//! ```
//! The loop wakes when the companion is due (ticks at 50 Hz, a setpoint at once after each reply) and for every input.
//! The decisions of the flight are in [`companion`](crate::companion). This module adds everything that needs the wall
//! clock: queues, the plugin's process ([`plugin`]) and reports ([`reporting`]).

mod plugin;
mod reporting;
#[cfg(test)]
mod tests;

use std::ffi::OsString;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender};
use std::thread;
use std::time::Duration;
use vizflyt_process::lock;

use plugin::PluginSide;
use serde_json::json;
use vizflyt_process::print_line;
use vizflyt_protocol::flight_end::EndReason;
use vizflyt_protocol::messages::{
    CameraInfo, Event, EventKind, FlightPhase, FromPlugin, ToPlugin, bounded,
};
use vizflyt_protocol::sensor::MAX_SENSORS;
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::host_now;

use crate::companion::Companion;
use crate::console::{Screen, printable};
use crate::flight::{FlightSettings, Views};
use crate::images::{Published, SharedSenses};
use crate::link::{FenceEvent, LinkEvent, LinkSettings};
use crate::log::{Channel, FlightLog};
use crate::odometry::OdometryGate;
use crate::report::Counters;
use crate::stats::ImageTimes;
use crate::stream::{Outbox, Shared, StreamEvent};
use crate::supervisor::{PluginEvent, PluginLimits, Stream};

/// Input of the control loop, sent by another thread.
#[derive(Debug)]
#[allow(clippy::large_enum_variant)] // Why: the queue of 0.7 MB exists anyway; a box costs one allocation per image.
pub enum ControlInput {
    /// Bytes from the autopilot.
    Mavlink(Vec<u8>),
    /// Event of the stream from the server.
    Stream(StreamEvent),
    /// An observation is about to be delivered to the plugin.
    Published(Published),
    /// Message from the plugin.
    FromPlugin(Box<FromPlugin>),
    /// Event of a plugin process; processes are numbered from 0.
    Plugin(u32, PluginEvent),
    /// The guardian has failed.
    GuardianFailed,
    /// Message of a driver for people.
    Note(String),
    /// Request to restart the plugin; the vehicle holds until it is back.
    Reload,
    /// Request to end the flight.
    Interrupt,
}

/// Ticks between reports to the server: 10 Hz.
const TELEMETRY_TICKS: u64 = 5;
/// Ticks between timing reports (stages of the image age) to the server: 1 Hz.
const TIMING_TICKS: u64 = 50;
/// Maximum lines of the plugin per second on the page; console and log get more.
const PAGE_LINES_PER_SECOND: u64 = 50;
/// Maximum number of waiting inputs. Poses and telemetry arrive at about 300 a second, and the loop handles them within
/// a tick.
pub const QUEUE: usize = 1024;
/// Period at which a loop without senders checks its clock.
const IDLE: Duration = Duration::from_millis(20);

/// Sends a datagram to the autopilot.
pub type SendMavlink = Box<dyn Fn(&[u8])>;

/// Resources of the loop.
pub struct Control {
    /// Command that starts the plugin; empty with `--attach`.
    pub plugin_command: Vec<OsString>,
    /// Resource limits and restart policy of the plugin.
    pub plugin_limits: PluginLimits,
    /// Settings of the flight.
    pub settings: FlightSettings,
    /// Whether a person must press start before the take-off.
    pub waits_for_start: bool,
    /// Connection to the autopilot.
    pub to_autopilot: SendMavlink,
    pub link: LinkSettings,
    /// Clock and mailbox of the stream.
    pub shared: Shared,
    /// Queue to the server.
    pub to_server: Arc<Outbox>,
    /// Flight log.
    pub log: FlightLog,
    /// Whether to print events as JSON.
    pub json: bool,
    /// Console output, without JSON.
    pub screen: Screen,
}

/// Result of a flight.
#[derive(Debug)]
pub struct FlightResult {
    /// Reason for the end.
    pub outcome: EndReason,
    /// Times of the images.
    pub times: ImageTimes,
    pub counters: Counters,
    /// Log, still open.
    pub log: FlightLog,
}

/// Control loop without clock and queue: inputs and `now` are arguments.
struct ControlLoop {
    control: Control,
    sender: SyncSender<ControlInput>,
    companion: Companion,
    plugin: Option<PluginSide>,
    senses: SharedSenses,
    times: ImageTimes,
    published: u64,
    image_seq: u64,
    /// Server's tick of the newest image.
    image_tick: u64,
    image_size_px: (u32, u32),
    /// Number of replies later than the plugin's deadline.
    overruns: u64,
    restarts: u32,
    /// Last explained silence of the plugin: its oldest image, and whether the vehicle lands.
    explained: Option<(u64, bool)>,
    /// Number of silences for which the vehicle has held.
    silences: u64,
    /// Lines sent to the page in the present second of ticks.
    page_lines: u64,
    odometry_gate: OdometryGate,
    /// Number of the companion's ticks.
    ticks: u64,
    /// Stamp of the newest reading of each sensor passed to the companion.
    readings_taken: [HostTime; MAX_SENSORS],
    /// Number of polygons that the autopilot has accepted for its fence.
    polygons: Option<u8>,
}

impl Control {
    /// Flies until the end. Call it on a thread that lives as long as the flight: the plugin ends with that thread.
    pub fn run(
        self,
        sender: SyncSender<ControlInput>,
        inputs: &Receiver<ControlInput>,
    ) -> FlightResult {
        let mut state = ControlLoop::new(host_now(), self, sender);
        let outcome = loop {
            let wait_s = state.companion.poll_timeout().seconds_since(host_now()).max(0.0);
            match inputs.recv_timeout(Duration::from_secs_f64(wait_s)) {
                Ok(input) => state.handle_all(input, inputs, host_now),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => thread::sleep(IDLE),
            }
            state.handle_timeout(host_now());
            if let Some(outcome) = state.companion.flight().outcome() {
                break outcome.clone();
            }
        };
        state.finish(host_now(), outcome, inputs)
    }
}

impl ControlLoop {
    fn new(now: HostTime, control: Control, sender: SyncSender<ControlInput>) -> Self {
        let (link, clock) = (control.link.clone(), control.shared.clock.clone());
        let mut companion = Companion::new(now, control.settings.clone(), link, clock);
        if control.waits_for_start {
            companion.wait_for_start();
        }
        Self {
            control,
            sender,
            companion,
            plugin: None,
            senses: SharedSenses::default(),
            times: ImageTimes::default(),
            published: 0,
            image_seq: 0,
            image_tick: 0,
            image_size_px: (0, 0),
            overruns: 0,
            restarts: 0,
            explained: None,
            silences: 0,
            page_lines: 0,
            odometry_gate: OdometryGate::default(),
            ticks: 0,
            readings_taken: [HostTime::ZERO; MAX_SENSORS],
            polygons: None,
        }
    }

    /// Handles an input and all further inputs in the queue. After a stall of this loop, a queued reply is thereby
    /// handled before the plugin counts as silent, and a queued pose before the last one counts as old.
    fn handle_all(
        &mut self,
        first: ControlInput,
        inputs: &Receiver<ControlInput>,
        now: impl Fn() -> HostTime,
    ) {
        for input in std::iter::once(first).chain(inputs.try_iter().take(QUEUE)) {
            self.handle(now(), input);
        }
    }

    /// Handles one input.
    fn handle(&mut self, now: HostTime, input: ControlInput) {
        match input {
            ControlInput::Mavlink(bytes) => {
                self.companion.handle_mavlink(now, &bytes);
                let (to_server, log) = (&self.control.to_server, &self.control.log);
                self.companion.drain_imu(|sample, reading| {
                    to_server.imu(reading);
                    log.imu(sample);
                });
                self.share_senses();
            }
            ControlInput::Stream(event) => self.handle_stream(now, event),
            ControlInput::Published(published) => self.handle_published(now, &published),
            ControlInput::FromPlugin(message) => self.handle_message(now, *message),
            ControlInput::Plugin(_, PluginEvent::Line(stream, line)) => {
                self.handle_line(now, stream, &line);
            }
            ControlInput::Plugin(_, PluginEvent::Note(text)) => {
                self.companion.note(now, &format!("plugin: {text}"));
            }
            ControlInput::Plugin(run, PluginEvent::Exited(sentence)) => {
                self.plugin_exited(now, run, sentence);
            }
            ControlInput::GuardianFailed => self.companion.guardian_failed(now),
            ControlInput::Note(text) => self.companion.note(now, &text),
            ControlInput::Reload => self.replace_plugin(now, "reloading the plugin".to_owned()),
            ControlInput::Interrupt => self.companion.interrupt(now),
        }
        self.pass_on(now);
    }

    /// Runs everything that is due.
    fn handle_timeout(&mut self, now: HostTime) {
        let sent = self.companion.handle_timeout(now);
        self.pass_on(now);
        if let Some(sent) = sent {
            if let Some(seq) = sent.replies_to {
                self.times.sent(seq, host_now());
            }
            self.log_sent(now, &sent.setpoint);
        }
        if self.companion.ticks() != self.ticks {
            self.ticks = self.companion.ticks();
            self.tick(now);
            self.pass_on(now);
        }
    }

    /// Runs the driver's own tasks of a tick.
    fn tick(&mut self, now: HostTime) {
        self.tend_plugin(now);
        self.tend_by_hand(now);
        self.explain_silence(now);
        self.take_readings(now);
        if self.ticks.is_multiple_of(TELEMETRY_TICKS) {
            self.report(now);
        }
        if self.ticks.is_multiple_of(TIMING_TICKS) {
            self.page_lines = 0;
            self.report_timing(now);
        }
    }

    /// Passes new sensor readings to the companion.
    fn take_readings(&mut self, now: HostTime) {
        if self.companion.arena().is_none_or(|arena| arena.sensors.is_empty()) {
            return;
        }
        let newest = self.control.shared.readings.newest();
        for (reading, taken) in newest.iter().zip(&mut self.readings_taken) {
            if let Some(reading) = reading.as_ref().filter(|one| one.shown > *taken) {
                *taken = reading.shown;
                self.companion.handle_reading(now, reading);
            }
        }
    }

    /// Forwards the outputs of the companion.
    fn pass_on(&mut self, now: HostTime) {
        while let Some(datagram) = self.companion.poll_transmit() {
            (self.control.to_autopilot)(&datagram);
        }
        while let Some(event) = self.companion.poll_link_event() {
            if let LinkEvent::Fence(FenceEvent::Accepted(polygons)) = event {
                self.polygons = u8::try_from(polygons).ok();
                self.report_guarded();
            }
            match &event {
                LinkEvent::Text { text, .. } => tracing::info!("autopilot: {text}"),
                LinkEvent::Neighbor(text) => tracing::info!("link: {text}"),
                event => tracing::info!("link: {event:?}"),
            }
        }
        while let Some(event) = self.companion.poll_event() {
            tracing::info!(target: "flight", "{}", event.text);
            self.show_event(now, &event);
            self.control.to_server.send_event(event);
        }
        while let Some(message) = self.companion.poll_plugin() {
            self.send_to_plugin(now, &message);
        }
    }

    // ---- inputs ----

    fn handle_stream(&mut self, now: HostTime, event: StreamEvent) {
        match event {
            StreamEvent::Welcome(arena) => {
                tracing::info!("server: arena {}", arena.name);
                self.companion.handle_arena(now, arena);
                // The first image may arrive before the first pose.
                self.share_senses();
                self.companion.upload_fence(now);
                self.report_guarded();
                if self.plugin.is_none() && self.companion.flight().outcome().is_none() {
                    self.start_plugin(now);
                }
            }
            StreamEvent::Refused(why) => self.companion.refuse(now, &why),
            StreamEvent::Down(why) => {
                tracing::warn!("{why}; trying again");
                self.companion.server_down(&why);
            }
            StreamEvent::Pose(sample, stamp) => {
                self.companion.handle_pose(now, &sample, stamp);
                self.share_senses();
                self.control.log.pose(now, stamp, &sample);
            }
            StreamEvent::Event(event) => {
                self.show_event(now, &event);
                self.companion.handle_event(now, &event);
            }
            StreamEvent::Camera(index, camera) => self.handle_camera(index, &camera),
            StreamEvent::Sensor(index, sensor) => {
                tracing::info!("sensor {} was changed", sensor.name);
                self.companion.handle_sensor(index, &sensor);
            }
            // Only for the guardian.
            StreamEvent::Feed(..) => {}
        }
    }

    fn handle_camera(&mut self, index: u8, camera: &CameraInfo) {
        let k = &camera.intrinsics;
        tracing::info!("camera {} is now {}x{} px", camera.name, k.width_px, k.height_px);
        if index == 0 {
            self.image_size_px = (k.width_px, k.height_px);
        }
        self.companion.handle_camera(index, camera);
    }

    fn share_senses(&self) {
        let mut senses = lock(&self.senses);
        self.companion.update_senses(&mut senses);
    }

    fn handle_published(&mut self, now: HostTime, published: &Published) {
        self.published += 1;
        (self.image_seq, self.image_tick) = (published.seq, published.tick);
        let Published { seq, pose, ready, mut images, .. } = published.clone();
        let clock_error_ns = self.control.shared.clock.error_bound_ns(now).unwrap_or(0);
        for image in &mut images {
            image.clock_error_ns = clock_error_ns;
        }
        let mut views = Views::default();
        for image in &images {
            if let Some(view) = views.get_mut(usize::from(image.camera)) {
                *view = Some(image.pose);
            }
        }
        self.times.published(seq, pose, ready, images);
        self.companion.published(now, seq, views);
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

    fn handle_message(&mut self, now: HostTime, message: FromPlugin) {
        self.control.log.from_plugin(now, &message);
        // Ignore messages of a process that has ended or is ending.
        let is_leaving = self.plugin.as_ref().is_none_or(|side| side.leaving.is_some());
        let counts = self.companion.is_plugin_greeted() && !is_leaving;
        match message {
            FromPlugin::Ready { .. } | FromPlugin::Reply { .. } if !counts => {}
            FromPlugin::Ready { name } => {
                tracing::info!("plugin {} is ready", printable(&name));
                self.companion.plugin_ready();
            }
            FromPlugin::Reply { seq, entered, returned, setpoint } => {
                let age_ms = self.times.answered(seq, entered, returned);
                if let Some(side) = &mut self.plugin {
                    side.by_hand_replied = side.by_hand_replied.map(|_| now);
                }
                self.check_deadline(now, seq, returned.seconds_since(entered) * 1e3);
                let asked = json!({"seq": seq, "setpoint": &setpoint});
                self.control.log.write(Channel::Requested, returned, &asked);
                self.companion.replied(now, seq, setpoint);
                self.control.log.write(
                    Channel::Image,
                    returned,
                    &json!({
                        "seq": seq, "entered_ns": entered.as_ns(),
                        "returned_ns": returned.as_ns(), "age_ms": age_ms
                    }),
                );
            }
            FromPlugin::Odometry(odometry) => {
                if counts && self.odometry_gate.takes(now, &odometry) {
                    self.control.log.odometry(now, &odometry);
                }
            }
            FromPlugin::Failed { reason } => {
                self.plugin_failed(now, format!("the plugin failed: {}", printable(&reason)));
            }
        }
    }

    /// Reports a reply that missed the deadline: at 1, 2, 4, 8 ... occurrences.
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
            self.companion.note(now, &text);
        }
    }

    fn handle_line(&mut self, now: HostTime, stream: Stream, line: &str) {
        let stream = match stream {
            Stream::Stdout => "stdout",
            Stream::Stderr => "stderr",
        };
        let (tick, image_seq) = (self.image_tick, self.image_seq);
        let record = json!({"stream": stream, "line": line, "image_seq": image_seq, "tick": tick});
        self.control.log.line(now, stream, line, tick);
        if self.control.json {
            print_line(json!({"plugin": record}));
        } else {
            self.control.screen.line(&format!("tick {tick} | {line}"));
        }
        self.page_lines += 1;
        if self.page_lines <= PAGE_LINES_PER_SECOND {
            let stamp = self.control.shared.clock.to_server(now);
            let text = bounded(&format!("tick {tick} | {line}"));
            self.control.to_server.send_event(Event { stamp, kind: EventKind::PluginOutput, text });
        }
    }

    // ---- the end ----

    fn finish(
        mut self,
        now: HostTime,
        outcome: EndReason,
        inputs: &Receiver<ControlInput>,
    ) -> FlightResult {
        self.report(now);
        self.report_timing(now);
        self.pass_on(now);
        let (clock, arrived) = (self.control.shared.clock.state(now), self.arrived());
        let whole = self.times.whole(now, clock, &arrived);
        self.control.log.write(Channel::Timing, now, &whole);
        debug_assert_eq!(self.companion.flight().phase(), FlightPhase::Landed);
        if let Some(side) = self.plugin.take() {
            if side.ipc.plugin_attached() {
                let _ = side.ipc.send(&ToPlugin::Stop);
            }
            if let Some(supervisor) = &side.supervisor {
                supervisor.end();
            }
            side.ipc.clean_up();
            side.stop.store(true, Ordering::Relaxed);
            // The last owner of the shared memory removes its files, so wait for the threads. Drain the queue
            // meanwhile, because they may be waiting for room in it.
            for thread in side.threads {
                while !thread.is_finished() {
                    let _ = inputs.recv_timeout(Duration::from_millis(5));
                }
            }
        }
        self.control.screen.end();
        let counters = Counters {
            seconds: self.companion.flight().seconds(now),
            image_size_px: self.image_size_px,
            setpoints_sent: self.companion.setpoints_sent(),
            mavlink_packets: self.companion.link().packets(),
            plugin_overruns: self.overruns,
            plugin_restarts: self.restarts,
            clock,
            cameras: self.times.arrivals(&arrived).to_vec(),
        };
        FlightResult { outcome, times: self.times, counters, log: self.control.log }
    }
}
