//! The bridge, sans-IO: bytes of both sides and `now` in, whole packets out.
//!
//! ```text
//! UART ── handle_uart() ──▶ cut ──▶ ring ── poll_udp(), poll_tcp() ──▶ each client, batched
//! network ── handle_datagram(), handle_stream() ──▶ cut ──▶ urgent │ normal ── poll_uart() ──▶ UART
//! ```
//! Packets go on byte for byte as they came, signature included, never split over datagrams. What
//! the autopilot sends lies in one ring that every client reads at its own pace; who is too slow
//! loses its oldest, counted. Towards the autopilot setpoints, poses and commands overtake the rest.
//! Every packet that does not go on is counted with its reason ([`Stats`]).

mod announcements;
mod chip;
mod clients;
mod component;
mod fields;
mod outgoing;
mod parameters;
mod requests;
mod router;
#[cfg(test)]
mod tests;
mod unparsed;
mod vehicle_signing;

use core::net::{Ipv4Addr, SocketAddrV4};

use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::time::HostTime;

pub use crate::capacity::TCP_SLOTS;
pub use chip::Chip;
use clients::Client;
pub use clients::{CLIENTS, Peer};
pub use component::{COMPONENT_ID, Event};
use router::PacketRouter;
pub use vizflyt_protocol::failsafe::LandingStage;

use crate::access;
use crate::packet::{CutStats, Cutter, each_in_datagram};
use crate::page::form::Form;
use crate::settings::Settings;
use crate::stats::{RestartCause, Stats};

/// Silence on the autopilot's port after which a batch goes out. Autopilots write packets whole; a
/// byte at 57600 baud takes 0.17 ms. [ns]
const IDLE_NS: i64 = 500_000;
/// Silence within a candidate after which it may be a false start, with whole packets behind. [ns]
const STALL_NS: i64 = 50_000_000;

/// The bridge. See the module.
#[derive(Clone, Debug)]
pub struct Bridge {
    uart: Cutter,
    /// Behind the candidate that waits was looked already.
    has_looked: bool,
    tcp: [Cutter; TCP_SLOTS],
    router: PacketRouter,
}

impl Bridge {
    /// Makes a bridge at `now`.
    pub fn new(now: HostTime, settings: Settings, chip: Chip) -> Self {
        let mut bridge = Self::empty();
        bridge.begin(now, chip, |place| *place = settings);
        bridge
    }

    /// A bridge that has not begun: `const`, for a chip's static memory, whose stack has no room
    /// for one.
    pub const fn empty() -> Self {
        Self {
            uart: Cutter::new(),
            has_looked: false,
            tcp: [const { Cutter::new() }; TCP_SLOTS],
            router: PacketRouter::empty(),
        }
    }

    /// Begins at `now`; once, before anything else. `load` changes the default settings where they lie:
    /// a chip's stack has no room for copies.
    pub fn begin(&mut self, now: HostTime, chip: Chip, load: impl FnOnce(&mut Settings)) {
        self.router.settings.restore();
        load(&mut self.router.settings);
        self.router.begin(now, chip);
    }

    // ---- what goes in ----

    /// Takes bytes from the autopilot's port, in any portions.
    pub fn handle_uart(&mut self, now: HostTime, bytes: &[u8]) {
        let Self { uart, router, has_looked, .. } = self;
        *has_looked &= bytes.is_empty();
        router.note_uart_bytes(now, bytes.len());
        if router.transparent {
            return router.take_raw_uart(now, bytes);
        }
        uart.push(bytes, |packet| router.take_uart(now, packet));
        router.note_uart_cut(uart.stats(), uart.is_waiting());
        router.poll(now);
    }

    /// Takes a datagram. Its sender becomes a client if it holds a packet.
    pub fn handle_datagram(&mut self, now: HostTime, from: SocketAddrV4, bytes: &[u8]) {
        let router = &mut self.router;
        let mut cut = router.stats.net.cut;
        router.stats.net.bytes_in = router.stats.net.bytes_in.wrapping_add(bytes.len() as u32);
        if router.transparent && !is_request(bytes) {
            return router.take_raw_client(now, Peer::Udp(from), bytes);
        }
        each_in_datagram(bytes, &mut cut, |packet| {
            router.take_client(now, Peer::Udp(from), packet);
        });
        router.stats.net.cut = cut;
        router.poll(now);
    }

    /// Somebody has connected by TCP to this slot.
    pub fn open_stream(&mut self, now: HostTime, slot: u8) {
        if let Some(cutter) = self.tcp.get_mut(usize::from(slot)) {
            cutter.restart();
            self.router.open(now, Peer::Tcp(slot));
        }
    }

    /// Takes bytes from a TCP connection.
    pub fn handle_stream(&mut self, now: HostTime, slot: u8, bytes: &[u8]) {
        if !self.is_open(slot) {
            return;
        }
        let Self { tcp, router, .. } = self;
        let Some(cutter) = tcp.get_mut(usize::from(slot)) else { return };
        router.stats.net.bytes_in = router.stats.net.bytes_in.wrapping_add(bytes.len() as u32);
        if router.transparent {
            return router.take_raw_client(now, Peer::Tcp(slot), bytes);
        }
        let before = cutter.stats();
        cutter.push(bytes, |packet| router.take_client(now, Peer::Tcp(slot), packet));
        router.note_stream_cut(before, cutter.stats());
        router.poll(now);
    }

    /// Whether a TCP connection is still served; one that takes nothing is not, and the shell ends it.
    pub fn is_open(&self, slot: u8) -> bool {
        self.router.place_of(Peer::Tcp(slot)).is_some()
    }

    /// The TCP connection of this slot has ended.
    pub fn close_stream(&mut self, slot: u8) {
        self.router.close(Peer::Tcp(slot));
    }

    /// Sets how well the radio receives its peer; `None` where it does not know. [dBm]
    pub fn set_signal(&mut self, dbm: Option<i8>) {
        self.router.signal_dbm = dbm;
    }

    /// Sets how often the port's own buffer has run over since the start; the chip counts.
    pub fn set_overruns(&mut self, overruns: u32) {
        self.router.stats.overruns = overruns;
    }

    /// Sets why the chip has started; what is worth telling is told to the first who listens.
    pub fn set_restart_cause(&mut self, cause: RestartCause) {
        self.router.stats.restart_cause = cause;
        self.router.untold = cause.message();
    }

    /// Reports whether the network is up, and the address to which heartbeats are broadcast until
    /// somebody answers.
    pub fn set_network(&mut self, broadcast: Option<SocketAddrV4>) {
        self.router.broadcast = broadcast;
    }

    /// Sets our own address on the network.
    pub fn set_address(&mut self, address: Option<Ipv4Addr>) {
        self.router.own_address = address;
    }

    /// Makes the password of the network that we make, unless there is one or an open network is wanted;
    /// before that network is made.
    pub fn ensure_password(&mut self, now: HostTime) {
        self.router.ensure_password(now);
    }

    /// Returns the name of the network that we make.
    pub fn network_name(&self) -> heapless::String<32> {
        self.router.network_name()
    }

    /// Whether bytes pass unparsed.
    pub fn is_transparent(&self) -> bool {
        self.router.transparent
    }

    /// Network or port refused what was taken from [`Self::poll_udp`] or [`Self::poll_uart`].
    pub fn note_not_sent(&mut self) {
        self.router.stats.drop(crate::stats::Reason::NotSent, 1);
    }

    /// Changes a setting as a browser's form asks, if its key is right; returns how that fared.
    pub fn change_by_form(&mut self, now: HostTime, form: &Form) -> access::Status {
        self.router.change_by_form(now, form)
    }

    /// Reports the result of [`Event::Save`]; a failure is announced.
    pub fn note_saved(&mut self, now: HostTime, saved: bool) {
        self.router.note_saved(now, saved);
    }

    /// Does what is due at `now`.
    pub fn handle_timeout(&mut self, now: HostTime) {
        if self.look_due().is_some_and(|due| due <= now) {
            let Self { uart, router, has_looked, .. } = self;
            *has_looked = true;
            uart.look_behind(|packet| router.take_uart(now, packet));
            router.note_uart_cut(uart.stats(), false);
        }
        self.router.poll(now);
    }

    // ---- what comes out ----

    /// Writes the next packet for the autopilot into `out`; returns its length, 0 if there is none.
    pub fn poll_uart(&mut self, now: HostTime, out: &mut [u8; MAX_PACKET]) -> usize {
        self.router.poll_uart(now, out)
    }

    /// Writes the next datagram into `out` (300 bytes at least); returns its destination and its
    /// length.
    pub fn poll_udp(&mut self, now: HostTime, out: &mut [u8]) -> Option<(SocketAddrV4, usize)> {
        self.router.poll_udp(now, out, |_, _| true).or_else(|| self.router.beacon(out))
    }

    /// As [`Self::poll_udp`], for those alone that have spoken lately: a network stack does not wait for
    /// their address.
    pub fn poll_udp_speaking(
        &mut self,
        now: HostTime,
        out: &mut [u8],
    ) -> Option<(SocketAddrV4, usize)> {
        let speaks = |client: &Client, settings: &Settings| client.speaks(now, settings);
        self.router.poll_udp(now, out, speaks).or_else(|| self.router.beacon(out))
    }

    /// As [`Self::poll_udp`], for all others.
    pub fn poll_udp_silent(
        &mut self,
        now: HostTime,
        out: &mut [u8],
    ) -> Option<(SocketAddrV4, usize)> {
        self.router.poll_udp(now, out, |client, settings| !client.speaks(now, settings))
    }

    /// Writes what is due to a TCP client into `out` (300 bytes at least); returns its length, 0
    /// if nothing is.
    pub fn poll_tcp(&mut self, now: HostTime, slot: u8, out: &mut [u8]) -> usize {
        self.router.poll_tcp(now, slot, out)
    }

    /// Returns what the shell is to do: save, restart.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.router.events.pop_front()
    }

    /// Returns when the next datagram is due; `None` while none waits.
    pub fn udp_due(&self) -> Option<HostTime> {
        self.router.batches_due(|client, _| client.is_udp())
    }

    /// Returns when one is due to a client that has spoken lately.
    pub fn speaking_due(&self, now: HostTime) -> Option<HostTime> {
        self.router.batches_due(|client, settings| client.is_udp() && client.speaks(now, settings))
    }

    /// Returns when one is due to another.
    pub fn silent_due(&self, now: HostTime) -> Option<HostTime> {
        self.router.batches_due(|client, settings| client.is_udp() && !client.speaks(now, settings))
    }

    /// Returns when something is due to a TCP client; `None` while nothing waits.
    pub fn tcp_due(&self, slot: u8) -> Option<HostTime> {
        self.router.batches_due(|client, _| client.peer == Peer::Tcp(slot))
    }

    /// Returns when [`Self::handle_timeout`] is due.
    pub fn poll_timeout(&self) -> HostTime {
        let due = self.router.due();
        self.look_due().map_or(due, |look| due.min(look))
    }

    /// Returns when to look for packets behind the candidate that waits, if not done yet.
    fn look_due(&self) -> Option<HostTime> {
        let waits = self.uart.is_waiting() && !self.has_looked;
        waits.then(|| self.router.uart_at.plus_ns(STALL_NS))
    }

    /// Returns the counters.
    pub fn stats(&self) -> &Stats {
        &self.router.stats
    }

    /// Returns how long it has run. [s]
    pub fn uptime_s(&self, now: HostTime) -> u32 {
        now.seconds_since(self.router.started_at) as u32
    }

    /// Returns the settings as they are now; the shell writes them to flash on [`Event::Save`].
    pub fn settings(&self) -> &Settings {
        &self.router.settings
    }

    /// Returns what it knows of its chip.
    pub fn chip(&self) -> &Chip {
        &self.router.chip
    }

    /// Returns the system and component of the autopilot, while its heartbeats come.
    pub fn autopilot(&self) -> Option<(u8, u8)> {
        self.router.autopilot
    }

    /// Whether the vehicle is armed: then nothing about the bridge is changed.
    pub fn is_armed(&self) -> bool {
        self.router.flight.armed
    }

    /// Returns how far its landing of the vehicle is, because the companion is silent.
    pub fn landing(&self) -> Option<LandingStage> {
        self.router.failsafe.stage()
    }

    /// Whether the autopilot has said that it lands because the bridge asked.
    pub fn is_landing(&self) -> bool {
        self.landing().is_some_and(|stage| stage != LandingStage::Asked)
    }

    /// Whether nothing has acknowledged LAND for a second.
    pub fn is_unanswered(&self, now: HostTime) -> bool {
        self.router.failsafe.is_unanswered(now)
    }

    /// Returns each client: where, packets sent to it, packets it was too slow for.
    pub fn clients(&self) -> impl Iterator<Item = (Peer, u32, u32)> {
        self.router.clients.iter().flatten().map(|client| (client.peer, client.sent, client.slow))
    }
}

/// Whether a datagram is a request for the configuration and nothing else: the way out for whoever has
/// made the bridge transparent.
fn is_request(datagram: &[u8]) -> bool {
    let (mut cut, mut requests) = (CutStats::default(), 0);
    each_in_datagram(datagram, &mut cut, |packet| {
        let ours = packet.id() == component::TUNNEL && packet.target().1 == COMPONENT_ID;
        let is_request = fields::Fields(packet.payload()).u16(0) == access::TUNNEL_TYPE;
        requests += u32::from(ours && is_request);
    });
    (cut.packets, cut.dropped_bytes, requests) == (1, 0, 1)
}
