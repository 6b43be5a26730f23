//! Signing: rejects unsigned, forged and replayed packets.

use vizflyt_protocol::mavlink::{Signer, SigningFault, SigningKey, SigningTime, Verifier};

use super::*;

const START: SigningTime = SigningTime::from_units(3_700_000_000_000);

fn key() -> SigningKey {
    SigningKey::new([42; 32])
}

fn link(now: HostTime) -> Link {
    let signing = Some(LinkSigning { key: key(), start: START, accepts_unsigned: false });
    Link::with(now, LinkSettings { signing, ..LinkSettings::default() })
}

/// Returns a heartbeat of the autopilot, signed if there is a signer.
fn beat(signer: Option<&mut Signer>, at: SigningTime) -> Vec<u8> {
    let header = MavHeader { system_id: 1, component_id: 1, sequence: 0 };
    let heartbeat = HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode: MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED,
        ..Default::default()
    };
    let mut bytes = [0; MAX_PACKET];
    let mut len = encode(header, &MavMessage::HEARTBEAT(heartbeat), &mut bytes).len();
    if let Some(signer) = signer {
        len = signer.sign(at, &mut bytes, len);
    }
    bytes[..len].to_vec()
}

#[test]
fn accepts_only_signed_packets_with_new_stamps() {
    let now = HostTime::from_ns(5_000_000_000);
    let mut link = link(now);
    link.handle_input(now, &beat(None, START));
    assert!(!link.is_connected());
    link.handle_timeout(now);
    assert!(link.ready_to_arm(now).unwrap_err().contains("not signed with our key"));
    let mut other = Signer::new(SigningKey::new([1; 32]), 0);
    link.handle_input(now, &beat(Some(&mut other), START));
    assert!(!link.is_connected());
    let mut signer = Signer::new(key(), 0);
    let good = beat(Some(&mut signer), START);
    link.handle_input(now, &good);
    assert!(link.is_connected() && link.state().armed);
    assert_eq!(link.refused().0, 2);
    // A replayed packet does not keep the connection alive.
    let later = now.plus_seconds(4.0);
    link.handle_input(later, &good);
    link.handle_timeout(later);
    assert!(!link.is_connected());
    let faults: Vec<_> =
        std::iter::from_fn(|| link.poll_event()).filter_map(|event| event.warning()).collect();
    assert!(faults.iter().any(|text| text.contains("a replay")), "{faults:?}");
}

/// A recorded flight of two minutes, replayed to a runtime that has restarted.
#[test]
fn a_restarted_runtime_refuses_an_old_recording() {
    let (now, mut signer) = (HostTime::from_ns(5_000_000_000), Signer::new(key(), 0));
    let at = |second: u64| START.plus_us(second * 1_000_000);
    let recorded: Vec<_> = (0..120).map(|second| beat(Some(&mut signer), at(second))).collect();
    let restarted = || {
        let signing = Some(LinkSigning { key: key(), start: at(120), accepts_unsigned: false });
        Link::with(now, LinkSettings { signing, ..LinkSettings::default() })
    };
    let replay = |link: &mut Link, packets: &[Vec<u8>]| {
        let before = link.refused().0;
        for packet in packets {
            link.handle_input(now, packet);
        }
        packets.len() as u64 - (link.refused().0 - before)
    };
    let mut link = restarted();
    assert_eq!(replay(&mut link, &recorded[..60]), 0);
    assert!(!link.is_connected());
    // The last minute passes only before the first packet of the true autopilot.
    assert_eq!(replay(&mut restarted(), &recorded), 60);
    link.handle_input(now, &beat(Some(&mut signer), at(120)));
    assert!(link.is_connected());
    assert_eq!(replay(&mut link, &recorded), 0);
}

#[test]
fn reports_refused_packets_at_growing_intervals() {
    let mut now = HostTime::from_ns(5_000_000_000);
    let mut link = link(now);
    let mut reports = Vec::new();
    for second in 0..100 {
        now = now.plus_seconds(1.0);
        link.handle_input(now, &beat(None, START));
        link.handle_timeout(now);
        while let Some(event) = link.poll_event() {
            if let LinkEvent::NotSigned { fault, count } = event {
                assert_eq!((fault, count), (SigningFault::Unsigned, second + 1));
                reports.push(second);
            }
        }
    }
    assert_eq!(reports, [0, 10, 30, 70]);
    // Another fault is reported at once, and nothing is repeated after the fault ends.
    let mut other = Signer::new(SigningKey::new([1; 32]), 0);
    link.handle_input(now, &beat(Some(&mut other), START));
    for _ in 0..100 {
        now = now.plus_seconds(1.0);
        link.handle_timeout(now);
    }
    let texts: Vec<_> =
        std::iter::from_fn(|| link.poll_event()).filter_map(|event| event.warning()).collect();
    let [forged, unsigned] = &texts[..] else { panic!("{texts:?}") };
    assert!(forged.contains("(1 so far)") && forged.contains("another key"), "{forged}");
    assert!(unsigned.contains("(100 so far)") && unsigned.contains("not signed"), "{unsigned}");
}

#[test]
fn names_an_autopilot_that_signs_to_a_runtime_that_does_not() {
    let now = HostTime::from_ns(5_000_000_000);
    let mut link = Link::new(now);
    let mut signer = Signer::new(key(), 0);
    link.handle_input(now, &beat(Some(&mut signer), START));
    assert!(link.is_connected(), "without a key, signatures are not checked");
    let waits_for = link.ready_to_arm(now).unwrap_err();
    assert!(waits_for.contains("not confirmed its origin"), "{waits_for}");
    assert!(waits_for.contains("it signs its packets and we do not"), "{waits_for}");
    assert!(waits_for.len() < 165, "fits into an event: {waits_for}");
    // Signing was disabled over USB.
    link.handle_input(now, &beat(None, START));
    let waits_for = link.ready_to_arm(now).unwrap_err();
    assert!(!waits_for.contains("signs"), "{waits_for}");
}

#[test]
fn signs_every_packet() {
    let now = HostTime::from_ns(5_000_000_000);
    let mut link = link(now);
    let mut signer = Signer::new(key(), 0);
    link.handle_input(now, &beat(Some(&mut signer), START));
    link.handle_timeout(now);
    let mut verifier = Verifier::new(key());
    let mut packets = 0;
    while let Some(datagram) = link.poll_transmit() {
        assert_eq!(verifier.check(START, &datagram), Ok(()));
        packets += 1;
    }
    assert!(packets > 3, "{packets}");
}

#[test]
fn accepts_unsigned_packets_over_a_trusted_wire() {
    let now = HostTime::from_ns(5_000_000_000);
    let signing = Some(LinkSigning { key: key(), start: START, accepts_unsigned: true });
    let mut link = Link::with(now, LinkSettings { signing, ..LinkSettings::default() });
    link.handle_input(now, &beat(None, START));
    assert!(link.is_connected());
}

#[test]
fn sends_the_key_to_the_autopilot() {
    let mut script = Script::new();
    let signing = LinkSigning { key: key(), start: START, accepts_unsigned: false };
    assert!(!script.link.setup_signing(script.now, Some(&signing)), "without an autopilot");
    script.heartbeat();
    assert!(script.link.setup_signing(script.now, Some(&signing)));
    script.drain();
    let set = |m: &MavMessage| {
        matches!(m, MavMessage::SETUP_SIGNING(m)
            if m.secret_key == [42; 32] && m.initial_timestamp == START.units() && m.target_system == 1)
    };
    assert_eq!(script.count(set), 2);
}
