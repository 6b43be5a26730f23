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

use std::ffi::OsString;
use std::io::Write;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender};
use std::sync::{Arc, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use glam::DVec3;
use serde_json::json;
use vizflyt_protocol::mavlink::{GuidedMotion, GuidedSetpoint};
use vizflyt_protocol::messages::{
    ArenaInfo, Arrivals, CameraInfo, Event, EventKind, FlightPhase, FromPlugin, MAX_CAMERAS,
    PoseSample, Setpoint, Telemetry, ToPlugin, YawTarget, bounded,
};
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::ipc::{Offer, RuntimeEnd, SERVICE_OPTION, unique_service};
use vizflyt_sdk::{Battery, ImuSample, ObservationWriter, Vehicle, host_now};

use crate::answers;
use crate::console::{Screen, Status};
use crate::flight::{Flight, FlightSettings, Input, LinkView, Outcome};
use crate::guard::Fix;
use crate::images::{ImagePublisher, Published, SharedSenses};
use crate::link::port::Port;
use crate::link::{Link, LinkEvent, LinkSettings};
use crate::log::{Channel, FlightLog};
use crate::report::Counters;
use crate::stats::ImageTimes;
use crate::steering::Steering;
use crate::stream::{Outbox, Shared, StreamEvent};
use crate::supervisor::{Confinement, PluginEvent, PluginLimits, Restart, Stream, Supervisor};

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
/// The status line is renewed every so many ticks, a multiple of [`TELEMETRY_TICKS`]: 2 Hz.
const STATUS_TICKS: u64 = 25;
/// Where images get their age, to the server every so many ticks: 1 Hz.
const TIMING_TICKS: u64 = 50;
/// The plugin hears of us at least this often.
const HEARTBEAT_TICKS: u64 = 20;
/// A plugin that says it has failed may still print why for so long, before it is started again.
const LAST_WORDS: Duration = Duration::from_millis(300);
/// Lines of the plugin that the page gets in a second; console and log get more.
const PAGE_LINES_PER_SECOND: u64 = 50;
/// Whether a plugin that a person started still lives is looked up every 80 ms.
const BY_HAND_TICKS: u64 = 4;
/// Silence of such a plugin after which the vehicle holds; before the guard's own 0.5 s, after which
/// it would land. [s]
const BREAKPOINT_S: f64 = 0.4;
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

/// The plugin's side, from the moment the arena is known.
struct PluginSide {
    ipc: Arc<RuntimeEnd>,
    command: Vec<OsString>,
    confinement: Confinement,
    supervisor: Option<Supervisor>,
    /// Stands until a plugin has come that a person started.
    offer: Option<Offer>,
    /// When a plugin that a person started last answered, or we on its behalf.
    by_hand_answered: Option<HostTime>,
    /// Number of the present process.
    run: u32,
    arena: Box<ArenaInfo>,
    /// The present process was greeted.
    started: bool,
    /// The present process is on its way out, and another will be started; until when it may go
    /// by itself.
    leaving: Option<Instant>,
    /// Another process speaks: what the former one did is forgotten.
    anew: Arc<AtomicBool>,
    /// Ends its threads.
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
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
}

impl Control {
    /// Flies to the end. Call it on a thread that lives as long: the plugin dies with it.
    pub fn run(self, sender: SyncSender<Happening>, happenings: &Receiver<Happening>) -> Flown {
        let now = host_now();
        let settings = self.settings;
        let link = Link::with(now, self.link.clone());
        let mut state = Loop {
            control: self,
            sender,
            link,
            flight: Flight::new(settings, now),
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
        let state = self.link.state();
        let view = LinkView {
            connected: self.link.is_connected(),
            armed: state.armed,
            mode: state.mode,
            took_off: self.link.took_off(),
            ready_to_arm: self.link.ready_to_arm(now),
        };
        let orders = self.flight.tick(now, &view);
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
        self.link.vision(now, &sample.world_from_body, stamp, sample.resets);
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

    // ---- the plugin ----

    fn start_plugin(&mut self, now: HostTime, arena: Box<ArenaInfo>) {
        if let Some(camera) = arena.cameras.first() {
            self.image_size_px = (camera.intrinsics.width_px, camera.intrinsics.height_px);
        }
        let service = unique_service();
        let len = ObservationWriter::len_for(&arena.cameras);
        let mut command = self.control.plugin_command.clone();
        let confinement = Confinement::prepare(&self.control.plugin_limits, &command);
        // Who starts a plugin by hand is its user.
        let by_hand = command.is_empty();
        let owner = confinement.user_id().filter(|_| !by_hand);
        let ipc = match RuntimeEnd::create_for(&service, len, owner) {
            Ok(ipc) => Arc::new(ipc),
            Err(error) => {
                return self.flight.handle(now, Input::ServerRefused(error.to_string()));
            }
        };
        let (stop, anew) = (Arc::default(), Arc::default());
        let threads = self.start_threads(&ipc, &arena, &stop, &anew);
        let mut offer = None;
        if by_hand {
            match Offer::make(&service) {
                Ok(made) => offer = Some(made),
                Err(error) => {
                    let sentence = format!("no plugin can find this runtime: {error}");
                    self.flight.handle(now, Input::PluginFailed(sentence));
                }
            }
        } else {
            command.push(format!("{SERVICE_OPTION}={service}").into());
        }
        self.plugin = Some(PluginSide {
            ipc,
            command,
            confinement,
            supervisor: None,
            offer,
            by_hand_answered: None,
            run: 0,
            arena,
            started: false,
            leaving: None,
            anew,
            stop,
            threads,
        });
        if by_hand {
            let text = "waiting for a plugin: start yours, as `python my_plugin.py`";
            self.tell_event(now, EventKind::Note, text);
        } else {
            self.start_process(now);
        }
    }

    /// Watches a plugin that a person started: its end is noticed, and while it stands at a
    /// breakpoint the vehicle holds instead of landing.
    fn tend_by_hand(&mut self, now: HostTime) {
        let Some(side) = &mut self.plugin else { return };
        let Some(answered) = side.by_hand_answered else { return };
        if self.ticks.is_multiple_of(BY_HAND_TICKS) {
            // A killed process stays subscribed until its remains are cleared away.
            side.ipc.clean_up();
            if !side.ipc.plugin_attached() {
                side.by_hand_answered = None;
                let sentence = "the plugin that had attached has ended".to_owned();
                return self.flight.handle(now, Input::PluginFailed(sentence));
            }
        }
        if now.seconds_since(answered) > BREAKPOINT_S {
            side.by_hand_answered = Some(now);
            let setpoint = Some(Setpoint::Hold);
            self.flight.handle(now, Input::Answered { seq: self.image_seq, setpoint });
        }
    }

    /// Starts the plugin's process, the first or another.
    fn start_process(&mut self, now: HostTime) {
        let Some(side) = &mut self.plugin else { return };
        let (sender, run) = (self.sender.clone(), side.run);
        // Lines and the end are never dropped: the loop always reads.
        let tell = move |event| {
            let _ = sender.send(Happening::Plugin(run, event));
        };
        match Supervisor::start(&side.command, &side.confinement, tell) {
            Ok(supervisor) => side.supervisor = Some(supervisor),
            Err(error) => {
                let program = side.command[0].to_string_lossy();
                let sentence = format!("the plugin {program} cannot be started: {error}");
                self.flight.handle(now, Input::PluginFailed(sentence));
            }
        }
    }

    /// The plugin says that it has failed; its process ends soon after.
    fn plugin_failed(&mut self, now: HostTime, sentence: String) {
        if self.plugin.as_ref().is_some_and(|side| side.leaving.is_some()) {
            return;
        }
        if self.may_restart() {
            self.restarts += 1;
            self.replace_plugin(now, sentence);
        } else {
            self.flight.handle(now, Input::PluginFailed(sentence));
        }
    }

    fn plugin_exited(&mut self, now: HostTime, run: u32, sentence: String) {
        let Some(side) = &mut self.plugin else { return };
        if side.run != run {
            return;
        }
        side.ipc.clean_up();
        if side.leaving.is_none() {
            self.plugin_failed(now, sentence);
        }
        let Some(side) = &mut self.plugin else { return };
        if side.leaving.take().is_some() && self.flight.can_wait_for_plugin() {
            (side.run, side.started) = (side.run + 1, false);
            side.anew.store(true, Ordering::Relaxed);
            self.start_process(now);
        }
    }

    /// Whether a plugin that failed is started again, by the policy.
    fn may_restart(&self) -> bool {
        let limits = &self.control.plugin_limits;
        let is_there = match limits.restart {
            Restart::Never => false,
            Restart::OnGround => self.flight.is_on_ground(),
            Restart::InFlight => true,
        };
        // What a person started, a person starts again.
        let ours = !self.control.plugin_command.is_empty();
        ours && is_there && self.restarts < limits.restarts && self.flight.can_wait_for_plugin()
    }

    /// Has the plugin started anew, once its present process is gone; the vehicle holds meanwhile.
    fn replace_plugin(&mut self, now: HostTime, why: String) {
        let Some(side) = &mut self.plugin else { return };
        if side.leaving.is_some() || !self.flight.can_wait_for_plugin() {
            return;
        }
        side.leaving = Some(Instant::now() + LAST_WORDS);
        if side.ipc.plugin_attached() {
            let _ = side.ipc.send(&ToPlugin::Stop);
        }
        self.flight.handle(now, Input::PluginRestarts(why));
    }

    fn start_threads(
        &self,
        ipc: &Arc<RuntimeEnd>,
        arena: &ArenaInfo,
        stop: &Arc<AtomicBool>,
        anew: &Arc<AtomicBool>,
    ) -> Vec<JoinHandle<()>> {
        let cameras = arena.cameras.to_vec();
        let mailbox = Arc::clone(&self.control.shared.mailbox);
        let publisher = ImagePublisher::new(Arc::clone(ipc), cameras, Arc::clone(&self.senses))
            .with_log(self.control.log.images(&mailbox));
        let (sender, stopped) = (self.sender.clone(), Arc::clone(stop));
        let images = spawn("images", move || {
            publisher.run(
                &mailbox,
                || stopped.load(Ordering::Relaxed),
                |published| {
                    let _ = sender.send(Happening::Published(published));
                },
            );
        });
        let (ipc, sender) = (Arc::clone(ipc), self.sender.clone());
        let (stopped, anew) = (Arc::clone(stop), Arc::clone(anew));
        let answers = spawn("answers", move || {
            answers::read(&ipc, &stopped, &anew, |message| {
                let _ = sender.send(Happening::FromPlugin(Box::new(message)));
            });
        });
        images.into_iter().chain(answers).collect()
    }

    /// Greets the plugin once it has attached; shows it that we live.
    fn tend_plugin(&mut self) {
        let Some(side) = &mut self.plugin else { return };
        if side.leaving.is_some_and(|until| Instant::now() > until)
            && let Some(supervisor) = &side.supervisor
        {
            supervisor.kill();
        }
        if !side.started && side.leaving.is_none() && side.ipc.plugin_attached() {
            side.started = true;
            if side.offer.take().is_some() {
                side.by_hand_answered = Some(host_now());
            }
            let start = ToPlugin::Start((*side.arena).clone());
            self.control.log.to_plugin(host_now(), &start);
            if let Err(error) = side.ipc.send(&start) {
                tracing::warn!("plugin: {error}");
            }
            // One that comes later learns where the flight is.
            if side.run > 0 {
                let stamp = self.control.shared.clock.to_server(host_now());
                let kind = EventKind::Phase(self.flight.phase());
                let text = bounded("the plugin was started again");
                let message = ToPlugin::Event(Event { stamp, kind, text });
                self.control.log.to_plugin(host_now(), &message);
                let _ = side.ipc.send(&message);
            }
        } else if self.ticks.is_multiple_of(HEARTBEAT_TICKS) {
            side.ipc.heartbeat();
        }
    }

    // ---- telling others ----

    fn tell_notices(&mut self, now: HostTime) {
        while let Some(notice) = self.flight.poll_notice() {
            let stamp = self.control.shared.clock.to_server(now);
            let text = bounded(&notice.text);
            let event = Event { stamp, kind: notice.kind, text };
            tracing::info!(target: "flight", "{}", notice.text);
            self.publish_event(now, &event);
            self.control.to_server.tell(event);
        }
    }

    /// Log, plugin and standard output hear of every event but the plugin's own lines.
    fn publish_event(&mut self, now: HostTime, event: &Event) {
        self.control.log.event(now, event);
        if self.control.json {
            print_line(&json!({"event": event}).to_string());
        } else {
            self.control.screen.event(&event.text);
        }
        if let Some(side) = &self.plugin
            && side.started
            && side.ipc.plugin_attached()
        {
            let message = ToPlugin::Event(for_plugin(event, &side.arena));
            self.control.log.to_plugin(host_now(), &message);
            if let Err(error) = side.ipc.send(&message) {
                tracing::debug!("plugin: {error}");
            }
        }
    }

    fn report(&mut self, now: HostTime) {
        let replaced = self.control.shared.mailbox.replaced();
        let telemetry = Telemetry {
            phase: self.flight.phase(),
            vehicle: *self.link.state(),
            images: self.times.last_second(now, self.published, replaced),
            v_setpoint_mps: self.v_setpoint_mps,
            setpoints_sent: self.setpoints_sent,
            mavlink_packets: self.link.packets(),
        };
        self.control.log.write(Channel::Telemetry, now, &telemetry);
        if self.ticks.is_multiple_of(STATUS_TICKS) {
            let status = Status::of(&telemetry);
            if self.control.json {
                print_line(&json!({"status": status}).to_string());
            } else {
                self.control.screen.status(&status);
            }
        }
        self.control.to_server.report(telemetry);
    }

    fn report_timing(&mut self, now: HostTime) {
        if let Some(trouble) = self.control.log.poll_trouble() {
            let text = bounded(&format!("flight log: {trouble}"));
            let stamp = self.control.shared.clock.to_server(now);
            let event = Event { stamp, kind: EventKind::Note, text };
            self.publish_event(now, &event);
            self.control.to_server.tell(event);
        }
        let clock = self.control.shared.clock.state(now);
        let timing = self.times.timing(now, clock, &self.arrived());
        self.control.log.write(Channel::Timing, now, &timing);
        self.control.to_server.report_timing(timing);
    }

    /// Returns what became of images before they reached shared memory, by camera.
    fn arrived(&self) -> Vec<Arrivals> {
        let cameras = self.plugin.as_ref().map_or(0, |side| side.arena.cameras.len());
        self.control.shared.mailbox.arrivals()[..cameras.min(MAX_CAMERAS)].to_vec()
    }

    fn log_sent(&mut self, now: HostTime, setpoint: &GuidedSetpoint) {
        let GuidedMotion::Velocity(v_mps) = setpoint.motion else { return };
        self.v_setpoint_mps = v_mps;
        let (yaw_rad, yaw_rate_radps) = match setpoint.yaw {
            YawTarget::Angle(yaw_rad) => (Some(yaw_rad), None),
            YawTarget::Rate(rate_radps) => (None, Some(rate_radps)),
            YawTarget::Keep => (None, None),
        };
        self.control.log.write(
            Channel::Sent,
            now,
            &json!({
                "v_world_mps": v_mps.to_array(), "yaw_rad": yaw_rad,
                "yaw_rate_radps": yaw_rate_radps
            }),
        );
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

/// Returns the event as the plugin may know it: without the place where the course withholds it.
fn for_plugin(event: &Event, arena: &ArenaInfo) -> Event {
    let mut event = event.clone();
    if !arena.ground_truth
        && let EventKind::Collision { p_world_m, .. } | EventKind::Geofence { p_world_m, .. } =
            &mut event.kind
    {
        *p_world_m = DVec3::ZERO;
    }
    event
}

fn spawn(name: &str, run: impl FnOnce() + Send + 'static) -> Option<JoinHandle<()>> {
    let thread = thread::Builder::new().name(name.into()).spawn(run);
    thread.inspect_err(|error| tracing::error!("thread {name}: {error}")).ok()
}

/// Prints a line for a program that may have stopped listening.
pub fn print_line(line: &str) {
    let mut out = std::io::stdout().lock();
    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
}
