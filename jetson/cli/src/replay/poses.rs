//! Sends the poses of a recorded flight.

use std::io::Read;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use serde_json::json;
use vizflyt_runtime::log::read::{RecordedPose, RecordedPoses};

/// Sends the poses of a log at the pace of the flight; returns their number.
pub(super) fn send<R: Read>(
    mut poses: RecordedPoses<R>,
    to: SocketAddr,
    object: &str,
) -> Result<u64> {
    let any: SocketAddr = match to {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any).context("cannot open a socket for the poses")?;
    let start = Instant::now();
    let mut first_ns = None;
    let mut seq = 0u64;
    while let Some(RecordedPose { at_ns, world_from_body: pose }) = poses.next()? {
        let since_ns = at_ns.saturating_sub(*first_ns.get_or_insert(at_ns));
        let due = start + Duration::from_nanos(since_ns);
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        seq += 1;
        let packet = json!({
            "vizflyt_pose": 1,
            "object": object,
            "seq": seq,
            "stamp_ns": at_ns,
            "position_m": pose.translation_m.to_array(),
            "rotation_xyzw": pose.rotation.to_array(),
        });
        // An error means that no receiver listens yet: continue.
        let _ = socket.send_to(packet.to_string().as_bytes(), to);
    }
    if seq == 0 {
        bail!("the log contains no pose; give the log of a flight with localization");
    }
    Ok(seq)
}
