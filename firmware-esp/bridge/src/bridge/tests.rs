extern crate std;

use core::net::Ipv4Addr;
use std::vec;
use std::vec::Vec;

use proptest::prelude::*;
use vizflyt_protocol::mavlink::dialect::{
    ATTITUDE_DATA, COMMAND_ACK_DATA, COMMAND_LONG_DATA, HEARTBEAT_DATA, MavAutopilot, MavCmd,
    MavMessage, MavModeFlag, MavResult, MavType, PARAM_SET_DATA, PARAM_VALUE_DATA,
    SET_POSITION_TARGET_LOCAL_NED_DATA, TIMESYNC_DATA,
};
use vizflyt_protocol::mavlink::{MavHeader, Message, Packet, StreamDecoder, encode};

use super::*;
use crate::access;
use crate::packet::Raw;
use crate::stats::Reason;

pub(super) const AUTOPILOT: (u8, u8) = (1, 1);
pub(super) const RUNTIME: (u8, u8) = (255, 191);

pub(super) fn at(ms: u64) -> HostTime {
    HostTime::from_ns(ms * 1_000_000)
}

pub(super) fn address(last: u8) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(192, 168, 4, last), 14550)
}

pub(super) fn bytes(sequence: u8, from: (u8, u8), message: &MavMessage) -> Vec<u8> {
    let header = MavHeader { system_id: from.0.into(), component_id: from.1, sequence };
    encode(header, message, &mut [0; MAX_PACKET]).to_vec()
}

pub(super) fn heartbeat(armed: bool, mode: u32) -> MavMessage {
    let mut base_mode = MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED;
    base_mode.set(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED, armed);
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: mode,
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode,
        ..Default::default()
    })
}

pub(super) fn setpoint(x: f32) -> MavMessage {
    let to = SET_POSITION_TARGET_LOCAL_NED_DATA {
        x,
        target_system: 1,
        target_component: 1,
        ..Default::default()
    };
    MavMessage::SET_POSITION_TARGET_LOCAL_NED(to)
}

fn attitude(roll: f32) -> MavMessage {
    MavMessage::ATTITUDE(ATTITUDE_DATA { roll, ..Default::default() })
}

fn param(index: u16) -> MavMessage {
    MavMessage::PARAM_VALUE(PARAM_VALUE_DATA { param_index: index, ..Default::default() })
}

/// Settings without optional messages of the bridge.
fn quiet() -> Settings {
    Settings { radio_status: false, beacon: false, ..Settings::default() }
}

pub(super) fn bridge(settings: Settings) -> Bridge {
    let chip = Chip { address: [2, 0, 0, 1, 2, 3], random: [7; 16] };
    Bridge::new(at(0), settings, chip)
}

/// Returns all datagrams due at `now`.
pub(super) fn datagrams(bridge: &mut Bridge, now: HostTime) -> Vec<(SocketAddrV4, Vec<u8>)> {
    let mut out = [0; 1472];
    let mut all = Vec::new();
    while let Some((to, len)) = bridge.poll_udp(now, &mut out) {
        all.push((to, out[..len].to_vec()));
    }
    all
}

/// Returns all packets for the autopilot.
pub(super) fn uart(bridge: &mut Bridge, now: HostTime) -> Vec<Vec<u8>> {
    let mut out = [0; MAX_PACKET];
    let mut all = Vec::new();
    loop {
        match bridge.poll_uart(now, &mut out) {
            0 => return all,
            len => all.push(out[..len].to_vec()),
        }
    }
}

pub(super) fn decode(bytes: &[u8]) -> Vec<Packet> {
    let mut packets = Vec::new();
    StreamDecoder::default().push(bytes, |packet| packets.push(packet));
    packets
}

/// Returns the number of packets that are not from the bridge.
fn others(bytes: &[u8]) -> usize {
    decode(bytes).iter().filter(|packet| packet.header.component_id != COMPONENT_ID).count()
}

/// Returns the packets that are not from the bridge.
fn foreign(packets: Vec<Vec<u8>>) -> Vec<Vec<u8>> {
    packets.into_iter().filter(|packet| packet[6] != COMPONENT_ID).collect()
}

#[test]
fn forwards_packets_unchanged_in_both_directions() {
    let mut bridge = bridge(quiet());
    let from_runtime = bytes(0, RUNTIME, &setpoint(1.0));
    bridge.handle_datagram(at(1), address(2), &from_runtime);
    assert_eq!(foreign(uart(&mut bridge, at(1))), [from_runtime]);
    let telemetry =
        [bytes(0, AUTOPILOT, &heartbeat(false, 0)), bytes(1, AUTOPILOT, &attitude(0.5))];
    bridge.handle_uart(at(5), &telemetry.concat());
    // Nothing is sent until the line has been silent for half a millisecond.
    assert_eq!(datagrams(&mut bridge, at(5)), []);
    assert_eq!(bridge.udp_due(), Some(at(5).plus_ns(500_000)));
    let sent = datagrams(&mut bridge, at(6));
    assert_eq!(sent, [(address(2), telemetry.concat())]);
    assert_eq!(bridge.stats().drops, [0; 6]);
}

#[test]
fn batches_a_busy_line_until_timeout_or_full_datagram() {
    let mut bridge = bridge(Settings { batch_us: 5000, ..quiet() });
    bridge.handle_datagram(at(0), address(2), &bytes(0, RUNTIME, &setpoint(0.0)));
    let packet = bytes(0, AUTOPILOT, &attitude(0.25));
    // A packet each half millisecond: the line is never silent.
    let mut sent = Vec::new();
    for tick in 0..200u64 {
        let now = HostTime::from_ns(1_000_000_000 + tick * 500_000);
        let mut next = packet.clone();
        next.extend_from_slice(&packet[..3]);
        // The next packet has begun, so that the line is busy.
        bridge.handle_uart(now, if tick == 0 { &next } else { &packet[3..] });
        if tick > 0 {
            bridge.handle_uart(now, &packet[..3]);
        }
        for (_, bytes) in datagrams(&mut bridge, now) {
            sent.push((now, bytes.len() / packet.len()));
        }
    }
    assert!(sent.iter().skip(2).all(|&(_, packets)| packets == 11 || packets == 10), "{sent:?}");
    // Large packets fill a datagram before the timeout.
    let large = bytes(0, AUTOPILOT, &param(1)).repeat(60);
    bridge.handle_uart(at(3000), &large);
    let whole = datagrams(&mut bridge, at(3000));
    assert!(whole.iter().all(|(_, bytes)| bytes.len() <= 1400 && decode(bytes).len() > 20));
}

#[test]
fn sends_replies_without_waiting_for_a_batch() {
    let mut bridge = bridge(quiet());
    bridge.handle_datagram(at(0), address(2), &bytes(0, RUNTIME, &setpoint(0.0)));
    let ack = MavMessage::COMMAND_ACK(COMMAND_ACK_DATA::default());
    bridge.handle_uart(at(1), &bytes(0, AUTOPILOT, &ack));
    assert_eq!(datagrams(&mut bridge, at(1)).len(), 1);
}

#[test]
fn setpoints_and_commands_overtake_without_loss() {
    let mut bridge = bridge(quiet());
    for index in 0..20 {
        bridge.handle_datagram(at(1), address(2), &bytes(index, RUNTIME, &param(index.into())));
    }
    let now = [bytes(20, RUNTIME, &setpoint(1.0)), bytes(21, RUNTIME, &heartbeat(false, 0))];
    bridge.handle_datagram(at(2), address(2), &now.concat());
    let order: Vec<u8> = foreign(uart(&mut bridge, at(3))).iter().map(|packet| packet[4]).collect();
    let expected: Vec<u8> = [20, 21].into_iter().chain(0..20).collect();
    assert_eq!(order, expected);
    assert_eq!(bridge.stats().drops, [0; 6]);
}

#[test]
fn drops_a_late_setpoint_when_a_newer_one_waits() {
    let mut bridge = bridge(quiet());
    let send = |bridge: &mut Bridge, ms: u64, x: f32, from: (u8, u8)| {
        bridge.handle_datagram(at(ms), address(2), &bytes(x as u8, from, &setpoint(x)));
    };
    send(&mut bridge, 0, 1.0, RUNTIME);
    send(&mut bridge, 10, 2.0, RUNTIME);
    // Two setpoints within a period are both sent.
    assert_eq!(foreign(uart(&mut bridge, at(20))).len(), 2);
    send(&mut bridge, 100, 3.0, RUNTIME);
    send(&mut bridge, 120, 4.0, RUNTIME);
    send(&mut bridge, 121, 5.0, (254, 1));
    let order: Vec<u8> =
        foreign(uart(&mut bridge, at(130))).iter().map(|packet| packet[4]).collect();
    assert_eq!(order, [4, 5]);
    assert_eq!(bridge.stats().dropped(Reason::Superseded), 1);
}

#[test]
fn full_port_keeps_newest_setpoints_all_commands_and_oldest_others() {
    let mut bridge = bridge(quiet());
    for round in 0..200u8 {
        bridge.handle_datagram(at(1), address(2), &bytes(round, RUNTIME, &param(round.into())));
        bridge.handle_datagram(at(1), address(3), &bytes(round, (200, 1), &setpoint(round.into())));
        if round % 20 == 0 {
            let beat = heartbeat(false, 0);
            bridge.handle_datagram(at(1), address(4), &bytes(round, (201, 1), &beat));
        }
    }
    let left = foreign(uart(&mut bridge, at(1)));
    let from = |system: u8| -> Vec<u8> {
        left.iter().filter(|packet| packet[5] == system).map(|packet| packet[4]).collect()
    };
    assert_eq!(from(200).last(), Some(&199));
    assert!(from(200).is_sorted());
    assert_eq!(from(255).first(), Some(&0));
    assert_eq!(from(201).len(), 10, "every command");
    let stats = bridge.stats();
    assert_eq!(stats.dropped(Reason::Superseded) as usize, 200 - from(200).len());
    assert_eq!(stats.dropped(Reason::UartFull) as usize, 200 - from(255).len());
    // A flood of commands only is also bounded and counted.
    for round in 0..200u8 {
        bridge.handle_datagram(at(2), address(4), &bytes(round, (201, 1), &heartbeat(false, 0)));
    }
    let kept = foreign(uart(&mut bridge, at(2))).len();
    let full = bridge.stats().dropped(Reason::UartFull) as usize;
    assert_eq!(full + kept + from(255).len(), 400);
}

#[test]
fn all_clients_receive_telemetry_and_reach_each_other() {
    let mut bridge = bridge(quiet());
    bridge.handle_uart(at(0), &bytes(0, AUTOPILOT, &heartbeat(false, 0)));
    bridge.handle_datagram(at(1), address(2), &bytes(0, RUNTIME, &setpoint(0.0)));
    bridge.handle_datagram(at(1), address(3), &bytes(0, (254, 190), &heartbeat(false, 0)));
    let ack = |target: (u8, u8)| {
        MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
            result: MavResult::MAV_RESULT_DENIED,
            target_system: target.0,
            target_component: target.1,
            ..Default::default()
        })
    };
    // All clients receive replies to one of them, so that their sequence numbers have no gaps.
    for (now, target) in
        [(10, RUNTIME), (11, (254, 190)), (12, (255, 0)), (13, (0, 0)), (14, (77, 1))]
    {
        bridge.handle_uart(at(now), &bytes(0, AUTOPILOT, &ack(target)));
        let mut to: Vec<u8> =
            datagrams(&mut bridge, at(now)).iter().map(|(to, _)| to.ip().octets()[3]).collect();
        to.sort_unstable();
        assert_eq!(to, [2, 3], "{target:?}");
    }
    // From one client to the other, but not to the autopilot.
    uart(&mut bridge, at(14));
    let to_station = bytes(1, RUNTIME, &ack((254, 190)));
    bridge.handle_datagram(at(20), address(2), &to_station);
    assert_eq!(datagrams(&mut bridge, at(20)), [(address(3), to_station)]);
    assert_eq!(foreign(uart(&mut bridge, at(20))), Vec::<Vec<u8>>::new());
}

#[test]
fn replaces_and_removes_silent_clients() {
    let mut bridge = bridge(Settings { client: Some(address(99)), ..quiet() });
    assert_eq!(bridge.clients().count(), 1);
    for last in 2..9 {
        bridge.handle_datagram(at(0), address(last), &bytes(0, RUNTIME, &setpoint(0.0)));
    }
    // Without a valid packet, the sender does not become a client.
    bridge.handle_datagram(at(0), address(50), b"GET / HTTP/1.1");
    assert_eq!(bridge.clients().count(), CLIENTS);
    // All places are taken by active clients.
    bridge.handle_datagram(at(100), address(60), &bytes(0, RUNTIME, &setpoint(0.0)));
    assert_eq!(bridge.stats().dropped(Reason::TooManyClients), 1);
    for last in 3..9 {
        bridge.handle_datagram(at(3000), address(last), &bytes(1, RUNTIME, &setpoint(0.0)));
    }
    // The client with the longest silence is replaced.
    bridge.handle_datagram(at(3001), address(60), &bytes(0, RUNTIME, &setpoint(0.0)));
    let here: Vec<Peer> = bridge.clients().map(|(peer, _, _)| peer).collect();
    assert!(here.contains(&Peer::Udp(address(60))) && !here.contains(&Peer::Udp(address(2))));
    bridge.handle_timeout(at(20_000));
    let here: Vec<Peer> = bridge.clients().map(|(peer, _, _)| peer).collect();
    assert_eq!(here, [Peer::Udp(address(99))], "the fixed one stays");
}

#[test]
fn a_slow_tcp_client_loses_only_its_own_oldest_packets() {
    let mut bridge = bridge(quiet());
    bridge.open_stream(at(0), 0);
    bridge.handle_datagram(at(0), address(2), &bytes(0, RUNTIME, &setpoint(0.0)));
    let mut quick = 0;
    for index in 0..400u16 {
        bridge.handle_uart(at(u64::from(index)), &bytes(index as u8, AUTOPILOT, &param(index)));
        let due = at(u64::from(index) + 5);
        quick += datagrams(&mut bridge, due).iter().map(|(_, b)| others(b)).sum::<usize>();
    }
    assert_eq!(quick, 400);
    let (mut out, mut slow) = ([0; 536], Vec::new());
    loop {
        match bridge.poll_tcp(at(500), 0, &mut out) {
            0 => break,
            len => slow.extend(decode(&out[..len])),
        }
    }
    slow.retain(|packet| packet.header.component_id != COMPONENT_ID);
    let dropped = bridge.stats().dropped(Reason::ClientSlow) as usize;
    assert_eq!(slow.len() + dropped, 400);
    assert!(dropped > 100 && slow.len() > 100);
    let MavMessage::PARAM_VALUE(last) = &slow[slow.len() - 1].message else { panic!() };
    assert_eq!(last.param_index, 399);
    bridge.close_stream(0);
    assert_eq!(bridge.clients().count(), 1);
}

fn heartbeat_of(mavtype: MavType) -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: 4,
        mavtype,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode: MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED,
        ..Default::default()
    })
}

#[test]
fn only_a_multirotor_counts_as_the_vehicle() {
    let mut bridge = bridge(Settings::unnamed());
    bridge.handle_uart(at(0), &bytes(0, (1, 154), &heartbeat_of(MavType::MAV_TYPE_GIMBAL)));
    assert_eq!((bridge.autopilot(), bridge.is_armed()), (None, false));
    // Another vehicle, so that stations find it, until a multirotor is heard.
    let tracker = heartbeat_of(MavType::MAV_TYPE_ANTENNA_TRACKER);
    bridge.handle_uart(at(1), &bytes(0, (2, 1), &tracker));
    assert_eq!((bridge.autopilot(), bridge.is_armed()), (Some((2, 1)), true));
    bridge.handle_uart(at(2), &bytes(1, AUTOPILOT, &heartbeat(false, 0)));
    bridge.handle_uart(at(3), &bytes(2, (2, 1), &tracker));
    bridge.handle_uart(at(4), &bytes(3, (1, 154), &heartbeat_of(MavType::MAV_TYPE_GIMBAL)));
    bridge.handle_uart(at(5), &bytes(4, (7, 1), &heartbeat_of(MavType::MAV_TYPE_QUADROTOR)));
    assert_eq!((bridge.autopilot(), bridge.is_armed()), (Some(AUTOPILOT), false));
}

#[test]
fn broadcasts_heartbeats_until_a_client_connects() {
    let mut bridge = bridge(Settings { radio_status: false, ..Settings::default() });
    bridge.set_network(Some(address(255)));
    let beat = bytes(3, AUTOPILOT, &heartbeat(false, 0));
    bridge.handle_uart(at(10), &beat);
    bridge.handle_uart(at(20), &bytes(4, AUTOPILOT, &attitude(0.0)));
    bridge.handle_timeout(at(1100));
    assert_eq!(datagrams(&mut bridge, at(1100)), [(address(255), beat)]);
    assert_eq!(datagrams(&mut bridge, at(1200)), []);
    bridge.handle_datagram(at(1300), address(2), &bytes(0, RUNTIME, &setpoint(0.0)));
    bridge.handle_timeout(at(2500));
    let sent = datagrams(&mut bridge, at(2510));
    assert!(sent.iter().all(|&(to, _)| to == address(2)), "{sent:?}");
}

#[test]
fn lands_when_the_companion_is_silent() {
    let mut bridge = bridge(quiet());
    let mut seen = Vec::new();
    for ms in (0..2500).step_by(10) {
        if ms % 1000 == 0 {
            bridge.handle_uart(at(ms), &bytes(0, AUTOPILOT, &heartbeat(true, 4)));
        }
        if ms <= 500 {
            bridge.handle_datagram(at(ms), address(2), &bytes(0, RUNTIME, &setpoint(0.0)));
        }
        bridge.handle_timeout(at(ms));
        for packet in uart(&mut bridge, at(ms)).iter().flat_map(|packet| decode(packet)) {
            if let MavMessage::COMMAND_LONG(command) = packet.message {
                assert_eq!(
                    (packet.header.system_id, packet.header.component_id),
                    (1, COMPONENT_ID)
                );
                assert_eq!(command.command, MavCmd::MAV_CMD_NAV_LAND);
                seen.push((ms, command.confirmation));
                if command.confirmation == 1 {
                    let ack = COMMAND_ACK_DATA {
                        command: MavCmd::MAV_CMD_NAV_LAND,
                        result: MavResult::MAV_RESULT_ACCEPTED,
                        target_system: 1,
                        target_component: COMPONENT_ID,
                        ..Default::default()
                    };
                    bridge.handle_uart(at(ms), &bytes(0, AUTOPILOT, &MavMessage::COMMAND_ACK(ack)));
                }
            }
        }
    }
    assert_eq!(seen, [(1500, 0), (1800, 1)]);
    assert!(bridge.is_landing());
    let reported = datagrams(&mut bridge, at(2600)).iter().flat_map(|(_, b)| decode(b)).any(|packet| {
        matches!(packet.message, MavMessage::STATUSTEXT(text) if text.text.starts_with(b"bridge: the companion is silent"))
    });
    assert!(reported);
    bridge.handle_uart(at(2700), &bytes(0, AUTOPILOT, &heartbeat(true, 9)));
    bridge.handle_timeout(at(2701));
    assert!(bridge.is_landing(), "until landed");
    bridge.handle_uart(at(9000), &bytes(0, AUTOPILOT, &heartbeat(false, 9)));
    bridge.handle_timeout(at(9001));
    assert!(!bridge.is_landing());
    assert_eq!(bridge.stats().landings, 1);
}

#[test]
fn measures_the_round_trip_of_clients_and_its_own() {
    let mut bridge = bridge(quiet());
    let sync =
        |tc1: i64, ts1: i64| MavMessage::TIMESYNC(TIMESYNC_DATA { tc1, ts1, ..Default::default() });
    bridge.handle_uart(at(0), &bytes(0, AUTOPILOT, &heartbeat(false, 0)));
    bridge.handle_datagram(at(100), address(2), &bytes(0, RUNTIME, &sync(0, 4242)));
    bridge.handle_uart(at(107), &bytes(0, AUTOPILOT, &sync(9, 4242)));
    assert_eq!(bridge.stats().round_trip_us, 7000);
    // The reply is forwarded to the client.
    assert!(datagrams(&mut bridge, at(108)).iter().any(|(_, b)| decode(b).len() == 1));
    uart(&mut bridge, at(108));
    // Without requests of clients, the bridge sends requests; the reply is forwarded like any packet.
    bridge.handle_timeout(at(5000));
    let outstanding = |bridge: &mut Bridge, now| -> Vec<i64> {
        uart(bridge, now)
            .iter()
            .flat_map(|packet| decode(packet))
            .filter_map(|packet| match packet.message {
                MavMessage::TIMESYNC(sync) => Some(sync.ts1),
                _ => None,
            })
            .collect()
    };
    assert_eq!(outstanding(&mut bridge, at(5000)), [], "no request while the autopilot is silent");
    bridge.handle_uart(at(5500), &bytes(0, AUTOPILOT, &heartbeat(false, 0)));
    bridge.handle_timeout(at(6001));
    let outstanding = outstanding(&mut bridge, at(6001));
    assert_eq!(outstanding.len(), 1);
    datagrams(&mut bridge, at(6010));
    bridge.handle_uart(at(6004), &bytes(0, AUTOPILOT, &sync(9, outstanding[0])));
    assert_eq!(bridge.stats().round_trip_us, 3000);
    assert!(datagrams(&mut bridge, at(6100)).iter().any(|(_, b)| others(b) == 1));
}

mod configuration;
mod ground_station;
mod landing;
mod stations;

proptest! {
    /// For any order of inputs: the outputs are whole packets, and each input packet is sent, waits, or is counted as
    /// dropped.
    #[test]
    fn counts_every_dropped_packet(steps in prop::collection::vec((0..4u8, 0..3u8, 1..60u16), 1..400), poll in 1..20usize) {
        let mut bridge = bridge(quiet());
        bridge.handle_uart(at(0), &bytes(0, AUTOPILOT, &heartbeat(false, 0)));
        bridge.handle_datagram(at(0), address(1), &bytes(0, RUNTIME, &setpoint(0.0)));
        let (mut up_in, mut up_out, mut now) = (1, 0, 0);
        for (step, (what, who, wait)) in steps.into_iter().enumerate() {
            now += u64::from(wait);
            match what {
                0 => bridge.handle_uart(at(now), &bytes(step as u8, AUTOPILOT, &attitude(1.0))),
                1 => {
                    up_in += 1;
                    bridge.handle_datagram(at(now), address(1 + who), &bytes(step as u8, RUNTIME, &setpoint(1.0)));
                }
                2 => {
                    up_in += 1;
                    bridge.handle_datagram(at(now), address(1 + who), &bytes(step as u8, RUNTIME, &param(1)));
                }
                _ => bridge.handle_timeout(at(now)),
            }
            if step % poll == 0 {
                up_out += foreign(uart(&mut bridge, at(now))).len();
                for (_, datagram) in datagrams(&mut bridge, at(now)) {
                    let whole: usize = decode(&datagram).len();
                    prop_assert!(whole > 0 && datagram.len() <= 1400);
                }
            }
        }
        up_out += foreign(uart(&mut bridge, at(now))).len();
        let stats = bridge.stats();
        let dropped = stats.dropped(Reason::UartFull) + stats.dropped(Reason::Superseded);
        prop_assert_eq!(up_in, up_out + dropped as usize);
        prop_assert_eq!(stats.net.cut.dropped_bytes, 0);
    }
}
