//! Pose feed: sealed datagrams to the guardian of each flight. It continues after the runtime's connection has
//! ended, while the guardian renews its subscription.

use std::net::SocketAddr;
use std::time::Duration;

use tokio::net::UdpSocket;
use tokio::time::{MissedTickBehavior, interval};
use tracing::debug;
use vizflyt_protocol::packet::feed::{FEED_LABEL, FeedKey, FeedMessage, MAX_FEED, open, seal};
use vizflyt_protocol::time::ServerTime;

use crate::clock;
use crate::stream::Rooms;
use crate::stream::vehicle::VehicleStream;

/// Interval of checks for a new pose.
const TICK: Duration = Duration::from_millis(5);
/// Minimum time between poses: at most 50 per second, with a margin for the jitter of a source. [s]
const POSE_EVERY_S: f64 = 0.018;
/// Validity of a subscription. [s]
const KEPT_S: f64 = 2.0;

/// Guardian that subscribes to one vehicle.
#[derive(Clone, Copy, Debug)]
struct Subscriber {
    address: SocketAddr,
    /// Newest sequence number: a lower or equal number is a replay.
    number: u64,
    until: ServerTime,
    /// Stamp of the newest pose sent.
    sent: ServerTime,
}

/// Returns the key of a flight's feed, which both ends derive from the secrets of their connection.
pub(super) fn key_of(connection: &quinn::Connection) -> Option<FeedKey> {
    let mut key = FeedKey::default();
    connection.export_keying_material(&mut key, FEED_LABEL, b"").ok()?;
    Some(key)
}

/// Opens the socket on the port after QUIC's, so that a firewall rule can name it, or else on any port.
pub(super) async fn bind(quic: SocketAddr) -> std::io::Result<UdpSocket> {
    let next = SocketAddr::new(quic.ip(), quic.port().wrapping_add(1));
    match UdpSocket::bind(next).await {
        Ok(socket) => Ok(socket),
        Err(_) => UdpSocket::bind(SocketAddr::new(quic.ip(), 0)).await,
    }
}

/// Sends poses until it is dropped.
pub(super) async fn serve(rooms: &Rooms, socket: UdpSocket) {
    let mut subscribers = vec![None::<Subscriber>; rooms.streaming.vehicles.len()];
    let mut ticks = interval(TICK);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut received, mut buffer) = ([0; MAX_FEED], [0; MAX_FEED]);
    loop {
        tokio::select! {
            datagram = socket.recv_from(&mut received) => {
                // The error belongs to an earlier datagram whose destination port was closed.
                let Ok((len, address)) = datagram else { continue };
                let keys = rooms.streaming.vehicles.iter().map(VehicleStream::feed_key);
                subscribe(clock::now(), keys, &mut subscribers, address, &received[..len]);
                continue;
            }
            _ = ticks.tick(), if subscribers.iter().any(Option::is_some) => {}
        }
        let now = clock::now();
        for (index, subscriber) in subscribers.iter_mut().enumerate() {
            let stream = &rooms.streaming.vehicles[index];
            let (Some(known), Some(key)) = (subscriber.as_mut(), stream.feed_key()) else {
                continue;
            };
            if now >= known.until {
                *subscriber = None;
                continue;
            }
            let newest = rooms.localization.vehicles[index].sample();
            if let Some(pose) = newest
                && pose.stamp.seconds_since(known.sent) >= POSE_EVERY_S
            {
                known.sent = pose.stamp;
                let bytes = seal(&key, &FeedMessage::Pose(pose), &mut buffer);
                let _ = socket.try_send_to(bytes, known.address);
            }
        }
    }
}

/// Processes a datagram. Datagrams that were not sealed with a flight's key are ignored.
fn subscribe(
    now: ServerTime,
    keys: impl Iterator<Item = Option<FeedKey>>,
    subscribers: &mut [Option<Subscriber>],
    address: SocketAddr,
    datagram: &[u8],
) {
    for (key, subscriber) in keys.zip(subscribers) {
        let Some(key) = key else { continue };
        let Some(FeedMessage::Subscribe(number)) = open(&key, datagram) else { continue };
        if subscriber.is_some_and(|known| number <= known.number) {
            return debug!("{address}: a subscription to poses is a replay");
        }
        let sent = subscriber.map_or(ServerTime::ZERO, |known| known.sent);
        let until = now.plus_seconds(KEPT_S);
        *subscriber = Some(Subscriber { address, number, until, sent });
        return;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accepts_only_the_flights_guardian_and_rejects_replays() {
        let (ours, theirs) = (SocketAddr::from(([10, 0, 0, 2], 1)), ([10, 0, 0, 9], 1).into());
        let keys = [None, Some([1; 32]), Some([2; 32])];
        let mut subscribers = [None; 3];
        let (now, mut buffer) = (ServerTime::from_ns(1_000_000_000), [0; MAX_FEED]);
        let mut take = |address, key: FeedKey, number| {
            let datagram = seal(&key, &FeedMessage::Subscribe(number), &mut buffer);
            subscribe(now, keys.into_iter(), &mut subscribers, address, datagram);
            subscribers.map(|known| known.map(|known| (known.address, known.number)))
        };
        assert_eq!(take(theirs, [9; 32], 5), [None; 3], "nobody's key");
        assert_eq!(take(ours, [2; 32], 5), [None, None, Some((ours, 5))]);
        assert_eq!(take(theirs, [2; 32], 5), [None, None, Some((ours, 5))], "recorded, sent again");
        assert_eq!(take(theirs, [2; 32], 4), [None, None, Some((ours, 5))], "an older one");
        // The guardian's own next subscription, from a new port.
        let moved = SocketAddr::from(([10, 0, 0, 2], 7));
        assert_eq!(take(moved, [2; 32], 6), [None, None, Some((moved, 6))]);
    }
}
