//! Byte stream of a VRPN server in chunks of any size: poses with finite values, or the connection is closed. The
//! buffer is limited to one message and the newest data.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::time::ServerTime;
use vizflyt_server::poses::drivers::vrpn::{COOKIE, VrpnStream};
use vizflyt_server::poses::settings::LocalizationConfig;

// Beginning of the stream, size of its chunks, and the stream.
fuzz_target!(|input: (u8, u8, &[u8])| {
    let (begins, cut, bytes) = input;
    let (is_greeted, is_described) = (begins & 1 != 0, begins & 2 != 0);
    let config = LocalizationConfig::parse("vrpn,up=y,objects.wasp=ant").unwrap();
    let mut source = VrpnStream::new(&config, 0, &["vizflyt", "wasp"]);
    let start = ServerTime::from_ns(1_000_000_000);
    source.begin_connection();
    if is_greeted {
        source.handle_bytes(start, COOKIE);
    }
    if is_greeted && is_described {
        // The sender 1 is "ant", the type 4 a tracker's report.
        for (number, kind, name) in [(1i32, -1i32, &b"ant"[..]), (4, -2, b"vrpn_Tracker Pos_Quat")]
        {
            let length = 24 + 4 + name.len() + 1;
            let mut message = vec![0; length.next_multiple_of(8)];
            message[..4].copy_from_slice(&(length as u32).to_be_bytes());
            message[12..16].copy_from_slice(&number.to_be_bytes());
            message[16..20].copy_from_slice(&kind.to_be_bytes());
            message[24..28].copy_from_slice(&(name.len() as u32 + 1).to_be_bytes());
            message[28..28 + name.len()].copy_from_slice(name);
            source.handle_bytes(start, &message);
        }
    }
    for (index, part) in bytes.chunks(1 + usize::from(cut) * 16).enumerate() {
        let now = start.plus_ns(index as i64 * 5_000_000);
        source.handle_bytes(now, part);
        loop {
            match source.read() {
                Ok(true) => {}
                Ok(false) => break,
                Err(_) => return,
            }
            assert!(source.measured().len() <= 2);
            for measurement in source.measured() {
                assert!(measurement.world_from_body.is_valid() && measurement.stamp <= now);
            }
        }
        assert!(source.unread_bytes() <= 1 << 16);
        while source.next_warning().is_some() {}
        let _ = source.described();
    }
});
