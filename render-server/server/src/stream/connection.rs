//! The state of a runtime's QUIC connection, as figures.

use serde::{Deserialize, Serialize};
use vizflyt_protocol::time::ServerTime;

use crate::clock;

/// How a runtime's connection fares, from its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Connection {
    /// Round trip, smoothed. [ms]
    pub rtt_ms: f64,
    /// Bytes that may be unacknowledged. [bytes]
    pub window: u64,
    /// Largest packet. [bytes]
    pub mtu: u16,
    /// Packets sent.
    pub packets_sent: u64,
    /// Packets lost on the way; what they held was sent again.
    pub packets_lost: u64,
    /// Congestion events that the controller received.
    pub congestion_events: u64,
    /// Bytes sent on the network, everything included. [bytes]
    pub bytes_sent: u64,
    /// How long it has lasted. [s]
    pub seconds: f64,
    /// Sent on average since it began. [Mbit/s]
    pub mbit_s: f64,
}

impl Connection {
    /// Returns how a connection that began at `since` fares.
    pub fn of(connection: &quinn::Connection, since: ServerTime) -> Self {
        let stats = connection.stats();
        let seconds = clock::now().seconds_since(since);
        let bytes_sent = stats.udp_tx.bytes;
        Self {
            rtt_ms: stats.path.rtt.as_secs_f64() * 1e3,
            window: stats.path.cwnd,
            mtu: stats.path.current_mtu,
            packets_sent: stats.path.sent_packets,
            packets_lost: stats.path.lost_packets,
            congestion_events: stats.path.congestion_events,
            bytes_sent,
            seconds,
            mbit_s: bytes_sent as f64 * 8e-6 / seconds.max(1e-3),
        }
    }
}
