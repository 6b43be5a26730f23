//! Independence of clients: no gaps in the autopilot's sequence numbers, no throttling by slow clients.

use std::collections::BTreeMap;

use super::*;

const STATION: (u8, u8) = (254, 190);

/// Counts gaps in the autopilot's sequence numbers, as a ground station does: pymavlink's `mav_loss`.
#[derive(Default)]
struct StationLoss {
    next: Option<u8>,
    lost: u32,
    packets: u32,
}

impl StationLoss {
    fn note(&mut self, sequence: u8) {
        if let Some(next) = self.next {
            self.lost += u32::from(sequence.wrapping_sub(next));
        }
        self.next = Some(sequence.wrapping_add(1));
        self.packets += 1;
    }
}

fn timesync(tc1: i64, ts1: i64) -> MavMessage {
    MavMessage::TIMESYNC(TIMESYNC_DATA { tc1, ts1, ..Default::default() })
}

fn ack(target: (u8, u8)) -> MavMessage {
    MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
        target_system: target.0,
        target_component: target.1,
        ..Default::default()
    })
}

#[test]
fn clients_see_no_gaps_when_others_get_replies() {
    let mut bridge = bridge(quiet());
    let mut seen: BTreeMap<u8, StationLoss> = BTreeMap::new();
    let mut sequence = 0u8;
    let mut asked = Vec::new();
    for ms in (0..20_000u64).step_by(20) {
        let companion = if ms % 1000 == 0 { heartbeat(false, 0) } else { setpoint(0.0) };
        bridge.handle_datagram(at(ms), address(2), &bytes(0, RUNTIME, &companion));
        if ms % 1000 == 0 {
            bridge.handle_datagram(at(ms), address(3), &bytes(0, STATION, &heartbeat(false, 0)));
        }
        let mut send = |bridge: &mut Bridge, message: &MavMessage| {
            bridge.handle_uart(at(ms), &bytes(sequence, AUTOPILOT, message));
            sequence = sequence.wrapping_add(1);
        };
        send(&mut bridge, &attitude(0.0));
        if ms % 1000 == 0 {
            send(&mut bridge, &heartbeat(false, 0));
            for target in [RUNTIME, STATION, (1, COMPONENT_ID), (0, 0)] {
                send(&mut bridge, &ack(target));
            }
        }
        for ts1 in asked.drain(..) {
            send(&mut bridge, &timesync(7, ts1));
        }
        bridge.handle_timeout(at(ms));
        for packet in uart(&mut bridge, at(ms)).iter().flat_map(|packet| decode(packet)) {
            if let MavMessage::TIMESYNC(request) = packet.message {
                asked.push(request.ts1);
            }
        }
        for (to, datagram) in datagrams(&mut bridge, at(ms + 10)) {
            for packet in decode(&datagram) {
                if packet.header.component_id == AUTOPILOT.1 {
                    let station = seen.entry(to.ip().octets()[3]).or_default();
                    station.note(packet.header.sequence);
                }
            }
        }
    }
    for last in [2, 3] {
        let station = &seen[&last];
        assert!(station.packets > 1000, "{}", station.packets);
        assert_eq!(station.lost, 0, "client {last}");
    }
}

/// Runs a companion on UDP and a TCP client that never reads. Returns the `txbuf` values sent to the autopilot, the
/// number of packets that the companion received, and the number of clients at the end.
fn beside_a_client_that_does_not_read(seconds: u64) -> (Vec<u8>, usize, usize) {
    let mut bridge = bridge(Settings { beacon: false, ..Settings::default() });
    bridge.open_stream(at(0), 0);
    let (mut rooms, mut got) = (Vec::new(), 0);
    for ms in 0..seconds * 1000 {
        if ms % 20 == 0 {
            bridge.handle_datagram(at(ms), address(2), &bytes(0, RUNTIME, &setpoint(0.0)));
        }
        if ms % 1000 == 0 {
            bridge.handle_uart(at(ms), &bytes(0, AUTOPILOT, &heartbeat(false, 0)));
        }
        bridge.handle_uart(at(ms), &bytes(0, AUTOPILOT, &attitude(0.0)));
        bridge.handle_timeout(at(ms));
        for packet in uart(&mut bridge, at(ms)).iter().flat_map(|packet| decode(packet)) {
            if let MavMessage::RADIO_STATUS(status) = packet.message {
                rooms.push(status.txbuf);
            }
        }
        got += datagrams(&mut bridge, at(ms + 1)).iter().map(|(_, b)| others(b)).sum::<usize>();
    }
    (rooms, got, bridge.clients().count())
}

#[test]
fn a_stalled_client_does_not_throttle_others() {
    let (rooms, got, _) = beside_a_client_that_does_not_read(4);
    assert!(rooms.len() >= 3 && rooms.iter().all(|&room| room > 90), "{rooms:?}");
    assert!(got > 3900, "{got}");
}

#[test]
fn disconnects_a_stalled_client() {
    assert_eq!(beside_a_client_that_does_not_read(4).2, 2, "a pause is tolerated");
    assert_eq!(beside_a_client_that_does_not_read(8).2, 1);
}

proptest! {
    /// Pauses inside packets lose nothing, because checksums decide, not timeouts. One in 256 pieces of garbage that
    /// look like an unknown message is forwarded, together with the packets that it swallowed.
    #[test]
    fn a_pause_inside_a_packet_loses_nothing(
        pauses in prop::collection::vec((0..200u64, 1..40usize), 10),
        garbage in prop::collection::vec(any::<u8>(), 0..30),
    ) {
        let mut bridge = bridge(quiet());
        bridge.handle_datagram(at(0), address(2), &bytes(0, RUNTIME, &setpoint(0.0)));
        let (mut now, mut arrived) = (10, Vec::new());
        let mut cut = crate::packet::CutStats::default();
        let mut take = |bridge: &mut Bridge, now: u64| {
            bridge.handle_timeout(at(now));
            for (_, datagram) in datagrams(bridge, at(now)) {
                crate::packet::each_in_datagram(&datagram, &mut cut, |packet| {
                    if packet.id() == 30 {
                        arrived.push(packet.sequence());
                    }
                });
            }
        };
        for (number, &(pause_ms, at_byte)) in pauses.iter().enumerate() {
            let packet = bytes(number as u8, AUTOPILOT, &attitude(0.25));
            let (first, rest) = packet.split_at(at_byte.min(packet.len() - 1));
            bridge.handle_uart(at(now), first);
            for ms in 0..pause_ms {
                take(&mut bridge, now + ms);
            }
            now += pause_ms;
            bridge.handle_uart(at(now), rest);
            if number == 4 {
                bridge.handle_uart(at(now), &garbage);
            }
            now += 5;
            take(&mut bridge, now);
        }
        // Garbage cannot claim more bytes than a packet has.
        bridge.handle_uart(at(now), &[0; 300]);
        take(&mut bridge, now + 100);
        let swallowed = 10 - arrived.len() as u8;
        prop_assert!(swallowed == 0 || cut.unknown > 0, "{arrived:?}");
        prop_assert_eq!(arrived, (0..5).chain(5 + swallowed..10).collect::<Vec<u8>>());
    }
}

#[test]
fn announces_the_restart_cause_to_the_first_active_client() {
    // The fixed client of the settings is absent.
    let mut bridge = bridge(Settings { client: Some(address(9)), ..Settings::default() });
    bridge.set_restart_cause(crate::stats::RestartCause::Watchdog);
    let told = |bridge: &mut Bridge, now: HostTime| {
        bridge.handle_timeout(now);
        let all = datagrams(bridge, now);
        let texts = all.iter().flat_map(|(_, bytes)| decode(bytes));
        texts.filter(|packet| matches!(packet.message, MavMessage::STATUSTEXT(_))).count()
    };
    for second in 1..4 {
        assert_eq!(told(&mut bridge, at(1000 * second)), 0);
    }
    bridge.handle_datagram(at(3500), address(2), &bytes(0, RUNTIME, &heartbeat(false, 0)));
    // To the active client and to the fixed one.
    assert_eq!(told(&mut bridge, at(4100)), 2);
    assert_eq!(told(&mut bridge, at(5200)), 0);
}
