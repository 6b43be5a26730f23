//! State machine of the link, by operations: messages of any content, raw bytes, time, goals, poses, setpoints,
//! parameters. The link arms only for a take-off, sends only complete packets, and always has a next timeout.
#![no_main]
use glam::DVec2;
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::mavlink::dialect::{MavCmd, MavMessage};
use vizflyt_protocol::mavlink::{
    FenceSide, GuidedMotion, GuidedSetpoint, MAX_PACKET, MavHeader, MavlinkVersion, Message,
    StreamDecoder, encode,
};
use vizflyt_protocol::messages::{PoseSample, YawTarget};
use vizflyt_protocol::time::{HostTime, ServerTime};
use vizflyt_runtime::link::{COMPONENT_ID, FencePolygon, Goal, Link, SYSTEM_ID};

/// Messages that an autopilot, another companion or a ground station may send.
const MESSAGES: [u32; 23] = [
    0, 1, 22, 27, 30, 32, 49, 77, 84, 105, 109, 111, 148, 193, 230, 253, 256, 20, 23, 76, 40, 47,
    51,
];
const GOALS: [Goal; 4] = [Goal::Prepare, Goal::TakeOff(1.0), Goal::Fly, Goal::Land];
/// Maximum time; a clock without a limit would overflow after 292 years. [s]
const LATEST_S: f64 = 1e8;

struct Machine {
    link: Link,
    now: HostTime,
    goal: Goal,
    decoder: StreamDecoder,
}

impl Machine {
    /// Runs one operation; returns the rest of the input.
    fn step<'a>(&mut self, data: &'a [u8]) -> &'a [u8] {
        let [kind, value, length, rest @ ..] = data else { return &[] };
        let (argument, rest) = rest.split_at(rest.len().min(usize::from(*length)));
        match kind % 8 {
            0 | 1 => self.inject(*value, argument),
            2 => self.link.handle_input(self.now, argument),
            3 => {
                let seconds = f64::from(*value) * 0.05;
                if self.now.seconds_since(HostTime::ZERO) < LATEST_S {
                    self.now = self.now.plus_seconds(seconds);
                }
                self.link.handle_timeout(self.now);
            }
            4 => {
                self.goal = GOALS[usize::from(value % 4)];
                self.link.set_goal(self.now, self.goal);
            }
            5 => {
                let mut bytes = [0; 24];
                bytes[..argument.len().min(24)]
                    .copy_from_slice(&argument[..argument.len().min(24)]);
                let number =
                    |i: usize| f64::from_le_bytes(bytes[8 * i..8 * i + 8].try_into().unwrap());
                let p = [number(0), number(1), number(2)].into();
                let pose = Pose::new(p, Default::default());
                let stamp = self.now.plus_seconds(-f64::from(*value) * 0.01);
                let sample = PoseSample::still(ServerTime::ZERO, pose);
                self.link.vision(self.now, &PoseSample { resets: *value, ..sample }, stamp);
                let yaw = YawTarget::Angle(0.0);
                self.link
                    .setpoint(self.now, &GuidedSetpoint { motion: GuidedMotion::Velocity(p), yaw });
            }
            6 if *value < 128 => self.link.read_params(self.now),
            6 => {
                let corner = |byte: &u8| DVec2::new(f64::from(*byte), f64::from(*value));
                let corners_m: Vec<_> = argument.iter().map(corner).collect();
                let side = if *value % 2 == 0 { FenceSide::Inside } else { FenceSide::Outside };
                self.link.set_fence(self.now, vec![FencePolygon { side, corners_m }]);
            }
            _ => self.link.write_param(self.now, "FS_GCS_ENABLE", f64::from(*value)),
        }
        rest
    }

    /// Sends a complete packet with this payload, mostly from the autopilot.
    fn inject(&mut self, value: u8, payload: &[u8]) {
        let id = MESSAGES[usize::from(value) % MESSAGES.len()];
        let Ok(message) = MavMessage::parse(MavlinkVersion::V2, id, payload) else { return };
        let component_id = if value >= 240 { COMPONENT_ID } else { 1 };
        let system_id = if value >= 240 { SYSTEM_ID.into() } else { 1 };
        let header = MavHeader { system_id, component_id, sequence: value };
        let mut bytes = [0; MAX_PACKET];
        let packet = encode(header, &message, &mut bytes);
        self.link.handle_input(self.now, packet);
    }

    fn check(&mut self) {
        let goal = self.goal;
        while let Some(datagram) = self.link.poll_transmit() {
            let mut packets = 0;
            self.decoder.push(&datagram, |packet| {
                packets += 1;
                assert_eq!(packet.header.system_id, u32::from(SYSTEM_ID));
                assert_eq!(packet.header.component_id, COMPONENT_ID);
                if let MavMessage::COMMAND_LONG(command) = packet.message {
                    let arms = command.command == MavCmd::MAV_CMD_COMPONENT_ARM_DISARM
                        || command.command == MavCmd::MAV_CMD_NAV_TAKEOFF;
                    assert!(!arms || matches!(goal, Goal::TakeOff(_)), "armed for {goal:?}");
                }
            });
            assert_eq!(packets, 1, "a datagram is one packet");
        }
        while let Some(event) = self.link.poll_event() {
            let _ = event.warning();
        }
        assert!(self.link.poll_timeout().is_some());
        let _ = (self.link.ready_to_arm(self.now), self.link.delay(self.now));
        assert!(self.link.state().p_world_m.is_finite());
        let stamps: Vec<_> = self.link.imu().iter().map(|sample| sample.stamp).collect();
        assert!(stamps.is_sorted());
    }
}

fuzz_target!(|data: &[u8]| {
    let now = HostTime::from_ns(1_000_000_000);
    let mut machine = Machine {
        link: Link::new(now),
        now,
        goal: Goal::Prepare,
        decoder: StreamDecoder::default(),
    };
    let mut rest = data;
    while !rest.is_empty() {
        rest = machine.step(rest);
        machine.check();
    }
});
