// Why: real ground stations still send messages that are deprecated in the dialect.
#![allow(deprecated)]

//! Companion computer for tests: the other end of the link, on the virtual clock.

use std::collections::BTreeMap;

use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::mavlink::dialect::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, MavCmd, MavMessage, MavResult, SET_GPS_GLOBAL_ORIGIN_DATA,
};
use vizflyt_protocol::mavlink::{
    CopterMode, GuidedMotion, GuidedSetpoint, MAX_PACKET, MavHeader, StreamDecoder, encode,
    guided_to_mavlink, vision_to_mavlink,
};
use vizflyt_protocol::messages::YawTarget;

use super::{Simulation, SimulationConfig, TICK_HZ, TICK_S};

/// Companion computer on the virtual clock: forwards vision from the mocap, sends heartbeats, and records the
/// autopilot's messages.
pub(crate) struct Companion {
    pub(crate) lab: Simulation,
    decoder: StreamDecoder,
    pub(crate) vision: bool,
    pub(crate) heartbeats: bool,
    /// Companion's clock minus the autopilot's [us].
    clock_offset_us: u64,
    pub(crate) texts: Vec<String>,
    pub(crate) acks: Vec<(MavCmd, MavResult)>,
    pub(crate) newest: BTreeMap<u32, MavMessage>,
    pub(crate) counts: BTreeMap<u32, u32>,
    vision_due_ns: u64,
    heartbeat_due_ns: u64,
    /// Setpoint, resent at 20 Hz.
    pub(crate) setpoint: Option<GuidedSetpoint>,
    setpoint_due_ns: u64,
    /// Offset of the vision's positions [m, world], and the reset counter.
    pub(crate) vision_shift: (DVec3, u8),
    /// System ID of all sent messages.
    pub(crate) system_id: u8,
    /// Latency of vision poses [s].
    pub(crate) vision_latency_s: f64,
    late: std::collections::VecDeque<(u64, MavMessage)>,
}

impl Companion {
    pub(crate) fn new(config: SimulationConfig) -> Self {
        Self {
            lab: Simulation::new(config).unwrap(),
            decoder: StreamDecoder::default(),
            vision: true,
            heartbeats: true,
            clock_offset_us: 77_000_000,
            texts: Vec::new(),
            acks: Vec::new(),
            newest: BTreeMap::new(),
            counts: BTreeMap::new(),
            vision_due_ns: 0,
            heartbeat_due_ns: 0,
            setpoint: None,
            setpoint_due_ns: 0,
            vision_shift: (DVec3::ZERO, 0),
            system_id: 255,
            vision_latency_s: 0.0,
            late: std::collections::VecDeque::new(),
        }
    }

    pub(crate) fn send(&mut self, message: &MavMessage) {
        let header = MavHeader { system_id: self.system_id.into(), component_id: 190, sequence: 0 };
        self.lab.handle_mavlink(0, encode(header, message, &mut [0; MAX_PACKET]));
    }

    /// Sends a command without waiting for its acknowledgement.
    pub(crate) fn ask(&mut self, command: MavCmd, params: [f32; 7]) {
        let [param1, param2, param3, param4, param5, param6, param7] = params;
        self.send(&MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            param1,
            param2,
            param3,
            param4,
            param5,
            param6,
            param7,
            command,
            target_system: 1,
            target_component: 1,
            confirmation: 0,
        }));
    }

    pub(crate) fn command(&mut self, command: MavCmd, params: [f32; 7]) -> MavResult {
        self.ask(command, params);
        self.tick();
        let (acknowledged, result) = *self.acks.last().expect("every command is acknowledged");
        assert_eq!(acknowledged, command);
        result
    }

    pub(crate) fn tick(&mut self) {
        self.lab.tick();
        let now_ns = self.lab.now().as_ns();
        let mut pose: Option<Pose<World, Body>> = None;
        while let Some(sight) = self.lab.poll_mocap() {
            pose = Some(sight.world_from_body);
        }
        if let Some(pose) = pose
            && self.vision
            && now_ns >= self.vision_due_ns
        {
            self.vision_due_ns = now_ns + 20_000_000;
            let usec = now_ns / 1000 + self.clock_offset_us;
            let (shift, resets) = self.vision_shift;
            let pose = Pose::new(pose.translation_m + shift, pose.rotation);
            let sigma = DVec3::splat(0.01);
            let message = vision_to_mavlink(&pose, usec, resets, sigma, sigma);
            let due_ns = now_ns + (self.vision_latency_s * 1e9) as u64;
            self.late.push_back((due_ns, MavMessage::VISION_POSITION_ESTIMATE(message)));
        }
        while self.late.front().is_some_and(|(due_ns, _)| *due_ns <= now_ns) {
            if let Some((_, message)) = self.late.pop_front() {
                self.send(&message);
            }
        }
        if self.heartbeats && now_ns >= self.heartbeat_due_ns {
            self.heartbeat_due_ns = now_ns + 1_000_000_000;
            self.send(&MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()));
        }
        if let Some(setpoint) = self.setpoint
            && now_ns >= self.setpoint_due_ns
        {
            self.setpoint_due_ns = now_ns + 50_000_000;
            self.set_once(setpoint.motion, setpoint.yaw);
        }
        let mut buffer = [0; MAX_PACKET];
        while let Some(packet) = self.lab.poll_mavlink(&mut buffer) {
            let (texts, acks, newest, counts) =
                (&mut self.texts, &mut self.acks, &mut self.newest, &mut self.counts);
            self.decoder.push(packet, |packet| {
                use vizflyt_protocol::mavlink::Message as _;
                match &packet.message {
                    MavMessage::STATUSTEXT(m) => texts.push(m.text.to_str().unwrap().to_owned()),
                    MavMessage::COMMAND_ACK(m) => acks.push((m.command, m.result)),
                    _ => {}
                }
                *counts.entry(packet.message.message_id()).or_default() += 1;
                newest.insert(packet.message.message_id(), packet.message);
            });
        }
        let state = self.lab.state();
        assert!(state.p_world_m.is_finite() && state.world_from_body.is_normalized());
    }

    pub(crate) fn set_once(&mut self, motion: GuidedMotion, yaw: YawTarget) {
        let message = guided_to_mavlink(&GuidedSetpoint { motion, yaw }, (1, 1), 0);
        self.send(&MavMessage::SET_POSITION_TARGET_LOCAL_NED(message));
    }

    pub(crate) fn wait(&mut self, seconds: f64) {
        for _ in 0..(seconds * TICK_HZ as f64).round() as u64 {
            self.tick();
        }
    }

    /// Runs until `done`, for at most `seconds`. Returns the elapsed time.
    pub(crate) fn until(&mut self, seconds: f64, what: &str, done: impl Fn(&Self) -> bool) -> f64 {
        for tick in 0..(seconds * TICK_HZ as f64) as u64 {
            if done(self) {
                return tick as f64 * TICK_S;
            }
            self.tick();
        }
        panic!("{what} did not come within {seconds} s; texts {:?}", self.texts);
    }

    pub(crate) fn set_origin(&mut self) {
        self.send(&MavMessage::SET_GPS_GLOBAL_ORIGIN(SET_GPS_GLOBAL_ORIGIN_DATA {
            latitude: 423_000_000,
            longitude: -718_000_000,
            altitude: 100_000,
            target_system: 1,
            time_usec: 0,
        }));
    }

    pub(crate) fn set_mode(&mut self, mode: CopterMode) -> MavResult {
        let params = [1.0, mode as u32 as f32, 0.0, 0.0, 0.0, 0.0, 0.0];
        self.command(MavCmd::MAV_CMD_DO_SET_MODE, params)
    }

    pub(crate) fn arm(&mut self) -> MavResult {
        let params = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        self.command(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, params)
    }

    pub(crate) fn take_off(&mut self, height_m: f32) -> MavResult {
        let params = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, height_m];
        self.command(MavCmd::MAV_CMD_NAV_TAKEOFF, params)
    }

    /// Boots, sets the origin, and waits until the position is known.
    pub(crate) fn prepare(&mut self) {
        self.wait(2.5);
        self.set_origin();
        self.until(5.0, "a position", |c| {
            c.lab.autopilot().estimator().health(c.lab.autopilot_now()).position
        });
        self.wait(1.5);
    }

    /// Returns a companion with a vehicle that hovers at `height_m`.
    pub(crate) fn hovering(config: SimulationConfig, height_m: f64) -> Self {
        let mut companion = Self::new(config);
        companion.prepare();
        assert_eq!(companion.set_mode(CopterMode::Guided), MavResult::MAV_RESULT_ACCEPTED);
        assert_eq!(companion.arm(), MavResult::MAV_RESULT_ACCEPTED);
        assert_eq!(companion.take_off(height_m as f32), MavResult::MAV_RESULT_ACCEPTED);
        companion.until(30.0, "the height", |c| (c.p().z - height_m).abs() < 0.1);
        companion.wait(3.0);
        companion
    }

    /// Returns when the next heartbeat is due [s].
    pub(crate) fn heartbeat_due_s(&self) -> f64 {
        self.heartbeat_due_ns as f64 * 1e-9
    }

    pub(crate) fn p(&self) -> DVec3 {
        self.lab.state().p_world_m
    }

    pub(crate) fn v(&self) -> DVec3 {
        self.lab.state().v_world_mps
    }

    pub(crate) fn fly(&mut self, motion: GuidedMotion, yaw: YawTarget) {
        self.setpoint = Some(GuidedSetpoint { motion, yaw });
    }
}
