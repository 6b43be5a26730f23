//! Outputs of the bridge and their timing: batches to clients, and the autopilot's port with urgent packets first.

use core::net::SocketAddrV4;

use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::time::HostTime;

use super::IDLE_NS;
use super::clients::{CLIENTS, Client, Peer, bit};
use super::router::{PacketRouter, millis, streams, take};
use crate::mavlink_writer::renumber;
use crate::settings::Settings;
use crate::stats::Reason;

/// Age from which a setpoint or pose is dropped if a newer one waits behind it: one period at 50 Hz [ms].
const STALE_MS: u16 = 20;

impl PacketRouter {
    /// Returns when the next datagram to a client that `of` accepts is due; `None` if none waits.
    pub(super) fn batches_due(&self, of: impl Fn(&Client, &Settings) -> bool) -> Option<HostTime> {
        self.clients
            .iter()
            .flatten()
            .filter(|client| client.pending > 0 && of(client, &self.settings))
            .map(|client| self.batch_due(client))
            .min()
    }

    /// Returns when the pending bytes of a client are sent.
    fn batch_due(&self, client: &Client) -> HostTime {
        if client.hurry || client.pending >= u32::from(self.settings.batch_bytes) {
            return client.since;
        }
        let full = client.since.plus_ns(i64::from(self.settings.batch_us) * 1000);
        if self.uart_busy { full } else { full.min(self.uart_at.plus_ns(IDLE_NS)) }
    }

    pub(super) fn poll_uart(&mut self, now: HostTime, out: &mut [u8; MAX_PACKET]) -> usize {
        self.drop_stale(now);
        let len = take(&mut self.urgent, out).or_else(|| take(&mut self.normal, out));
        let Some((tag, mut len)) = len else { return 0 };
        if tag.ours {
            self.uart_sequence = self.uart_sequence.wrapping_add(1);
            renumber(&mut out[..len], self.uart_sequence);
            len = self.signing.sign(now, out, len);
        }
        self.stats.uart.bytes_out = self.stats.uart.bytes_out.wrapping_add(len as u32);
        self.stats.uart.packets_out = self.stats.uart.packets_out.wrapping_add(1);
        len
    }

    /// Drops late setpoints and poses if a newer one of the same sender waits.
    fn drop_stale(&mut self, now: HostTime) {
        while let Some((tag, _, mut next)) = self.urgent.peek(self.urgent.tail()) {
            let age_ms = millis(now).wrapping_sub(tag.stamp_ms);
            if !streams(tag.kind) || age_ms <= STALE_MS {
                return;
            }
            let mut newer = false;
            while let Some((other, _, behind)) = self.urgent.peek(next) {
                newer |= (other.kind, other.source) == (tag.kind, tag.source);
                next = behind;
            }
            if !newer {
                return;
            }
            self.urgent.pop();
            self.stats.drop(Reason::Superseded, 1);
        }
    }

    /// Writes the next datagram to a client that `of` accepts.
    pub(super) fn poll_udp(
        &mut self,
        now: HostTime,
        out: &mut [u8],
        of: impl Fn(&Client, &Settings) -> bool,
    ) -> Option<(SocketAddrV4, usize)> {
        for step in 0..CLIENTS {
            let index = (self.turn + step) % CLIENTS;
            let Some(client) =
                self.clients[index].as_ref().filter(|client| of(client, &self.settings))
            else {
                continue;
            };
            let Peer::Udp(address) = client.peer else { continue };
            let len = self.fill(now, index, out);
            if len > 0 {
                self.turn = index + 1;
                return Some((address, len));
            }
        }
        None
    }

    /// Writes the autopilot's newest heartbeat as a broadcast, once a second, until a client connects.
    pub(super) fn beacon(&mut self, out: &mut [u8]) -> Option<(SocketAddrV4, usize)> {
        let due = core::mem::take(&mut self.beacon_due);
        let to = self.broadcast.filter(|_| due && self.clients.iter().all(Option::is_none))?;
        let len = self.heartbeat.len();
        out.get_mut(..len).filter(|out| !out.is_empty())?.copy_from_slice(&self.heartbeat);
        Some((to, len))
    }

    pub(super) fn poll_tcp(&mut self, now: HostTime, slot: u8, out: &mut [u8]) -> usize {
        self.place_of(Peer::Tcp(slot)).map_or(0, |index| self.fill(now, index, out))
    }

    /// Writes the due packets of a client into `out`, only whole ones. Returns the length.
    fn fill(&mut self, now: HostTime, index: usize, out: &mut [u8]) -> usize {
        let most = out.len().min(usize::from(self.settings.batch_bytes));
        let due = self.clients[index]
            .as_ref()
            .is_some_and(|client| client.pending > 0 && self.batch_due(client) <= now);
        let Some(client) = self.clients[index].as_mut().filter(|_| due) else { return 0 };
        let mut used = 0;
        while let Some((tag, len, next)) = self.down.peek(client.cursor) {
            if tag.to & bit(index) != 0 {
                let signature = if tag.ours { self.signing.added_bytes(now) } else { 0 };
                if used + len + signature > most {
                    break;
                }
                self.down.copy(client.cursor, &mut out[used..used + len]);
                let mut sent = len;
                if tag.ours {
                    client.sequence = client.sequence.wrapping_add(1);
                    renumber(&mut out[used..used + len], client.sequence);
                    if signature > 0 {
                        let mut packet = [0; MAX_PACKET];
                        packet[..len].copy_from_slice(&out[used..used + len]);
                        sent = self.signing.sign(now, &mut packet, len);
                        out[used..used + sent].copy_from_slice(&packet[..sent]);
                    }
                }
                used += sent;
                client.taken_at = now;
                client.pending -= len as u32;
                client.sent = client.sent.wrapping_add(1);
                self.stats.net.packets_out = self.stats.net.packets_out.wrapping_add(1);
            }
            client.cursor = next;
        }
        if client.pending == 0 {
            client.hurry = false;
        }
        self.stats.net.bytes_out = self.stats.net.bytes_out.wrapping_add(used as u32);
        used
    }
}
