//! Who listens on the network: where, behind which systems' numbers, and how far each has read.

use core::net::SocketAddrV4;

use vizflyt_protocol::time::HostTime;

use crate::packet::Raw;
use crate::settings::Settings;
use crate::stats::Sequences;

/// Clients at once.
pub const CLIENTS: usize = 8;

/// A connection that takes nothing for this long is ended: longer than Wi-Fi takes to come back, shorter
/// than TCP takes to notice. [s]
const STALLED_S: f64 = 5.0;

/// Where a client is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Peer {
    /// A UDP address.
    Udp(SocketAddrV4),
    /// A TCP connection, by its slot.
    Tcp(u8),
}

/// A client.
#[derive(Clone, Debug)]
pub(crate) struct Client {
    pub peer: Peer,
    /// Given by the settings: stays, however silent.
    pub fixed: bool,
    pub received_at: HostTime,
    pub has_spoken: bool,
    /// Systems and components that spoke from here.
    pub systems: heapless::Vec<(u8, u8), 4>,
    pub sequences: Sequences<3>,
    /// Counter of our own packets to it.
    pub sequence: u8,
    /// Place in the ring of the next packet to look at.
    pub cursor: u32,
    /// Bytes in the ring that are for it.
    pub pending: u32,
    /// When the oldest of them came.
    pub since: HostTime,
    /// When it last took something, or had nothing to take.
    pub taken_at: HostTime,
    /// One of them must not wait.
    pub hurry: bool,
    /// Packets sent.
    pub sent: u32,
    /// Packets it was too slow for.
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

    /// Takes note that it has spoken.
    pub(crate) fn note_heard(&mut self, now: HostTime) {
        self.received_at = now;
        self.has_spoken = true;
    }

    /// Takes note of a packet that came from it; returns how many were lost before it.
    pub(crate) fn note(&mut self, now: HostTime, packet: Raw<'_>) -> u32 {
        self.note_heard(now);
        let source = packet.source();
        if !self.systems.contains(&source) {
            if self.systems.is_full() {
                self.systems.remove(0);
            }
            // There is room now.
            let _ = self.systems.push(source);
        }
        self.sequences.note(source, packet.sequence())
    }

    /// Whether a system and component live here; zero is any component.
    pub(crate) fn holds(&self, target: (u8, u8)) -> bool {
        self.systems.iter().any(|&(system, component)| {
            system == target.0 && (target.1 == 0 || component == target.1)
        })
    }

    /// Whether it has taken nothing for too long of what waits for it. A datagram is gone once it is sent;
    /// only a connection can refuse.
    pub(crate) fn is_stalled(&self, now: HostTime) -> bool {
        matches!(self.peer, Peer::Tcp(_))
            && self.pending > 0
            && now.seconds_since(self.taken_at) > STALLED_S
    }

    /// Whether it is reached by datagrams.
    pub(crate) fn is_udp(&self) -> bool {
        matches!(self.peer, Peer::Udp(_))
    }

    /// Whether it has spoken lately; only the settings' client stays when it has not.
    pub(crate) fn speaks(&self, now: HostTime, settings: &Settings) -> bool {
        self.has_spoken && !self.is_silent(now, settings)
    }

    /// Whether it has been silent for too long.
    pub(crate) fn is_gone(&self, now: HostTime, settings: &Settings) -> bool {
        self.is_udp() && !self.fixed && self.is_silent(now, settings)
    }

    fn is_silent(&self, now: HostTime, settings: &Settings) -> bool {
        now.seconds_since(self.received_at) > f64::from(settings.client_timeout_s)
    }
}

/// Returns the bit of a client in a packet's tag.
pub(crate) fn bit(index: usize) -> u8 {
    1 << index
}
