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

/// A flight on a clock of milliseconds: what went to the autopilot, and when.
struct Rig {
    watch: Watch,
    ms: u64,
    sent: Sent,
    /// The runtime speaks until then. [ms]
    speaks_until: u64,
    /// The server's poses come.
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
            autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
            base_mode,
            ..HEARTBEAT_DATA::default()
        };
        self.packet((1, 1), &MavMessage::HEARTBEAT(beat))
    }

    /// Lets time pass until `ms`: setpoints and poses of the runtime each 20 ms, its heartbeat each 250, the
    /// autopilot's each second.
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

    /// When we sent a message of this number since `from_ms`.
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
fn silence_of_half_a_second_is_land_and_an_end_is_at_once() {
    let mut rig = Rig::flying();
    assert_eq!(rig.ours(COMMAND_LONG, 0), [], "nothing of our own while it speaks");
    rig.speaks_until = 2001;
    rig.run(3000);
    let lands = rig.ours(COMMAND_LONG, 0);
    assert!((2500..=2520).contains(&lands[0]), "{lands:?}");
    assert!(lands.len() > 1 && rig.sent.said == [SILENT], "repeated until the mode has changed");

    let mut rig = Rig::flying();
    rig.speaks_until = 2000;
    rig.watch.handle_end();
    rig.run(2050);
    let lands = rig.ours(COMMAND_LONG, 0);
    assert!(lands[0] <= 2010 && rig.sent.said == [ENDED], "{lands:?}");
}

#[test]
fn setpoints_that_cease_are_a_stop_until_they_come_again() {
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
    assert_eq!(rig.ours(SET_POSITION_TARGET, 0), stops, "and it flies on");
    assert_eq!(rig.ours(COMMAND_LONG, 0), []);
}

#[test]
fn heartbeats_and_poses_go_on_until_it_stands() {
    let mut rig = Rig::flying();
    (rig.speaks_until, rig.feed) = (2000, true);
    rig.run(2600);
    let poses = rig.ours(VISION, 0);
    // The runtime's go first; ours fill the gap within a tenth of a second, 50 a second.
    assert!((2080..=2120).contains(&poses[0]) && poses.len() >= 23, "{poses:?}");
    rig.mode = LAND_MODE;
    rig.run(6000);
    let beats = rig.ours(HEARTBEAT, 0);
    assert!(beats.windows(2).all(|w| w[1] - w[0] <= 510) && beats.len() >= 5, "{beats:?}");
    rig.watch.handle_end();
    assert!(!rig.watch.is_over(at(rig.ms)), "it is in the air");
    rig.armed = false;
    rig.run(7100);
    assert!(rig.watch.is_over(at(rig.ms)));
}

#[test]
fn a_landing_that_the_runtime_ordered_keeps_its_heartbeats() {
    let mut rig = Rig::flying();
    rig.mode = LAND_MODE;
    rig.run(3100);
    rig.speaks_until = 3100;
    rig.watch.handle_end();
    rig.run(6000);
    assert_eq!(rig.ours(COMMAND_LONG, 0), [], "it lands already");
    assert!(rig.ours(HEARTBEAT, 0).len() >= 4 && rig.sent.said.is_empty());
}

#[test]
fn a_pilot_and_a_vehicle_on_the_ground_are_left_alone() {
    for (mode, armed) in [(LOITER, true), (GUIDED, false)] {
        let mut rig = Rig::new(Wanted::default());
        (rig.mode, rig.armed, rig.feed) = (mode, armed, true);
        rig.run(2000);
        rig.speaks_until = 2000;
        rig.run(5000);
        assert_eq!(rig.ours(COMMAND_LONG, 0), []);
        // A pilot's LOITER needs to know where it is as much as ours.
        assert!(rig.ours(VISION, 0).len() > 100);
    }
}

#[test]
fn another_autopilot_on_the_link_is_not_ours() {
    let mut rig = Rig::flying();
    // System 7 says that it stands on the ground.
    let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
    let beat = HEARTBEAT_DATA { autopilot, ..HEARTBEAT_DATA::default() };
    let other = rig.packet((7, 1), &MavMessage::HEARTBEAT(beat));
    rig.watch.handle_autopilot(at(rig.ms), &other);
    rig.speaks_until = 2000;
    rig.run(2600);
    assert!(!rig.ours(COMMAND_LONG, 0).is_empty());
}

#[test]
fn a_runtime_that_wakes_up_orders_nothing_more() {
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
    assert!(ids.contains(&VISION) && ids.contains(&HEARTBEAT), "its poses pass");
    assert!(rig.ours(COMMAND_LONG, 0).len() == ids.iter().filter(|id| **id == 76).count());
    // The pilot took it, and later gives it back: the runtime is heard again.
    rig.mode = LOITER;
    rig.run(4100);
    rig.sent.packets.clear();
    rig.run(4200);
    let passes =
        rig.sent.packets.iter().any(|(_, b)| Head::of(b).unwrap().id == SET_POSITION_TARGET);
    assert!(passes);
}

#[test]
fn a_computer_that_stood_still_is_no_silence() {
    let mut rig = Rig::flying();
    // Nobody was run for 3 s; the guardian happens to be the first.
    rig.ms += 3000;
    rig.watch.handle_timeout(at(rig.ms), &mut rig.sent);
    rig.ms += 10;
    rig.watch.handle_timeout(at(rig.ms), &mut rig.sent);
    rig.run(rig.ms + 500);
    assert_eq!(rig.ours(COMMAND_LONG, 0), []);
}

#[test]
fn stale_poses_are_not_sent() {
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
fn with_a_key_ours_is_signed_and_an_unsigned_heartbeat_is_nobodys() {
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
    // Somebody says, unsigned, that it stands on the ground.
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
    assert!(!lands.is_empty(), "it is landed all the same");
    for (ms, bytes) in lands {
        verifier.check(start.plus_us(ms * 1000), bytes).unwrap();
    }
}

proptest! {
    /// Whatever comes, and in whichever order, LAND is ordered within half a second of the runtime's last packet
    /// while the vehicle follows it, and never while it speaks.
    #[test]
    fn land_comes_when_it_is_silent_and_then_alone(
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
