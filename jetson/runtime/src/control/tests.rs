//! Compares the companion's two drivers: the control loop and the lock-step driver receive the same inputs of a
//! simulated flight at the same times, and must produce the same outputs.

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::mpsc::sync_channel;

use vizflyt_protocol::flight_end::{Boundary, Collision, FenceBreach, Obstacle};
use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::messages::{ArenaInfo, Axes, Limits, PoseSample, Setpoint, YawTarget};
use vizflyt_protocol::time::ServerTime;
use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::ipc::{PluginEnd, RuntimeEnd};
use vizflyt_simulator::simulation::{Simulation, SimulationConfig};
use vizflyt_simulator::startup::Startup;

use super::*;
use crate::companion::Senses;
use crate::lockstep::{Lockstep, Reply};
use crate::log::LogSettings;
use crate::replies::PluginReplies;
use crate::stream::ServerClock;
use crate::supervisor::Confinement;
use crate::waterfall::Stamps;

/// Delay from an image to the plugin's reply. [ns]
const REPLY_NS: i64 = 10_000_000;
/// Ticks of the simulation (2.5 ms) between images.
const IMAGE_TICKS: u64 = 13;

/// Both drivers, and the plugin's end of the control loop's shared memory.
struct Drivers {
    lockstep: Lockstep,
    control: ControlLoop,
    plugin: PluginEnd,
    /// Datagrams that the control loop sent to the autopilot.
    sent: Rc<RefCell<Vec<Vec<u8>>>>,
    /// Replies that the control loop has not received yet.
    replies: std::collections::VecDeque<(HostTime, Reply)>,
    _folder: tempfile::TempDir,
    _inputs: Receiver<ControlInput>,
}

fn at(ns: u64) -> HostTime {
    HostTime::from_ns(10_000_000_000 + ns)
}

fn arena(ground_truth: bool) -> ArenaInfo {
    ArenaInfo { ground_truth, ..crate::flight::tests::arena() }
}

impl Drivers {
    /// Creates both at `now`, in the same arena, each with a ready plugin.
    fn new(now: HostTime, arena: &ArenaInfo) -> Self {
        let settings = FlightSettings {
            ready_within_s: 60.0,
            time_limit_s: 0.0,
            limits: Limits::NONE,
            slip_seed: 7,
            cameras: Vec::new(),
        };
        let mut lockstep = Lockstep::new(now, arena, settings.clone(), None, REPLY_NS);
        assert!(matches!(lockstep.companion.poll_plugin(), Some(ToPlugin::Start(_))));
        lockstep.companion.upload_fence(now);

        let folder = tempfile::tempdir().unwrap();
        let sent = Rc::new(RefCell::new(Vec::new()));
        let into = Rc::clone(&sent);
        let (sender, inputs) = sync_channel(QUEUE);
        let control = Control {
            plugin_command: Vec::new(),
            plugin_limits: PluginLimits::default(),
            settings,
            waits_for_start: false,
            to_autopilot: Box::new(move |bytes| into.borrow_mut().push(bytes.to_vec())),
            link: LinkSettings::default(),
            shared: Shared {
                clock: ServerClock::same(),
                mailbox: Arc::default(),
                readings: Arc::default(),
            },
            to_server: Arc::default(),
            log: FlightLog::open(&LogSettings::full(folder.path()), None),
            json: false,
            screen: Screen::default(),
        };
        let mut control = ControlLoop::new(now, control, sender);
        // Plugin that has already attached, without a process.
        let ipc = Arc::new(RuntimeEnd::new(1 << 16));
        let plugin = PluginEnd::attach(ipc.connect().unwrap()).unwrap();
        control.plugin = Some(PluginSide {
            replies: Arc::new(PluginReplies::new(Arc::clone(&ipc))),
            ipc,
            command: Vec::new(),
            confinement: Confinement::prepare(&PluginLimits::default(), &[]),
            supervisor: None,
            offer: None,
            by_hand_replied: None,
            run: 0,
            leaving: None,
            stop: Arc::default(),
            threads: Vec::new(),
        });
        let welcome = StreamEvent::Welcome(Box::new(arena.clone()));
        control.handle(now, ControlInput::Stream(welcome));
        let mut drivers = Self {
            lockstep,
            control,
            plugin,
            sent,
            replies: std::collections::VecDeque::new(),
            _folder: folder,
            _inputs: inputs,
        };
        // Also before the first pose: an image may arrive before it.
        drivers.check_senses();
        // The first turn greets the control loop's plugin.
        drivers.turn(now);
        drivers.lockstep.companion.plugin_ready();
        drivers.message(now, FromPlugin::Ready { name: bounded("test") });
        drivers
    }

    fn message(&mut self, now: HostTime, message: FromPlugin) {
        self.control.handle(now, ControlInput::FromPlugin(Box::new(message)));
    }

    fn mavlink(&mut self, now: HostTime, bytes: &[u8]) {
        self.lockstep.companion.handle_mavlink(now, bytes);
        self.control.handle(now, ControlInput::Mavlink(bytes.to_vec()));
    }

    fn pose(&mut self, now: HostTime, sample: PoseSample) {
        let stamp = HostTime::from_ns(sample.stamp.as_ns());
        self.lockstep.companion.handle_pose(now, &sample, stamp);
        self.control.handle(now, ControlInput::Stream(StreamEvent::Pose(sample, stamp)));
    }

    fn event(&mut self, now: HostTime, kind: EventKind) {
        let stamp = ServerTime::from_ns(now.as_ns());
        let event = Event::ending(stamp, kind);
        self.lockstep.companion.handle_event(now, &event);
        self.control.handle(now, ControlInput::Stream(StreamEvent::Event(event)));
    }

    /// Shows observation `seq` to the plugin, which will reply with `setpoint`.
    fn image(&mut self, now: HostTime, seq: u64, setpoint: Option<Setpoint>) {
        let published = published(now, seq);
        let reply = Reply { seq, setpoint };
        let mut views = Views::default();
        views[0] = Some(now);
        self.lockstep.companion.published(now, seq, views);
        self.lockstep.take_reply(now, reply.clone());
        self.control.handle(now, ControlInput::Published(published));
        self.replies.push_back((now.plus_ns(REPLY_NS), reply));
    }

    /// Runs both drivers and compares their datagrams to the autopilot; returns these.
    fn turn(&mut self, now: HostTime) -> Vec<Vec<u8>> {
        self.lockstep.handle_timeout(now);
        while let Some((due, Reply { seq, setpoint })) =
            self.replies.pop_front_if(|(due, _)| *due <= now)
        {
            let (entered, returned) = (due, due);
            self.message(now, FromPlugin::Reply { seq, entered, returned, setpoint });
        }
        self.control.handle_timeout(now);

        let companion = &mut self.lockstep.companion;
        let sent: Vec<_> =
            std::iter::from_fn(|| companion.poll_transmit()).map(|d| d.to_vec()).collect();
        assert_eq!(self.sent.take(), sent, "at {now:?}");
        assert_eq!(self.control.companion.setpoints_sent(), companion.setpoints_sent());
        sent
    }

    /// Returns the messages to both plugins since the last call, without greetings. They contain every event, of the
    /// server and of the companion.
    fn take_messages(&mut self) -> Vec<ToPlugin> {
        let companion = &mut self.lockstep.companion;
        let lockstep: Vec<_> = std::iter::from_fn(|| companion.poll_plugin()).collect();
        let control = std::iter::from_fn(|| self.plugin.receive().unwrap())
            .filter(|message| !matches!(message, ToPlugin::Start(_)));
        assert_eq!(control.collect::<Vec<_>>(), lockstep);
        lockstep
    }

    /// Compares the data that both plugins receive in addition to images.
    fn check_senses(&self) {
        let mut senses = Senses::default();
        self.lockstep.companion.update_senses(&mut senses);
        let control = self.control.senses.lock().unwrap();
        assert_eq!(format!("{control:?}"), format!("{senses:?}"));
    }
}

/// Returns observation `seq` of one camera, measured and published at `now`.
fn published(now: HostTime, seq: u64) -> Published {
    let stamps = Stamps {
        camera: 0,
        pose: now,
        render_start: now,
        render_end: now,
        encode_end: now,
        send: now,
        receive_first: now,
        receive: now,
        decode_end: now,
        clock_error_ns: 0,
    };
    let images = [stamps].into_iter().collect();
    Published { seq, tick: seq, pose: now, received: now, ready: now, images }
}

/// Returns the plugin's reply to image `seq`: each kind in turn.
fn setpoint(seq: u64, axes: Axes) -> Option<Setpoint> {
    let yaw = YawTarget::Keep;
    match seq / 40 % 5 {
        0 => None,
        1 => Some(Setpoint::Velocity { v_mps: DVec3::X, axes, yaw }),
        2 if axes == Axes::World => {
            Some(Setpoint::Position { p_world_m: DVec3::new(1.0, -1.0, 1.5), yaw })
        }
        2 => Some(Setpoint::Offset { d_m: DVec3::new(0.5, -0.5, 0.0), axes, yaw }),
        3 => Some(Setpoint::Velocity { v_mps: DVec3::NAN, axes, yaw }),
        _ => Some(Setpoint::Hold),
    }
}

/// Advances the simulation by a tick and passes its packets and poses to both drivers; returns the time.
fn simulate(simulation: &mut Simulation, drivers: &mut Drivers) -> HostTime {
    simulation.tick();
    let now = at(simulation.now().as_ns());
    let mut buffer = [0; MAX_PACKET];
    while let Some(packet) = simulation.poll_mavlink(&mut buffer) {
        drivers.mavlink(now, packet);
    }
    while let Some(sight) = simulation.poll_mocap() {
        let stamp = ServerTime::from_ns(at(sight.at.as_ns()).as_ns());
        let mut sample = PoseSample::still(stamp, sight.world_from_body);
        sample.twist.linear_mps = simulation.state().v_world_mps;
        drivers.pose(now, sample);
    }
    now
}

/// Flies both drivers through a simulated flight until both have landed; returns the events.
fn fly(ground_truth: bool, ends_with: &EventKind, seconds: u64) -> Vec<Event> {
    let mut simulation = Simulation::new(SimulationConfig::default()).unwrap();
    let mut drivers = Drivers::new(at(0), &arena(ground_truth));
    let (mut events, mut seq) = (Vec::new(), 0);
    for tick in 1..=400 * 90 {
        let now = simulate(&mut simulation, &mut drivers);
        if tick == 400 * seconds {
            drivers.event(now, ends_with.clone());
        }
        if tick.is_multiple_of(IMAGE_TICKS) {
            seq += 1;
            drivers.check_senses();
            let axes = if ground_truth { Axes::World } else { Axes::Heading };
            drivers.image(now, seq, setpoint(seq, axes));
        }
        for datagram in drivers.turn(now) {
            simulation.handle_mavlink(0, &datagram);
        }
        for message in drivers.take_messages() {
            let ToPlugin::Event(event) = message else { panic!("{message:?}") };
            events.push(event);
        }
        if let Some(outcome) = drivers.lockstep.companion.flight().outcome() {
            assert_eq!(drivers.control.companion.flight().outcome(), Some(outcome));
            assert!(drivers.lockstep.companion.setpoints_sent() > 400, "it has flown");
            return events;
        }
    }
    panic!("the flight does not end: {events:?}");
}

/// Returns the times from the start to the take-off and to the plugin's control. [s]
fn starts_after_s(startup: Startup) -> (f64, f64) {
    let config = SimulationConfig { startup, ..SimulationConfig::airframe() };
    let mut simulation = Simulation::new(config).unwrap();
    let mut drivers = Drivers::new(at(0), &arena(true));
    let mut takes_off_s = None;
    for tick in 1..=400 * 20 {
        let now = simulate(&mut simulation, &mut drivers);
        if tick % IMAGE_TICKS == 0 {
            drivers.image(now, tick / IMAGE_TICKS, None);
        }
        for datagram in drivers.turn(now) {
            simulation.handle_mavlink(0, &datagram);
        }
        let seconds = now.seconds_since(at(0));
        match drivers.lockstep.companion.flight().phase() {
            FlightPhase::TakingOff => takes_off_s = takes_off_s.or(Some(seconds)),
            FlightPhase::Flying => return (takes_off_s.unwrap(), seconds),
            _ => {}
        }
    }
    panic!("it does not fly: {:?}", drivers.take_messages());
}

/// Times of the virtual clock: equal on every computer.
#[test]
fn simulated_vehicle_takes_off_within_half_a_second_of_a_quick_start() {
    let (takes_off_s, flies_s) = starts_after_s(Startup::Quick);
    assert!(takes_off_s < 0.5 && flies_s < 3.5, "{takes_off_s} s, {flies_s} s");
    let (takes_off_s, flies_s) = starts_after_s(Startup::Realistic);
    assert!(takes_off_s > 3.0 && flies_s > 5.5, "{takes_off_s} s, {flies_s} s");
}

#[test]
fn both_drivers_send_the_same_setpoints_and_events() {
    let p_world_m = DVec3::new(1.0, 2.0, 3.0);
    let (clearance_m, with, speed_mps) = (-0.1, Obstacle::Scene, 1.0);
    let collision = EventKind::Collision(Collision { p_world_m, clearance_m, with, speed_mps });
    let events = fly(true, &collision, 30);
    assert!(events.iter().any(|event| event.kind == collision));
    let refused = events.iter().find(|event| event.text.starts_with("setpoint refused"));
    assert!(refused.is_some(), "{events:?}");
}

#[test]
fn event_texts_do_not_contain_a_withheld_position() {
    let p_world_m = DVec3::new(1.0, 2.0, 3.0);
    let (clearance_m, with, speed_mps) = (-0.1, Obstacle::Scene, 1.0);
    let collision = EventKind::Collision(Collision { p_world_m, clearance_m, with, speed_mps });
    let events = fly(false, &collision, 25);
    let told: Vec<_> =
        events.iter().filter(|event| event.text.contains("with an obstacle at")).collect();
    assert!(told.len() > 1, "the collision, and the landing for it: {events:?}");
    assert!(told.iter().all(|event| event.text.contains("at (withheld)")), "{told:?}");
}

#[test]
fn both_drivers_withhold_the_pose() {
    let p_world_m = DVec3::new(1.0, 2.0, 3.0);
    let outside = EventKind::Geofence(FenceBreach {
        p_world_m,
        margin_m: -0.1,
        boundary: Boundary::Geofence,
        speed_mps: 1.0,
        overshoot_m: 0.2,
    });
    let events = fly(false, &outside, 25);
    assert!(!events.iter().any(|event| event.kind == outside), "the place is withheld");
}

/// Returns the packets and poses sent by the simulated vehicle and its localization.
fn sent_by(simulation: &mut Simulation) -> Vec<ControlInput> {
    let (mut inputs, mut buffer) = (Vec::new(), [0; MAX_PACKET]);
    while let Some(packet) = simulation.poll_mavlink(&mut buffer) {
        inputs.push(ControlInput::Mavlink(packet.to_vec()));
    }
    while let Some(sight) = simulation.poll_mocap() {
        let stamp = at(sight.at.as_ns());
        let sample = PoseSample::still(ServerTime::from_ns(stamp.as_ns()), sight.world_from_body);
        inputs.push(ControlInput::Stream(StreamEvent::Pose(sample, stamp)));
    }
    inputs
}

#[test]
fn handles_queued_replies_after_a_stall_of_the_loop() {
    let mut simulation = Simulation::new(SimulationConfig::default()).unwrap();
    let mut drivers = Drivers::new(at(0), &arena(true));
    let (queue, inputs) = sync_channel(4 * QUEUE);
    // Time between runs of the loop, in ticks of 2.5 ms: finally 2.5 s, longer than the timeout of a reply.
    let (mut seq, mut flown, stall) = (0, 0, 1000);
    let mut wait = 1;
    while wait < stall {
        wait = if flown < 400 { 1 } else { stall };
        for _ in 0..wait {
            simulation.tick();
            let now = at(simulation.now().as_ns());
            for input in sent_by(&mut simulation) {
                queue.send(input).unwrap();
            }
            if (simulation.now().as_ns() / 2_500_000).is_multiple_of(IMAGE_TICKS) {
                seq += 1;
                queue.send(ControlInput::Published(published(now, seq))).unwrap();
                let setpoint = Some(Setpoint::velocity(DVec3::ZERO, YawTarget::Keep));
                let reply = FromPlugin::Reply { seq, entered: now, returned: now, setpoint };
                queue.send(ControlInput::FromPlugin(Box::new(reply))).unwrap();
            }
        }
        let now = at(simulation.now().as_ns());
        while let Ok(first) = inputs.try_recv() {
            drivers.control.handle_all(first, &inputs, || now);
            drivers.control.handle_timeout(now);
        }
        for datagram in drivers.sent.take() {
            simulation.handle_mavlink(0, &datagram);
        }
        let flight = drivers.control.companion.flight();
        assert!(flight.outcome().is_none() && seq < 2000, "{:?}", flight.outcome());
        flown += u64::from(flight.phase() == FlightPhase::Flying);
    }
    assert_eq!(drivers.control.companion.flight().phase(), FlightPhase::Flying);
}
