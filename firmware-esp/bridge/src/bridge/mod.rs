//! Sans-IO core of the bridge: bytes of both sides and `now` in, whole packets out.
//!
//! ```text
//! UART ── handle_uart() ──▶ cut ──▶ ring ── poll_udp(), poll_tcp() ──▶ each client, batched
//! network ── handle_datagram(), handle_stream() ──▶ cut ──▶ urgent │ normal ── poll_uart() ──▶ UART
//! ```
//! Packets are forwarded byte for byte, signature included, and never split over datagrams. Packets from the autopilot
//! lie in one ring, which every client reads independently. A slow client loses its oldest packets, and the loss is
//! counted. Towards the autopilot, setpoints, poses and commands overtake other packets. Every dropped packet is
//! counted with its reason ([`Stats`]).

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

/// Silence on the autopilot's port after which a batch is sent [ns]. Autopilots write whole packets, and one byte at
/// 57600 baud takes 0.17 ms.
const IDLE_NS: i64 = 500_000;
/// Silence inside a packet candidate after which it may be a false start that hides whole packets [ns].
const STALL_NS: i64 = 50_000_000;

/// MAVLink bridge; see the module documentation.
#[derive(Clone, Debug)]
pub struct Bridge {
    uart: Cutter,
    /// Whether the bytes behind the waiting candidate were already searched.
    has_looked: bool,
    tcp: [Cutter; TCP_SLOTS],
    router: PacketRouter,
}

impl Bridge {
    pub fn new(now: HostTime, settings: Settings, chip: Chip) -> Self {
        let mut bridge = Self::empty();
        bridge.begin(now, chip, |place| *place = settings);
        bridge
    }

    /// Returns a bridge that has not begun. `const`, for a chip's static memory: its stack is too small for a bridge.
    pub const fn empty() -> Self {
        Self {
            uart: Cutter::new(),
            has_looked: false,
            tcp: [const { Cutter::new() }; TCP_SLOTS],
            router: PacketRouter::empty(),
        }
    }

    /// Begins at `now`. Call it once, before all other methods. `load` changes the default settings in place, because a
    /// chip's stack is too small for copies.
    pub fn begin(&mut self, now: HostTime, chip: Chip, load: impl FnOnce(&mut Settings)) {
        self.router.settings.restore();
        load(&mut self.router.settings);
        self.router.begin(now, chip);
    }

    // ---- inputs ----

    /// Takes bytes from the autopilot's port. They may be split anywhere.
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

    /// Takes a datagram. If it contains a packet, its sender becomes a client.
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

    /// Opens a TCP connection in this slot.
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

    /// Whether a TCP connection is still served. The bridge stops serving stalled connections, and the shell closes
    /// them.
    pub fn is_open(&self, slot: u8) -> bool {
        self.router.place_of(Peer::Tcp(slot)).is_some()
    }

    /// Closes the TCP connection of this slot.
    pub fn close_stream(&mut self, slot: u8) {
        self.router.close(Peer::Tcp(slot));
    }

    /// Sets the radio's received signal strength [dBm]; `None` if unknown.
    pub fn set_signal(&mut self, dbm: Option<i8>) {
        self.router.signal_dbm = dbm;
    }

    /// Sets the number of overruns of the port's own buffer since the start, as counted by the chip.
    pub fn set_overruns(&mut self, overruns: u32) {
        self.router.stats.overruns = overruns;
    }

    /// Sets the cause of the chip's start. An abnormal cause is announced to the first active client.
    pub fn set_restart_cause(&mut self, cause: RestartCause) {
        self.router.stats.restart_cause = cause;
        self.router.untold = cause.message();
    }

    /// Sets the address to which heartbeats are broadcast until a client connects; `None` while the network is down.
    pub fn set_network(&mut self, broadcast: Option<SocketAddrV4>) {
        self.router.broadcast = broadcast;
    }

    /// Sets the bridge's own address on the network.
    pub fn set_address(&mut self, address: Option<Ipv4Addr>) {
        self.router.own_address = address;
    }

    /// Generates a password for the bridge's own network, unless one is set or an open network is configured. Call it
    /// before the network is opened.
    pub fn ensure_password(&mut self, now: HostTime) {
        self.router.ensure_password(now);
    }

    /// Returns the name of the bridge's own network.
    pub fn network_name(&self) -> heapless::String<32> {
        self.router.network_name()
    }

    /// Whether bytes are forwarded unparsed.
    pub fn is_transparent(&self) -> bool {
        self.router.transparent
    }

    /// Counts a packet from [`Self::poll_udp`] or [`Self::poll_uart`] that network or port refused to send.
    pub fn note_not_sent(&mut self) {
        self.router.stats.drop(crate::stats::Reason::NotSent, 1);
    }

    /// Changes a setting as requested by a browser's form, if its key is right. Returns the status.
    pub fn change_by_form(&mut self, now: HostTime, form: &Form) -> access::Status {
        self.router.change_by_form(now, form)
    }

    /// Reports the result of [`Event::Save`]; a failure is announced.
    pub fn note_saved(&mut self, now: HostTime, saved: bool) {
        self.router.note_saved(now, saved);
    }

    /// Runs all work that is due at `now`.
    pub fn handle_timeout(&mut self, now: HostTime) {
        if self.look_due().is_some_and(|due| due <= now) {
            let Self { uart, router, has_looked, .. } = self;
            *has_looked = true;
            uart.look_behind(|packet| router.take_uart(now, packet));
            router.note_uart_cut(uart.stats(), false);
        }
        self.router.poll(now);
    }

    // ---- outputs ----

    /// Writes the next packet for the autopilot into `out`. Returns its length, or 0 if none waits.
    pub fn poll_uart(&mut self, now: HostTime, out: &mut [u8; MAX_PACKET]) -> usize {
        self.router.poll_uart(now, out)
    }

    /// Writes the next datagram into `out` (at least 300 bytes). Returns its destination and length.
    pub fn poll_udp(&mut self, now: HostTime, out: &mut [u8]) -> Option<(SocketAddrV4, usize)> {
        self.router.poll_udp(now, out, |_, _| true).or_else(|| self.router.beacon(out))
    }

    /// Like [`Self::poll_udp`], but only for clients that sent something recently: the network stack has their hardware
    /// address and does not wait for it.
    pub fn poll_udp_speaking(
        &mut self,
        now: HostTime,
        out: &mut [u8],
    ) -> Option<(SocketAddrV4, usize)> {
        let speaks = |client: &Client, settings: &Settings| client.speaks(now, settings);
        self.router.poll_udp(now, out, speaks).or_else(|| self.router.beacon(out))
    }

    /// Like [`Self::poll_udp`], for all other clients.
    pub fn poll_udp_silent(
        &mut self,
        now: HostTime,
        out: &mut [u8],
    ) -> Option<(SocketAddrV4, usize)> {
        self.router.poll_udp(now, out, |client, settings| !client.speaks(now, settings))
    }

    /// Writes data that is due to a TCP client into `out` (at least 300 bytes). Returns its length, or 0 if nothing is
    /// due.
    pub fn poll_tcp(&mut self, now: HostTime, slot: u8, out: &mut [u8]) -> usize {
        self.router.poll_tcp(now, slot, out)
    }

    /// Returns the next task for the shell: save or restart.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.router.events.pop_front()
    }

    /// Returns when the next datagram is due; `None` if none waits.
    pub fn udp_due(&self) -> Option<HostTime> {
        self.router.batches_due(|client, _| client.is_udp())
    }

    /// Returns when the next datagram to a recently active client is due.
    pub fn speaking_due(&self, now: HostTime) -> Option<HostTime> {
        self.router.batches_due(|client, settings| client.is_udp() && client.speaks(now, settings))
    }

    /// Returns when the next datagram to a silent client is due.
    pub fn silent_due(&self, now: HostTime) -> Option<HostTime> {
        self.router.batches_due(|client, settings| client.is_udp() && !client.speaks(now, settings))
    }

    /// Returns when data is due to a TCP client; `None` if none waits.
    pub fn tcp_due(&self, slot: u8) -> Option<HostTime> {
        self.router.batches_due(|client, _| client.peer == Peer::Tcp(slot))
    }

    /// Returns when [`Self::handle_timeout`] is due.
    pub fn poll_timeout(&self) -> HostTime {
        let due = self.router.due();
        self.look_due().map_or(due, |look| due.min(look))
    }

    /// Returns when to search behind the waiting candidate; `None` if already done.
    fn look_due(&self) -> Option<HostTime> {
        let waits = self.uart.is_waiting() && !self.has_looked;
        waits.then(|| self.router.uart_at.plus_ns(STALL_NS))
    }

    pub fn stats(&self) -> &Stats {
        &self.router.stats
    }

    /// Returns the time since the start [s].
    pub fn uptime_s(&self, now: HostTime) -> u32 {
        now.seconds_since(self.router.started_at) as u32
    }

    /// Returns the current settings; the shell writes them to flash on [`Event::Save`].
    pub fn settings(&self) -> &Settings {
        &self.router.settings
    }

    pub fn chip(&self) -> &Chip {
        &self.router.chip
    }

    /// Returns system and component of the autopilot while its heartbeats arrive.
    pub fn autopilot(&self) -> Option<(u8, u8)> {
        self.router.autopilot
    }

    /// Whether the vehicle is armed. While it is, all changes of the bridge are refused.
    pub fn is_armed(&self) -> bool {
        self.router.flight.armed
    }

    /// Returns the stage of a landing that a silent companion caused.
    pub fn landing(&self) -> Option<LandingStage> {
        self.router.failsafe.stage()
    }

    /// Whether the autopilot has acknowledged LAND, or its heartbeat reports it.
    pub fn is_landing(&self) -> bool {
        self.landing().is_some_and(|stage| stage != LandingStage::Asked)
    }

    /// Whether LAND has been unacknowledged for a second.
    pub fn is_unanswered(&self, now: HostTime) -> bool {
        self.router.failsafe.is_unanswered(now)
    }

    /// Returns each client: address, packets sent, packets dropped because it was too slow.
    pub fn clients(&self) -> impl Iterator<Item = (Peer, u32, u32)> {
        self.router.clients.iter().flatten().map(|client| (client.peer, client.sent, client.slow))
    }
}

/// Whether a datagram contains exactly one configuration request. Such requests work in transparent mode too;
/// otherwise, that mode could not be turned off over the network.
fn is_request(datagram: &[u8]) -> bool {
    let (mut cut, mut requests) = (CutStats::default(), 0);
    each_in_datagram(datagram, &mut cut, |packet| {
        let ours = packet.id() == component::TUNNEL && packet.target().1 == COMPONENT_ID;
        let is_request = fields::Fields(packet.payload()).u16(0) == access::TUNNEL_TYPE;
        requests += u32::from(ours && is_request);
    });
    (cut.packets, cut.dropped_bytes, requests) == (1, 0, 1)
}
