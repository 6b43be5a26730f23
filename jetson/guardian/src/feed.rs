//! Pose subscription of the guardian, over UDP: poses continue if the runtime has ended.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use vizflyt_protocol::messages::PoseSample;
use vizflyt_protocol::packet::feed::{FeedMessage, MAX_FEED, open, seal};
use vizflyt_protocol::time::{HostTime, ServerTime};

use crate::channel::Feed;

/// Interval at which the subscription is renewed. [s]
const RENEW_S: f64 = 0.5;
/// Maximum wait for a pose.
const WAIT: Duration = Duration::from_millis(100);

/// Subscription to the poses of a `source`, which the runtime updates while it runs.
pub(crate) struct Subscription {
    socket: UdpSocket,
    renew_at: HostTime,
    newest: ServerTime,
    current: Option<Feed>,
}

impl Subscription {
    pub(crate) fn new(source: &Mutex<Option<Feed>>) -> io::Result<Option<Self>> {
        let Some(feed) = *source.lock().unwrap_or_else(PoisonError::into_inner) else {
            return Ok(None);
        };
        let socket = bind(feed.server)?;
        Ok(Some(Self { socket, renew_at: HostTime::ZERO, newest: ServerTime::ZERO, current: None }))
    }

    /// Waits at most 100 ms for a pose. Returns it with the time of its measurement on this computer's clock.
    pub(crate) fn receive(
        &mut self,
        clock: impl Fn() -> HostTime,
        source: &Mutex<Option<Feed>>,
    ) -> Option<(PoseSample, HostTime)> {
        let feed = (*source.lock().unwrap_or_else(PoisonError::into_inner))?;
        if self.current.is_none_or(|known| known.key != feed.key) {
            // A new key means a new connection, perhaps to a restarted server, whose clock starts at zero.
            (self.newest, self.renew_at) = (ServerTime::ZERO, HostTime::ZERO);
            // The new server may be reached over the other version of IP.
            if self.socket.local_addr().ok()?.is_ipv4() != feed.server.is_ipv4() {
                let Ok(socket) = bind(feed.server) else {
                    thread::sleep(WAIT);
                    return None;
                };
                self.socket = socket;
            }
        }
        self.current = Some(feed);
        let (now, mut buffer) = (clock(), [0; MAX_FEED]);
        if now >= self.renew_at {
            self.renew_at = now.plus_seconds(RENEW_S);
            let subscribe = seal(&feed.key, &FeedMessage::Subscribe(now.as_ns()), &mut buffer);
            let _ = self.socket.send_to(subscribe, feed.server);
        }
        let (len, from) = self.socket.recv_from(&mut buffer).ok()?;
        if from != feed.server {
            return None;
        }
        let Some(FeedMessage::Pose(sample)) = open(&feed.key, &buffer[..len]) else { return None };
        if sample.stamp <= self.newest {
            return None;
        }
        self.newest = sample.stamp;
        let stamp_ns = sample.stamp.as_ns().cast_signed().saturating_sub(feed.server_ahead_ns);
        Some((sample, HostTime::from_ns(stamp_ns.max(0).cast_unsigned())))
    }
}

/// Opens a socket that reaches `server`.
fn bind(server: SocketAddr) -> io::Result<UdpSocket> {
    let any: SocketAddr = match server {
        SocketAddr::V4(_) => ([0, 0, 0, 0], 0).into(),
        SocketAddr::V6(_) => ([0_u16; 8], 0).into(),
    };
    let socket = UdpSocket::bind(any)?;
    socket.set_read_timeout(Some(WAIT))?;
    Ok(socket)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The server is reached over IPv4, then over IPv6, then over IPv4 again.
    #[test]
    fn follows_the_server_to_the_other_version_of_ip() {
        let source = Mutex::new(None);
        let mut subscription = None;
        for (number, address) in ["127.0.0.1:0", "[::1]:0", "127.0.0.1:0"].iter().enumerate() {
            let server = UdpSocket::bind(address).unwrap();
            let key = [number as u8; 32];
            let feed = Feed { server: server.local_addr().unwrap(), key, server_ahead_ns: 0 };
            *source.lock().unwrap() = Some(feed);
            let open = subscription
                .get_or_insert_with(|| Subscription::new(&source).unwrap().expect("a source"));
            let now = || HostTime::from_ns(1_000_000_000 * (1 + number as u64));
            let _ = open.receive(now, &source);
            server.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
            let mut buffer = [0; MAX_FEED];
            let len = server.recv(&mut buffer).unwrap();
            let message = vizflyt_protocol::packet::feed::open(&key, &buffer[..len]);
            assert_eq!(message, Some(FeedMessage::Subscribe(now().as_ns())), "{address}");
        }
    }
}
