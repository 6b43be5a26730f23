//! Statistics of a runtime's QUIC connection.

use serde::{Deserialize, Serialize};
use vizflyt_protocol::time::ServerTime;

use crate::clock;

/// Statistics of a runtime's connection since its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Connection {
    /// Smoothed round-trip time. [ms]
    pub rtt_ms: f64,
    /// Congestion window: maximum of unacknowledged bytes. [bytes]
    pub window: u64,
    /// Largest packet. [bytes]
    pub mtu: u16,
    /// Packets sent.
    pub packets_sent: u64,
    /// Packets lost; their contents were sent again.
    pub packets_lost: u64,
    /// Congestion events that the controller received.
    pub congestion_events: u64,
    /// Bytes sent on the network, including headers and retransmissions. [bytes]
    pub bytes_sent: u64,
    /// Duration of the connection. [s]
    pub seconds: f64,
    /// Mean rate sent since the start. [Mbit/s]
    pub mbit_s: f64,
}

impl Connection {
    /// Returns the statistics of a connection that began at `since`.
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
