//! Other services of the bridge: DHCP, mDNS, and offered firmware. Its page has a separate target.
#![no_main]
use std::net::Ipv4Addr;

use libfuzzer_sys::fuzz_target;
use vizflyt_bridge::update::{Fault, HEADER, Header};
use vizflyt_bridge::{dhcp, mdns};

fuzz_target!(|datagrams: Vec<&[u8]>| {
    let own = Ipv4Addr::new(192, 168, 4, 1);
    let mut leases = dhcp::Leases::new();
    for bytes in datagrams {
        if let Some(len) = leases.answer(own, bytes, &mut [0; dhcp::ANSWER]) {
            assert!(len <= dhcp::ANSWER && bytes.len() > 236, "a request has a header at least");
        }
        if let Some(len) = mdns::answer(bytes, "vizflyt", own, &mut [0; mdns::ANSWER]) {
            assert!(len <= mdns::ANSWER);
        }
        if let Some(head) = bytes.first_chunk::<HEADER>() {
            // A random signature is never valid.
            let opened = Header::open(head, &[9; 32]);
            assert!(matches!(opened, Err(Fault::NoFirmware | Fault::Signature)));
        }
    }
});
