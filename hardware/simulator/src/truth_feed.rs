//! Sends the true pose at every tick (400 Hz) as JSON over UDP, for programs that simulate cameras.
//!
//! One object per datagram, in the format of the render server's pose packet. The stamp is the instant of the pose on
//! this computer's CLOCK_MONOTONIC:
//! ```json
//! {"vizflyt_pose":1,"object":"vizflyt","seq":7,"stamp_ns":81250000,"clock":"server",
//!  "position_m":[1.0,2.0,0.1],"rotation_xyzw":[0.0,0.0,0.0,1.0]}
//! ```

use std::net::{SocketAddr, UdpSocket};
use std::time::Instant;

use nix::time::{ClockId, clock_gettime};
use serde_json::{Value, json};
use vizflyt_protocol::geometry::{Body, Pose, World};

use crate::link::bind_udp;

/// Sends true poses to one address.
#[derive(Debug)]
pub struct TruthFeed {
    socket: UdpSocket,
    target: SocketAddr,
    object: String,
    seq: u64,
    /// An instant, and the value of CLOCK_MONOTONIC at it [ns].
    anchor: (Instant, u64),
}

impl TruthFeed {
    /// Opens a socket that sends poses of the vehicle named `object` to `target`.
    ///
    /// # Errors
    /// Fails if no socket can be opened, or the clock cannot be read.
    pub fn open(target: SocketAddr, object: &str) -> std::io::Result<Self> {
        let any = if target.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" };
        let time = clock_gettime(ClockId::CLOCK_MONOTONIC)?;
        let ns = time.tv_sec() as u64 * 1_000_000_000 + time.tv_nsec() as u64;
        Ok(Self {
            socket: bind_udp(any)?,
            target,
            object: object.to_owned(),
            seq: 0,
            anchor: (Instant::now(), ns),
        })
    }

    /// Sends the pose that is true at instant `at`.
    pub fn send(&mut self, at: Instant, world_from_body: &Pose<World, Body>) {
        self.seq += 1;
        let (instant, ns) = self.anchor;
        let since_ns = |a: Instant, b: Instant| a.saturating_duration_since(b).as_nanos() as u64;
        let stamp_ns = (ns + since_ns(at, instant)).saturating_sub(since_ns(instant, at));
        let datagram = packet(&self.object, self.seq, stamp_ns, world_from_body);
        // Without a receiver, the datagram is lost.
        let _ = self.socket.send_to(datagram.to_string().as_bytes(), self.target);
    }
}

fn packet(object: &str, seq: u64, stamp_ns: u64, pose: &Pose<World, Body>) -> Value {
    json!({
        "vizflyt_pose": 1,
        "object": object,
        "seq": seq,
        "stamp_ns": stamp_ns,
        "clock": "server",
        "position_m": pose.translation_m.to_array(),
        "rotation_xyzw": pose.rotation.to_array(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};
    use std::time::Duration;

    #[test]
    fn poses_arrive_with_their_instant() {
        let listener = UdpSocket::bind("127.0.0.1:0").unwrap();
        let mut feed = TruthFeed::open(listener.local_addr().unwrap(), "drone").unwrap();
        let pose = Pose::new(DVec3::new(1.0, -2.0, 0.5), DQuat::from_rotation_z(0.3));
        let start = Instant::now();
        feed.send(start, &pose);
        feed.send(start + Duration::from_micros(2500), &pose);
        let read = || {
            let mut bytes = [0; 2048];
            let length = listener.recv(&mut bytes).unwrap();
            serde_json::from_slice::<Value>(&bytes[..length]).unwrap()
        };
        let (first, second) = (read(), read());
        let stamp = |packet: &Value| packet["stamp_ns"].as_u64().unwrap();
        assert_eq!(stamp(&second) - stamp(&first), 2_500_000);
        assert_eq!((&second["seq"], &second["object"]), (&json!(2), &json!("drone")));
        assert_eq!(second["position_m"], json!([1.0, -2.0, 0.5]));
        assert_eq!(second["rotation_xyzw"], json!(pose.rotation.to_array()));
    }
}
