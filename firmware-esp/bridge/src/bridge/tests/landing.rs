//! Landing when the companion is silent: conditions, announcements and signatures.

use vizflyt_protocol::mavlink::dialect::{MavState, MavType};
use vizflyt_protocol::mavlink::{Signer, SigningKey, SigningTime, Verifier};

use super::*;
use crate::settings::key_to_hex;

const KEY: [u8; 32] = [0x17; 32];
const LAND_MODE: u32 = 9;
/// A time in 2026 [10 us since 2015].
const STAMP: u64 = 37_000_000_000_000;

/// A vehicle in GUIDED; its companion falls silent after a second.
struct Loss {
    bridge: Bridge,
    now: u64,
    companion_until: u64,
    mode: u32,
    armed: bool,
    signer: Option<Signer>,
    /// Packets sent to the autopilot, with their times [ms].
    sent: Vec<(u64, Vec<u8>)>,
    /// Packets of the bridge that a ground station received.
    heard: Vec<Vec<u8>>,
    texts: Vec<std::string::String>,
}

impl Loss {
    fn new(settings: Settings, signs: bool) -> Self {
        let mut bridge = bridge(settings);
        bridge.handle_datagram(at(0), address(9), &bytes(0, (254, 190), &heartbeat(false, 0)));
        let signer = signs.then(|| Signer::new(SigningKey::new(KEY), 0));
        Self {
            bridge,
            now: 0,
            companion_until: 1000,
            mode: 4,
            armed: true,
            signer,
            sent: Vec::new(),
            heard: Vec::new(),
            texts: Vec::new(),
        }
    }

    fn sign(&mut self, packet: Vec<u8>) -> Vec<u8> {
        let Some(signer) = &mut self.signer else { return packet };
        let mut whole = [0; MAX_PACKET];
        whole[..packet.len()].copy_from_slice(&packet);
        let stamp = SigningTime::from_units(STAMP + self.now * 100);
        let len = signer.sign(stamp, &mut whole, packet.len());
        whole[..len].to_vec()
    }

    fn run(&mut self, until: u64) {
        while self.now < until {
            let now = at(self.now);
            if self.now.is_multiple_of(1000) {
                let beat = self.sign(bytes(0, AUTOPILOT, &heartbeat(self.armed, self.mode)));
                self.bridge.handle_uart(now, &beat);
            }
            if self.now <= self.companion_until && self.now.is_multiple_of(20) {
                let message = if self.now.is_multiple_of(1000) {
                    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
                        mavtype: MavType::MAV_TYPE_ONBOARD_CONTROLLER,
                        autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
                        system_status: MavState::MAV_STATE_ACTIVE,
                        ..Default::default()
                    })
                } else {
                    setpoint(0.0)
                };
                let packet = self.sign(bytes(0, RUNTIME, &message));
                self.bridge.handle_datagram(now, address(2), &packet);
            }
            self.bridge.handle_timeout(now);
            for packet in uart(&mut self.bridge, now) {
                self.sent.push((self.now, packet));
            }
            for (to, datagram) in datagrams(&mut self.bridge, now) {
                let mut cut = crate::packet::CutStats::default();
                crate::packet::each_in_datagram(&datagram, &mut cut, |packet| {
                    if packet.source().1 == COMPONENT_ID && to == address(9) {
                        self.heard.push(packet.bytes().to_vec());
                    }
                });
                assert_eq!(cut.dropped_bytes, 0);
                for packet in decode(&datagram).into_iter().filter(|_| to == address(9)) {
                    if let MavMessage::STATUSTEXT(text) = packet.message {
                        self.texts.push(text.text.to_str().unwrap().into());
                    }
                }
            }
            self.now += 10;
        }
    }

    fn acknowledge(&mut self) {
        let ack = MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
            command: MavCmd::MAV_CMD_NAV_LAND,
            target_system: 1,
            target_component: COMPONENT_ID,
            ..Default::default()
        });
        let packet = self.sign(bytes(1, AUTOPILOT, &ack));
        self.bridge.handle_uart(at(self.now), &packet);
    }

    /// Returns when heartbeats of `system` were sent to the autopilot by the bridge [ms].
    fn beats(&self, system: u8) -> Vec<u64> {
        let ours = |packet: &&(u64, Vec<u8>)| {
            packet.1[7..10] == [0, 0, 0] && (packet.1[5], packet.1[6]) == (system, COMPONENT_ID)
        };
        self.sent.iter().filter(ours).map(|(ms, _)| *ms).collect()
    }

    fn says(&self, text: &str) -> bool {
        self.texts.iter().any(|said| said == text)
    }
}

#[test]
fn announces_landing_only_after_the_autopilot_confirms() {
    let mut loss = Loss::new(quiet(), false);
    loss.run(2300);
    assert!(loss.says("bridge: the companion is silent: asks for LAND"), "{:?}", loss.texts);
    assert!(!loss.says("bridge: landing") && !loss.bridge.is_landing());
    loss.acknowledge();
    loss.run(2400);
    assert!(loss.says("bridge: landing") && loss.bridge.is_landing(), "{:?}", loss.texts);
    // A heartbeat with the LAND mode also confirms.
    let mut loss = Loss::new(quiet(), false);
    loss.run(2300);
    loss.mode = LAND_MODE;
    loss.run(3100);
    assert!(loss.says("bridge: landing") && loss.bridge.is_landing(), "{:?}", loss.texts);
    assert_eq!(loss.bridge.stats().landings, 1);
}

#[test]
fn reports_an_unacknowledged_land() {
    let mut loss = Loss::new(quiet(), false);
    loss.run(6000);
    assert!(loss.says("bridge: LAND is not acknowledged"), "{:?}", loss.texts);
    assert!(!loss.says("bridge: landing") && !loss.bridge.is_landing());
    let mut request = crate::http::Request::new();
    request.push(b"GET / HTTP/1.0\r\n\r\n");
    let mut page = crate::page::Response::new();
    assert!(crate::page::respond(&loss.bridge, at(loss.now), &request, None, 0, &mut page));
    assert!(page.contains("LAND is not acknowledged"), "{page}");
}

#[test]
fn reports_a_missing_vehicle_key() {
    let mut loss = Loss::new(quiet(), true);
    loss.run(6000);
    assert!(loss.says("bridge: LAND not acknowledged: vehicle.key missing"), "{:?}", loss.texts);
    assert!(!loss.says("bridge: landing") && !loss.bridge.is_landing());
}

#[test]
fn signs_all_own_packets_with_the_vehicle_key() {
    let mut settings = quiet();
    settings.set("vehicle.key", &key_to_hex(&KEY)).unwrap();
    let mut loss = Loss::new(settings, true);
    loss.run(2300);
    let mut verifier = Verifier::new(SigningKey::new(KEY));
    // The autopilot's clock; signatures may be at most a minute old.
    let now = SigningTime::from_units(STAMP + 1000);
    let (mut ours, mut lands) = (0, 0);
    for (ms, packet) in &loss.sent {
        if packet[6] == COMPONENT_ID {
            assert_eq!(verifier.check(now, packet), Ok(()), "at {ms} ms");
            ours += 1;
            lands += u32::from(packet[7] == 76);
        }
    }
    assert!(ours > lands && lands == 1, "{ours} {lands}");
    let mut verifier = Verifier::new(SigningKey::new(KEY));
    for packet in &loss.heard {
        assert_eq!(verifier.check(now, packet), Ok(()), "accepted by a station with the key");
    }
    assert!(loss.heard.len() > 2);
    loss.acknowledge();
    loss.run(2400);
    assert!(loss.says("bridge: landing"));
}

#[test]
fn sends_unsigned_packets_if_the_autopilot_does_not_sign() {
    let mut settings = quiet();
    settings.set("vehicle.key", &key_to_hex(&KEY)).unwrap();
    let mut loss = Loss::new(settings, false);
    loss.run(2300);
    assert!(loss.sent.iter().all(|(_, packet)| packet[2] == 0));
}

#[test]
fn repeats_the_companions_heartbeat_while_landing() {
    let mut loss = Loss::new(quiet(), false);
    loss.run(2200);
    loss.acknowledge();
    // Acknowledged, but not yet in LAND mode: heartbeats would suppress the autopilot's own failsafe.
    loss.run(2990);
    assert_eq!(loss.beats(255), Vec::<u64>::new());
    loss.mode = LAND_MODE;
    loss.run(8000);
    let beats = loss.beats(255);
    assert!(beats.len() >= 9 && beats.windows(2).all(|w| w[1] - w[0] == 500), "{beats:?}");
    // Same content as the companion's own heartbeat.
    let (_, beat) =
        loss.sent.iter().find(|(ms, packet)| *ms == beats[0] && packet[5] == 255).unwrap();
    let MavMessage::HEARTBEAT(heartbeat) = &decode(beat)[0].message else { panic!() };
    assert_eq!(heartbeat.mavtype, MavType::MAV_TYPE_ONBOARD_CONTROLLER);
    // No LAND while it lands, and no heartbeats after it has landed.
    let lands = loss.sent.iter().filter(|(ms, packet)| *ms > 3100 && packet[7] == 76).count();
    assert_eq!(lands, 0);
    loss.armed = false;
    loss.run(12_000);
    assert_eq!(loss.beats(255).len(), beats.len(), "the heartbeat at 8 s reports disarmed");
    assert!(!loss.bridge.is_landing());
}

#[test]
fn stops_heartbeats_when_companion_or_pilot_takes_over() {
    let mut loss = Loss::new(quiet(), false);
    loss.run(2200);
    loss.mode = LAND_MODE;
    loss.run(5500);
    let before = loss.beats(255).len();
    assert!(before > 0);
    loss.companion_until = u64::MAX;
    loss.run(9000);
    assert_eq!(loss.beats(255).len(), before, "the companion sends its own");
    loss.companion_until = 0;
    loss.run(12_000);
    assert!(loss.beats(255).len() > before, "silent again");
    loss.mode = 5;
    loss.run(13_100);
    let before = loss.beats(255).len();
    loss.run(16_000);
    assert_eq!(loss.beats(255).len(), before, "a pilot has taken over");
    assert!(!loss.bridge.is_landing());
}

#[test]
fn stops_heartbeats_after_the_maximum_landing_time() {
    let mut loss = Loss::new(quiet(), false);
    loss.run(2200);
    loss.mode = LAND_MODE;
    loss.run(200_000);
    let last = *loss.beats(255).last().unwrap();
    assert!((110_000..130_000).contains(&last), "{last}");
}
