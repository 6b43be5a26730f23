//! Signing: a key set over USB, and the packets accepted afterwards.

use super::*;
use vizflyt_protocol::mavlink::dialect::SETUP_SIGNING_DATA;
use vizflyt_protocol::mavlink::{
    MAX_PACKET, MavHeader, Signer, SigningKey, SigningTime, Verifier, encode,
};

const START: SigningTime = SigningTime::from_units(5_000_000_000);
const TELEMETRY: usize = 1;

fn setup_signing(c: &mut Companion, secret_key: [u8; 32], initial_timestamp: u64) {
    c.send(&MavMessage::SETUP_SIGNING(SETUP_SIGNING_DATA {
        target_system: 1,
        target_component: 1,
        secret_key,
        initial_timestamp,
    }));
}

/// Sends a change of mode over a link. Returns whether it was accepted.
fn is_accepted(
    c: &mut Companion,
    link: usize,
    mode: CopterMode,
    signer: Option<&mut Signer>,
) -> bool {
    let message = MavMessage::SET_MODE(SET_MODE_DATA {
        custom_mode: mode as u32,
        target_system: 1,
        ..Default::default()
    });
    let header = MavHeader { system_id: 255, component_id: 190, sequence: 0 };
    let mut buffer = [0; MAX_PACKET];
    let mut len = encode(header, &message, &mut buffer).len();
    if let Some(signer) = signer {
        len = signer.sign(START.plus_us(c.lab.now().as_ns() / 1000), &mut buffer, len);
    }
    c.lab.handle_mavlink(link, &buffer[..len]);
    c.lab.tick();
    c.mode() == mode
}

#[test]
fn with_a_key_accepts_only_its_owner_also_after_a_reboot() {
    let mut c = Companion::new(SimulationConfig::default());
    let key = SigningKey::new([7; 32]);
    assert!(
        is_accepted(&mut c, TELEMETRY, CopterMode::AltHold, None),
        "without a key, everything is accepted"
    );
    setup_signing(&mut c, [7; 32], START.units());
    assert!(!is_accepted(&mut c, TELEMETRY, CopterMode::Stabilize, None), "unsigned");
    let mut other = Signer::new(SigningKey::new([8; 32]), 0);
    assert!(
        !is_accepted(&mut c, TELEMETRY, CopterMode::Stabilize, Some(&mut other)),
        "another key"
    );
    let mut owner = Signer::new(key.clone(), 0);
    assert!(is_accepted(&mut c, TELEMETRY, CopterMode::Stabilize, Some(&mut owner)));
    assert!(is_accepted(&mut c, 0, CopterMode::AltHold, None), "USB is trusted");
    assert_eq!(c.lab.report().mavlink_packets_refused, 2);

    // Sent packets are signed, with time stamps that continue after a reboot.
    let mut judge = Verifier::new(key);
    let mut received = |c: &mut Companion| {
        let mut buffer = [0; MAX_PACKET];
        let mut count = 0;
        for _ in 0..800 {
            c.lab.tick();
            while let Some(packet) = c.lab.poll_mavlink(&mut buffer) {
                judge.check(START, packet).unwrap();
                count += 1;
            }
        }
        count
    };
    assert!(received(&mut c) > 10);
    c.lab.reboot();
    for _ in 0..4000 {
        c.lab.tick();
    }
    assert!(received(&mut c) > 10);
    assert!(!is_accepted(&mut c, TELEMETRY, CopterMode::Guided, None), "the key is stored");

    setup_signing(&mut c, [0; 32], 0);
    assert!(
        is_accepted(&mut c, TELEMETRY, CopterMode::AltHold, None),
        "a key of zeros ends signing"
    );
}
