//! What a bridge answers besides MAVLink: requests for an address, for its name, for its page; and
//! firmware that is offered to it.
#![no_main]
use std::net::Ipv4Addr;

use libfuzzer_sys::fuzz_target;
use vizflyt_bridge::update::{Fault, HEADER, Header};
use vizflyt_bridge::{Bridge, Chip, Settings, dhcp, mdns, page};
use vizflyt_protocol::time::HostTime;

fuzz_target!(|datagrams: Vec<&[u8]>| {
    let own = Ipv4Addr::new(192, 168, 4, 1);
    let bridge = Bridge::new(HostTime::ZERO, Settings::default(), Chip::default());
    let mut leases = dhcp::Leases::new();
    for bytes in datagrams {
        if let Some(len) = leases.answer(own, bytes, &mut [0; dhcp::ANSWER]) {
            assert!(len <= dhcp::ANSWER && bytes.len() > 236, "a request has a header at least");
        }
        if let Some(len) = mdns::answer(bytes, "vizflyt", own, &mut [0; mdns::ANSWER]) {
            assert!(len <= mdns::ANSWER);
        }
        let response = page::respond(&bridge, HostTime::ZERO, bytes);
        assert!(response.starts_with("HTTP/1.0 200") || response.starts_with("HTTP/1.0 404"));
        if let Some(head) = bytes.first_chunk::<HEADER>() {
            // Nobody signs by chance.
            let opened = Header::open(head, &[9; 32]);
            assert!(matches!(opened, Err(Fault::NoFirmware | Fault::Signature)));
        }
    }
});
