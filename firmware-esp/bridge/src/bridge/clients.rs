//! Network clients: addresses, their MAVLink systems, and read positions.

use core::net::SocketAddrV4;

use vizflyt_protocol::time::HostTime;

use crate::packet::Raw;
use crate::settings::Settings;
use crate::stats::Sequences;

/// Maximum number of clients.
pub const CLIENTS: usize = 8;

/// A connection that accepts no data for this long is closed: longer than a Wi-Fi reconnect, shorter than TCP's own
/// timeout [s].
const STALLED_S: f64 = 5.0;

/// Address of a client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Peer {
    Udp(SocketAddrV4),
    /// Slot of a TCP connection.
    Tcp(u8),
}

#[derive(Clone, Debug)]
pub(crate) struct Client {
    pub peer: Peer,
    /// From the settings: never removed for silence.
    pub fixed: bool,
    pub received_at: HostTime,
    pub has_spoken: bool,
    /// Systems and components that sent packets from this address.
    pub systems: heapless::Vec<(u8, u8), 4>,
    pub sequences: Sequences<3>,
    /// Sequence number of the bridge's own packets to this client.
    pub sequence: u8,
    /// Position in the ring of the next packet to check.
    pub cursor: u32,
    /// Bytes in the ring for this client.
    pub pending: u32,
    /// Arrival time of the oldest pending packet.
    pub since: HostTime,
    /// Time at which the client last accepted data, or had none pending.
    pub taken_at: HostTime,
    /// Whether a pending packet must be sent at once.
    pub hurry: bool,
    pub sent: u32,
    /// Packets dropped because the client was too slow.
    pub slow: u32,
}

impl Client {
    pub(crate) fn new(peer: Peer, fixed: bool, now: HostTime, cursor: u32) -> Self {
        Self {
            peer,
            fixed,
            received_at: now,
            has_spoken: false,
            systems: heapless::Vec::new(),
            sequences: Sequences::new(),
            sequence: 0,
            cursor,
            pending: 0,
            since: now,
            taken_at: now,
            hurry: false,
            sent: 0,
            slow: 0,
        }
    }

    /// Records that the client sent something.
    pub(crate) fn note_heard(&mut self, now: HostTime) {
        self.received_at = now;
        self.has_spoken = true;
    }

    /// Records a packet of the client. Returns the number of packets lost before it.
    pub(crate) fn note(&mut self, now: HostTime, packet: Raw<'_>) -> u32 {
        self.note_heard(now);
        let source = packet.source();
        if !self.systems.contains(&source) {
            if self.systems.is_full() {
                self.systems.remove(0);
            }
            // The removal above made room.
            let _ = self.systems.push(source);
        }
        self.sequences.note(source, packet.sequence())
    }

    /// Whether the client holds a system and component; component 0 matches any.
    pub(crate) fn holds(&self, target: (u8, u8)) -> bool {
        self.systems.iter().any(|&(system, component)| {
            system == target.0 && (target.1 == 0 || component == target.1)
        })
    }

    /// Whether pending data was not accepted for too long. Only a connection can stall; a datagram is gone once sent.
    pub(crate) fn is_stalled(&self, now: HostTime) -> bool {
        matches!(self.peer, Peer::Tcp(_))
            && self.pending > 0
            && now.seconds_since(self.taken_at) > STALLED_S
    }

    pub(crate) fn is_udp(&self) -> bool {
        matches!(self.peer, Peer::Udp(_))
    }

    /// Whether the client was active recently. Only the fixed client may stay without activity.
    pub(crate) fn speaks(&self, now: HostTime, settings: &Settings) -> bool {
        self.has_spoken && !self.is_silent(now, settings)
    }

    /// Whether the client's silence exceeds the timeout.
    pub(crate) fn is_gone(&self, now: HostTime, settings: &Settings) -> bool {
        self.is_udp() && !self.fixed && self.is_silent(now, settings)
    }

    fn is_silent(&self, now: HostTime, settings: &Settings) -> bool {
        now.seconds_since(self.received_at) > f64::from(settings.client_timeout_s)
    }
}

/// Returns the bit of a client in [`Tag::to`](crate::ring::Tag::to).
pub(crate) fn bit(index: usize) -> u8 {
    1 << index
}
