use super::*;

use proptest::prelude::*;
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::mavlink::SigningKey;
use vizflyt_protocol::mavlink::dialect::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, MavAutopilot, MavModeFlag, MavType,
};
use vizflyt_protocol::time::ServerTime;

use crate::port::LinkSigning;

const GUIDED: u32 = 4;
const LOITER: u32 = 5;
const LAND_MODE: u32 = 9;

/// Simulated flight on a millisecond clock, with a record of the packets to the autopilot.
struct Rig {
    watch: Watch,
    ms: u64,
    sent: Sent,
    /// Time at which the runtime falls silent. [ms]
    speaks_until: u64,
    /// Whether the server's poses arrive.
    feed: bool,
    armed: bool,
    mode: u32,
    sequence: u8,
}

#[derive(Default)]
struct Sent {
    ms: u64,
    packets: Vec<(u64, Vec<u8>)>,
    said: Vec<&'static str>,
}

impl Out for Sent {
    fn send(&mut self, packet: &[u8]) {
        self.packets.push((self.ms, packet.to_vec()));
    }

    fn say(&mut self, sentence: &'static str) {
        self.said.push(sentence);
    }
}

fn at(ms: u64) -> HostTime {
    HostTime::from_ns((1000 + ms) * 1_000_000)
}

fn setpoint() -> MavMessage {
    let setpoint =
        GuidedSetpoint { motion: GuidedMotion::Velocity(DVec3::X), yaw: YawTarget::Angle(0.5) };
    MavMessage::SET_POSITION_TARGET_LOCAL_NED(guided_to_mavlink(&setpoint, (1, 1), 0))
}

fn pose(ms: u64) -> PoseSample {
    PoseSample::still(ServerTime::from_ns(ms * 1_000_000), Pose::IDENTITY)
}

impl Rig {
    fn new(wanted: Wanted) -> Self {
        Self {
            watch: Watch::new(at(0), wanted),
            ms: 0,
            sent: Sent::default(),
            speaks_until: u64::MAX,
            feed: false,
            armed: true,
            mode: GUIDED,
            sequence: 0,
        }
    }

    fn flying() -> Self {
        let mut rig = Self::new(Wanted::default());
        rig.run(2000);
        rig
    }

    fn packet(&mut self, source: (u8, u8), message: &MavMessage) -> Vec<u8> {
        self.sequence = self.sequence.wrapping_add(1);
        let header = MavHeader {
            system_id: source.0.into(),
            component_id: source.1,
            sequence: self.sequence,
        };
        encode(header, message, &mut [0; MAX_PACKET]).to_vec()
    }

    fn runtime_sends(&mut self, message: &MavMessage) {
        let packet = self.packet((255, 191), message);
        self.watch.handle_runtime(at(self.ms), &packet, &mut self.sent);
    }

    fn beat(&mut self) -> Vec<u8> {
        let mut base_mode = MavModeFlag::empty();
        base_mode.set(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED, self.armed);
        let beat = HEARTBEAT_DATA {
            custom_mode: self.mode,
            mavtype: MavType::MAV_TYPE_QUADROTOR,
            autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
            base_mode,
            ..HEARTBEAT_DATA::default()
        };
        self.packet((1, 1), &MavMessage::HEARTBEAT(beat))
    }

    /// Advances the time to `until_ms`: setpoints and poses of the runtime every 20 ms, its heartbeat every 240 ms, the
    /// autopilot's heartbeat every second.
    fn run(&mut self, until_ms: u64) {
        while self.ms < until_ms {
            let ms = self.ms;
            self.sent.ms = ms;
            if ms.is_multiple_of(1000) {
                let beat = self.beat();
                self.watch.handle_autopilot(at(ms), &beat);
            }
            if ms < self.speaks_until && ms.is_multiple_of(20) {
                self.runtime_sends(&setpoint());
                let vision = vision_of_sample(&pose(ms), at(ms));
                self.runtime_sends(&MavMessage::VISION_POSITION_ESTIMATE(vision));
                if ms.is_multiple_of(240) {
                    let mavtype = MavType::MAV_TYPE_ONBOARD_CONTROLLER;
                    let beat = HEARTBEAT_DATA { mavtype, mavlink_version: 3, ..Default::default() };
                    self.runtime_sends(&MavMessage::HEARTBEAT(beat));
                }
            }
            if self.feed && ms.is_multiple_of(20) {
                self.watch.handle_pose(at(ms), &pose(ms), at(ms), &mut self.sent);
            }
            if ms.is_multiple_of(10) {
                self.watch.handle_timeout(at(ms), &mut self.sent);
            }
            self.ms += 1;
        }
    }

    /// Returns the times at which the guardian sent messages with this id, since `from_ms`.
    fn ours(&self, id: u32, from_ms: u64) -> Vec<u64> {
        let is = |bytes: &[u8]| {
            Head::of(bytes).is_some_and(|head| head.id == id && head.source.1 == COMPONENT_ID)
        };
        let sent = self.sent.packets.iter().filter(|(ms, bytes)| *ms >= from_ms && is(bytes));
        sent.map(|(ms, _)| *ms).collect()
    }
}

const COMMAND_LONG: u32 = 76;
const VISION: u32 = 102;
const SET_POSITION_TARGET: u32 = SET_POSITION_TARGET_LOCAL_NED;

#[test]
fn orders_land_after_half_a_second_of_silence_and_at_once_after_an_end() {
    let mut rig = Rig::flying();
    assert_eq!(rig.ours(COMMAND_LONG, 0), [], "no command while the runtime sends");
    rig.speaks_until = 2001;
    rig.run(3000);
    let lands = rig.ours(COMMAND_LONG, 0);
    assert!((2500..=2520).contains(&lands[0]), "{lands:?}");
    assert!(
        lands.len() > 1 && rig.sent.said == [SILENT],
        "LAND is repeated until the mode has changed"
    );

    let mut rig = Rig::flying();
    rig.speaks_until = 2000;
    rig.watch.handle_end();
    rig.run(2050);
    let lands = rig.ours(COMMAND_LONG, 0);
    assert!(lands[0] <= 2010 && rig.sent.said == [ENDED], "{lands:?}");
}

#[test]
fn stops_without_setpoints_until_they_resume() {
    let mut rig = Rig::flying();
    rig.speaks_until = 2001;
    rig.run(2450);
    let stops = rig.ours(SET_POSITION_TARGET, 0);
    assert!((2190..=2220).contains(&stops[0]) && stops.len() == 3, "{stops:?}");
    let (_, packet) =
        rig.sent.packets.iter().find(|(ms, p)| *ms == stops[0] && p[7] == 84).unwrap();
    let payload = Head::of(packet).unwrap().payload;
    let Ok(MavMessage::SET_POSITION_TARGET_LOCAL_NED(stop)) =
        MavMessage::parse(MavlinkVersion::V2, SET_POSITION_TARGET, payload)
    else {
        panic!()
    };
    let stop = guided_from_mavlink(&stop).unwrap();
    assert_eq!(stop.motion, GuidedMotion::Velocity(DVec3::ZERO));
    assert!(matches!(stop.yaw, YawTarget::Angle(yaw) if (yaw - 0.5).abs() < 1e-5), "{stop:?}");
    rig.speaks_until = u64::MAX;
    rig.run(4000);
    assert_eq!(rig.ours(SET_POSITION_TARGET, 0), stops, "no more stops after setpoints resume");
    assert_eq!(rig.ours(COMMAND_LONG, 0), []);
}

#[test]
fn continues_heartbeats_and_poses_until_disarmed() {
    let mut rig = Rig::flying();
    (rig.speaks_until, rig.feed) = (2000, true);
    rig.run(2600);
    let poses = rig.ours(VISION, 0);
    // The runtime's poses have priority; the guardian's start 0.1 s after them, at 50 Hz.
    assert!((2080..=2120).contains(&poses[0]) && poses.len() >= 23, "{poses:?}");
    rig.mode = LAND_MODE;
    rig.run(6000);
    let beats = rig.ours(HEARTBEAT, 0);
    assert!(beats.windows(2).all(|w| w[1] - w[0] <= 510) && beats.len() >= 5, "{beats:?}");
    rig.watch.handle_end();
    assert!(!rig.watch.is_over(at(rig.ms)), "the vehicle is in the air");
    rig.armed = false;
    rig.run(7100);
    assert!(rig.watch.is_over(at(rig.ms)));
}

#[test]
fn continues_heartbeats_in_a_landing_ordered_by_the_runtime() {
    let mut rig = Rig::flying();
    rig.mode = LAND_MODE;
    rig.run(3100);
    rig.speaks_until = 3100;
    rig.watch.handle_end();
    rig.run(6000);
    assert_eq!(rig.ours(COMMAND_LONG, 0), [], "the vehicle is landing already");
    assert!(rig.ours(HEARTBEAT, 0).len() >= 4 && rig.sent.said.is_empty());
}

#[test]
fn does_not_land_in_a_pilots_mode_or_on_the_ground() {
    for (mode, armed) in [(LOITER, true), (GUIDED, false)] {
        let mut rig = Rig::new(Wanted::default());
        (rig.mode, rig.armed, rig.feed) = (mode, armed, true);
        rig.run(2000);
        rig.speaks_until = 2000;
        rig.run(5000);
        assert_eq!(rig.ours(COMMAND_LONG, 0), []);
        // A pilot's LOITER needs poses, too.
        assert!(rig.ours(VISION, 0).len() > 100);
    }
}

#[test]
fn ignores_heartbeats_of_another_autopilot() {
    let mut rig = Rig::flying();
    // System 7 reports that it is disarmed.
    let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
    for (from, mavtype) in [
        ((7, 1), MavType::MAV_TYPE_QUADROTOR),
        ((1, 154), MavType::MAV_TYPE_GIMBAL),
        ((1, 1), MavType::MAV_TYPE_ANTENNA_TRACKER),
    ] {
        let beat = HEARTBEAT_DATA { mavtype, autopilot, ..HEARTBEAT_DATA::default() };
        let other = rig.packet(from, &MavMessage::HEARTBEAT(beat));
        rig.watch.handle_autopilot(at(rig.ms), &other);
    }
    rig.speaks_until = 2000;
    rig.run(2600);
    assert!(!rig.ours(COMMAND_LONG, 0).is_empty());
}

#[test]
fn blocks_orders_of_a_recovered_runtime_during_landing() {
    let mut rig = Rig::flying();
    rig.speaks_until = 2000;
    rig.run(2600);
    rig.speaks_until = u64::MAX;
    rig.sent.packets.clear();
    rig.run(2900);
    let mode = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA::default());
    rig.runtime_sends(&mode);
    let ids: Vec<_> =
        rig.sent.packets.iter().filter_map(|(_, bytes)| Some(Head::of(bytes)?.id)).collect();
    assert!(!ids.contains(&SET_POSITION_TARGET), "{ids:?}");
    assert!(ids.contains(&VISION) && ids.contains(&HEARTBEAT), "poses of the runtime pass");
    assert!(rig.ours(COMMAND_LONG, 0).len() == ids.iter().filter(|id| **id == 76).count());
    // The pilot takes over, and later returns control: the runtime's setpoints pass again.
    rig.mode = LOITER;
    rig.run(4100);
    rig.sent.packets.clear();
    rig.run(4200);
    let passes =
        rig.sent.packets.iter().any(|(_, b)| Head::of(b).unwrap().id == SET_POSITION_TARGET);
    assert!(passes);
}

#[test]
fn does_not_land_after_the_computer_stalled() {
    let mut rig = Rig::flying();
    // No process was scheduled for 3 s, and the guardian runs first.
    rig.ms += 3000;
    rig.watch.handle_timeout(at(rig.ms), &mut rig.sent);
    rig.ms += 10;
    rig.watch.handle_timeout(at(rig.ms), &mut rig.sent);
    rig.run(rig.ms + 500);
    assert_eq!(rig.ours(COMMAND_LONG, 0), []);
}

#[test]
fn does_not_send_stale_or_invalid_poses() {
    let mut rig = Rig::flying();
    rig.speaks_until = 2000;
    rig.run(2300);
    rig.watch.handle_pose(at(2300), &pose(1700), at(1700), &mut rig.sent);
    let mut broken = pose(2300);
    broken.world_from_body = Pose::new(DVec3::NAN, glam::DQuat::IDENTITY);
    rig.watch.handle_pose(at(2300), &broken, at(2300), &mut rig.sent);
    assert_eq!(rig.ours(VISION, 0), []);
}

#[test]
fn signs_packets_and_ignores_unsigned_heartbeats() {
    let key = SigningKey::new([7; 32]);
    let start = SigningTime::from_units(1_000_000_000);
    let signing = LinkSigning { key: key.clone(), start, accepts_unsigned: false };
    let mut rig = Rig::new(Wanted { system: None, signing: Some(signing) });
    let mut signer = Signer::new(key.clone(), 0);
    let mut beat = |rig: &mut Rig| {
        let bytes = rig.beat();
        let mut packet = [0; MAX_PACKET];
        packet[..bytes.len()].copy_from_slice(&bytes);
        let len = signer.sign(start.plus_us(rig.ms * 1000), &mut packet, bytes.len());
        rig.watch.handle_autopilot(at(rig.ms), &packet[..len]);
    };
    beat(&mut rig);
    rig.run(900);
    // An unsigned heartbeat reports that the vehicle is disarmed.
    rig.armed = false;
    rig.speaks_until = 900;
    rig.run(2000);
    let lands: Vec<_> = rig
        .sent
        .packets
        .iter()
        .filter(|(_, bytes)| Head::of(bytes).unwrap().source.1 == COMPONENT_ID)
        .collect();
    let mut verifier = Verifier::new(key);
    assert!(!lands.is_empty(), "LAND despite the unsigned heartbeat");
    for (ms, bytes) in lands {
        verifier.check(start.plus_us(ms * 1000), bytes).unwrap();
    }
}

proptest! {
    /// For any packets in any order: LAND is ordered within 0.5 s of the runtime's last packet while the vehicle
    /// follows it, and never while the runtime sends.
    #[test]
    fn orders_land_only_when_the_runtime_is_silent(
        gaps in prop::collection::vec(1..480_u64, 20..80),
        noise in prop::collection::vec(any::<u8>(), 0..400),
    ) {
        let mut rig = Rig::new(Wanted::default());
        rig.run(1500);
        rig.speaks_until = 0;
        for gap in gaps {
            rig.runtime_sends(&setpoint());
            rig.watch.handle_autopilot(at(rig.ms), &noise);
            rig.watch.handle_runtime(at(rig.ms), &noise, &mut rig.sent);
            rig.run(rig.ms + gap);
        }
        prop_assert_eq!(rig.ours(COMMAND_LONG, 0), Vec::<u64>::new());
        let last = rig.ms;
        rig.run(last + 530);
        prop_assert!(!rig.ours(COMMAND_LONG, 0).is_empty());
    }
}
