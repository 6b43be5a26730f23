//! Serial side of the bridge: any bytes in any portions at any time, while a client is connected. The output consists
//! of complete packets from the input, and each loss is counted.
#![no_main]
use std::net::{Ipv4Addr, SocketAddrV4};

use libfuzzer_sys::fuzz_target;
use vizflyt_bridge::packet::{CutStats, each_in_datagram};
use vizflyt_bridge::{Bridge, Chip, Settings};
use vizflyt_protocol::time::HostTime;

fuzz_target!(|portions: Vec<(u8, &[u8])>| {
    let client = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 14550);
    let settings = Settings { client: Some(client), ..Settings::default() };
    let mut bridge = Bridge::new(HostTime::ZERO, settings, Chip::default());
    let (mut now, mut total, mut foreign) = (HostTime::ZERO, 0, 0);
    for (pause_ms, bytes) in portions {
        now = now.plus_ns(i64::from(pause_ms) * 1_000_000);
        bridge.handle_uart(now, bytes);
        bridge.handle_timeout(now);
        total += bytes.len();
        let mut out = [0; 1472];
        while let Some((to, len)) = bridge.poll_udp(now, &mut out) {
            assert_eq!(to, client);
            assert!(len <= 1400);
            let mut cut = CutStats::default();
            each_in_datagram(&out[..len], &mut cut, |packet| {
                // Packets of other components came from the line.
                foreign += u32::from(packet.source().1 != 240);
            });
            assert!(cut.packets > 0 && cut.dropped_bytes == 0);
        }
        let mut packet = [0; 280];
        while bridge.poll_uart(now, &mut packet) > 0 {}
        assert!(bridge.poll_timeout() > now, "it must not ask to be woken in the past");
        while bridge.poll_event().is_some() {}
    }
    let uart = &bridge.stats().uart;
    assert!(uart.cut.dropped_bytes as usize + 8 * uart.cut.packets as usize <= total);
    assert!(foreign <= uart.cut.packets);
});
