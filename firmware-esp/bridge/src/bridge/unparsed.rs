//! Transparent mode: forwards bytes unparsed.

use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::time::HostTime;

use super::clients::Peer;
use super::router::{PacketRouter, millis};
use crate::ring::Tag;
use crate::stats::Reason;

/// Message number of unparsed bytes. No message with priority has this number.
const RAW: u16 = u16::MAX;

impl PacketRouter {
    /// Forwards bytes of the autopilot's port unchanged.
    pub(super) fn take_raw_uart(&mut self, now: HostTime, bytes: &[u8]) {
        for part in bytes.chunks(MAX_PACKET) {
            self.push_down(now, (0, 0), RAW, self.everybody(), false, part);
        }
    }

    /// Forwards bytes of a client unchanged.
    pub(super) fn take_raw_client(&mut self, now: HostTime, peer: Peer, bytes: &[u8]) {
        let Some(index) = self.open(now, peer) else {
            self.stats.drop(Reason::TooManyClients, 1);
            return;
        };
        if let Some(client) = &mut self.clients[index] {
            client.note_heard(now);
        }
        for part in bytes.chunks(MAX_PACKET) {
            let tag = Tag { kind: RAW, source: (0, 0), to: 0, ours: false, stamp_ms: millis(now) };
            self.push_up(tag, part);
        }
    }
}
