//! DHCP requests and mDNS queries to a bridge: no panic; responses have a valid length and only the bridge's own name.
#![no_main]
use std::net::Ipv4Addr;

use libfuzzer_sys::fuzz_target;
use vizflyt_bridge::{dhcp, mdns};

const US: Ipv4Addr = Ipv4Addr::new(192, 168, 4, 1);

fuzz_target!(|packets: Vec<&[u8]>| {
    let mut leases = dhcp::Leases::new();
    for packet in packets {
        let mut answer = [0; dhcp::ANSWER];
        if let Some(len) = leases.answer(US, packet, &mut answer) {
            assert!(len <= dhcp::ANSWER && answer[len - 1] == 255);
            let given = answer[19];
            assert!(given == 0 || (2..2 + dhcp::LEASES as u8).contains(&given));
        }
        let mut answer = [0; mdns::ANSWER];
        if let Some(len) = mdns::answer(packet, "drone-3", US, &mut answer) {
            assert_eq!(&answer[12..20], b"\x07drone-3");
            assert_eq!(&answer[len - 4..len], &US.octets());
        }
    }
});
