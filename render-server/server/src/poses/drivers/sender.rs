//! Sender of a vehicle's poses: a stream is pinned to the first address that sends it. Sans-IO.
//!
//! If a second address sends poses of the same vehicle, the server cannot distinguish the right one, and both
//! disagree at least in time. Then none is used: the vehicle holds and lands, as without poses. A new address takes
//! over after a silence of the pinned one, for example because its program was restarted.

use std::net::SocketAddr;

use vizflyt_protocol::time::ServerTime;

/// Sender of one vehicle's poses.
#[derive(Clone, Debug, Default)]
pub(super) struct Sender {
    /// Address, and time of its last packet.
    pinned: Option<(SocketAddr, ServerTime)>,
    /// Last packet of any other address.
    other: Option<(SocketAddr, ServerTime)>,
    /// Time of the last conflict, and of the last change of address.
    conflict_at: Option<ServerTime>,
    took_over_at: Option<ServerTime>,
}

/// Result of a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Heard {
    /// The packet may be used.
    Pinned,
    /// The packet may be used; its sender replaces this one, which is silent. The address is given once in
    /// [`REPORT_APART_S`].
    TookOver(Option<SocketAddr>),
    /// The packet is not of the pinned sender.
    Other,
    /// The packet is of the pinned sender, but this address sends too. The address is given once for each conflict.
    Conflict(Option<SocketAddr>),
}

impl Sender {
    /// Whether a packet without a pose may be of the vehicle: no other address has sent poses of it lately.
    pub(super) fn may_be(&self, from: SocketAddr, now: ServerTime) -> bool {
        self.pinned.is_none_or(|(pinned, at)| pinned == from || now.seconds_since(at) > SILENT_S)
    }

    /// Processes a packet that arrived at `now`.
    pub(super) fn handle_packet(&mut self, from: SocketAddr, now: ServerTime) -> Heard {
        let is_past =
            |at: Option<ServerTime>, s: f64| at.is_none_or(|at| now.seconds_since(at) > s);
        match self.pinned {
            Some((pinned, at)) if pinned != from => {
                if !is_past(Some(at), SILENT_S) {
                    self.other = Some((from, now));
                    return Heard::Other;
                }
                (self.pinned, self.other) = (Some((from, now)), None);
                let is_news = is_past(self.took_over_at, REPORT_APART_S);
                self.took_over_at = Some(now);
                Heard::TookOver(is_news.then_some(pinned))
            }
            _ => {
                self.pinned = Some((from, now));
                let Some((other, _)) = self.other.filter(|&(_, at)| !is_past(Some(at), CONFLICT_S))
                else {
                    return Heard::Pinned;
                };
                let is_news = is_past(self.conflict_at, REPORT_APART_S);
                self.conflict_at = Some(now);
                Heard::Conflict(is_news.then_some(other))
            }
        }
    }
}

/// Silence after which another address may take over: the vehicle has held its position and is ordered to land. [s]
const SILENT_S: f64 = 0.5;
/// Time after a packet of another address in which no pose is used: longer than the time until the vehicle holds,
/// shorter than the time until it lands, so that a single stray packet does not land it. [s]
const CONFLICT_S: f64 = 0.3;
/// Minimum quiet time between two reports. [s]
const REPORT_APART_S: f64 = 5.0;

#[cfg(test)]
mod tests;
