//! Routing of packets: the state behind [`Bridge`](super::Bridge).

use core::fmt::Write as _;
use core::net::{Ipv4Addr, SocketAddrV4};

use heapless::Deque;
use vizflyt_protocol::failsafe::{Failsafe, Flight, is_stream};
use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::time::HostTime;

use super::chip::Chip;
use super::clients::{CLIENTS, Client, Peer, bit};
use super::component::Event;
use super::parameters::TypedTexts;
use super::vehicle_signing::VehicleSigning;
use crate::access;
use crate::capacity::{DOWN, NORMAL, URGENT};
use crate::packet::{CutStats, Raw};
use crate::ring::{Ring, Tag};
use crate::settings::Settings;
use crate::stats::{Reason, Sequences, Stats};

/// Interval of heartbeats and reports [s].
pub(super) const SECOND_S: f64 = 1.0;
/// Silence after which the autopilot counts as lost: three heartbeats [s].
const LOST_AFTER_S: f64 = 3.5;
/// Silence after which a client's place may be given to a new client, if no place is free [s].
const REPLACEABLE_S: f64 = 2.0;

#[derive(Clone, Debug)]
pub(super) struct PacketRouter {
    pub(super) settings: Settings,
    pub(super) chip: Chip,
    pub(super) stats: Stats,
    pub(super) down: Ring<DOWN>,
    pub(super) urgent: Ring<URGENT>,
    pub(super) normal: Ring<NORMAL>,
    pub(super) clients: [Option<Client>; CLIENTS],
    /// Index of the client that is served next: round robin.
    pub(super) turn: usize,
    uart_sequences: Sequences<4>,
    /// Time of the last byte from the autopilot's port.
    pub(super) uart_at: HostTime,
    /// Whether the port is in the middle of a packet.
    pub(super) uart_busy: bool,
    /// System and component of the autopilot, while its heartbeats arrive.
    pub(super) autopilot: Option<(u8, u8)>,
    pub(super) autopilot_at: HostTime,
    pub(super) flight: Flight,
    /// Newest heartbeat of the autopilot, unchanged; the beacon repeats it.
    pub(super) heartbeat: heapless::Vec<u8, 48>,
    pub(super) failsafe: Failsafe,
    pub(super) signing: VehicleSigning,
    pub(super) typed: TypedTexts,
    /// Time at which changed settings are saved.
    pub(super) save_at: Option<HostTime>,
    /// Time of the next announcement of the generated password.
    pub(super) tell_key_at: Option<HostTime>,
    /// Until then, the browser's form rejects every key.
    pub(super) form_opens_at: HostTime,
    /// Whether bytes are forwarded unparsed. Fixed at the start.
    pub(super) transparent: bool,
    pub(super) own_address: Option<Ipv4Addr>,
    /// Cause of an abnormal start, until a client has received it.
    pub(super) untold: Option<&'static str>,
    pub(super) events: Deque<Event, 4>,
    pub(super) started_at: HostTime,
    pub(super) second_at: HostTime,
    pub(super) beacon_due: bool,
    pub(super) broadcast: Option<SocketAddrV4>,
    pub(super) signal_dbm: Option<i8>,
    /// Sequence number of the bridge's own packets to the autopilot.
    pub(super) uart_sequence: u8,
    pub(super) outstanding: super::component::OutstandingRequests,
}

impl PacketRouter {
    /// Returns a router that has not begun. `const`, so that it lies in a chip's static memory and never on its stack.
    pub(super) const fn empty() -> Self {
        Self {
            chip: Chip { address: [0; 6], random: [0; 16] },
            stats: Stats::NONE,
            down: Ring::new(),
            urgent: Ring::new(),
            normal: Ring::new(),
            clients: [const { None }; CLIENTS],
            turn: 0,
            uart_sequences: Sequences::new(),
            uart_at: HostTime::ZERO,
            uart_busy: false,
            autopilot: None,
            autopilot_at: HostTime::ZERO,
            flight: Flight::UNKNOWN,
            heartbeat: heapless::Vec::new(),
            failsafe: Failsafe::NONE,
            signing: VehicleSigning::new(),
            typed: TypedTexts::NONE,
            save_at: None,
            tell_key_at: None,
            form_opens_at: HostTime::ZERO,
            transparent: false,
            own_address: None,
            untold: None,
            events: Deque::new(),
            started_at: HostTime::ZERO,
            second_at: HostTime::ZERO,
            beacon_due: false,
            broadcast: None,
            signal_dbm: None,
            uart_sequence: 0,
            outstanding: super::component::OutstandingRequests::new([0; 16]),
            settings: Settings::unnamed(),
        }
    }

    /// Begins at `now` with the current settings.
    pub(super) fn begin(&mut self, now: HostTime, chip: Chip) {
        self.outstanding = super::component::OutstandingRequests::new(access::nonce(&chip.random));
        self.chip = chip;
        self.transparent = self.settings.transparent;
        self.uart_at = now;
        self.autopilot_at = now;
        self.started_at = now;
        self.second_at = now.plus_seconds(SECOND_S);
        self.apply_settings(now);
    }

    /// Applies the settings that take effect at once: the fixed client and the vehicle's key.
    pub(super) fn apply_settings(&mut self, now: HostTime) {
        self.signing.set_key(self.settings.vehicle_key.as_ref());
        for place in &mut self.clients {
            if place.as_ref().is_some_and(|client| client.fixed) {
                *place = None;
            }
        }
        if let Some(address) = self.settings.client {
            let index = self.open(now, Peer::Udp(address));
            if let Some(client) = index.and_then(|index| self.clients[index].as_mut()) {
                client.fixed = true;
            }
        }
    }

    // ---- from the autopilot ----

    pub(super) fn note_uart_bytes(&mut self, now: HostTime, len: usize) {
        if len > 0 {
            self.uart_at = now;
            self.stats.uart.bytes_in = self.stats.uart.bytes_in.wrapping_add(len as u32);
        }
    }

    pub(super) fn note_uart_cut(&mut self, cut: CutStats, busy: bool) {
        self.stats.uart.cut = cut;
        self.uart_busy = busy;
    }

    pub(super) fn note_stream_cut(&mut self, before: CutStats, after: CutStats) {
        let net = &mut self.stats.net.cut;
        let add = |to: &mut u32, before: u32, after: u32| {
            *to = to.wrapping_add(after.wrapping_sub(before));
        };
        add(&mut net.packets, before.packets, after.packets);
        add(&mut net.unknown, before.unknown, after.unknown);
        add(&mut net.bad_checksum, before.bad_checksum, after.bad_checksum);
        add(&mut net.dropped_bytes, before.dropped_bytes, after.dropped_bytes);
    }

    pub(super) fn take_uart(&mut self, now: HostTime, packet: Raw<'_>) {
        let lost = self.uart_sequences.note(packet.source(), packet.sequence());
        self.stats.uart.lost = self.stats.uart.lost.wrapping_add(lost);
        self.note_from_autopilot(now, packet);
        self.signing.note(now, packet, self.settings.vehicle_key.as_ref());
        if self.is_ours(packet.target()) {
            self.handle_own(now, None, packet);
        }
        // Forward to all clients, including replies to one of them or to the bridge: each client tracks the autopilot's
        // sequence numbers, so a withheld packet would count as lost.
        self.push_down(
            now,
            packet.source(),
            kind(packet.id()),
            self.everybody(),
            false,
            packet.bytes(),
        );
    }

    /// Adds a packet to the clients' ring.
    pub(super) fn push_down(
        &mut self,
        now: HostTime,
        source: (u8, u8),
        kind: u16,
        to: u8,
        ours: bool,
        bytes: &[u8],
    ) {
        if to == 0 {
            if !ours {
                self.stats.drop(Reason::NoClient, 1);
            }
            return;
        }
        while !self.down.fits(bytes.len()) {
            self.evict();
        }
        self.down.push(Tag { kind, source, to, ours, stamp_ms: millis(now) }, bytes);
        for (index, client) in self.clients.iter_mut().enumerate() {
            let Some(client) = client.as_mut().filter(|_| to & bit(index) != 0) else { continue };
            if client.pending == 0 {
                client.since = now;
                client.taken_at = now;
            }
            client.pending += bytes.len() as u32;
            client.hurry |= hurries_down(kind);
        }
    }

    /// Drops the oldest packet of the clients' ring. Clients that have not read it lose it.
    fn evict(&mut self) {
        let tail = self.down.tail();
        let Some((tag, len, next)) = self.down.peek(tail) else { return };
        for (index, client) in self.clients.iter_mut().enumerate() {
            let Some(client) = client.as_mut().filter(|client| client.cursor == tail) else {
                continue;
            };
            client.cursor = next;
            if tag.to & bit(index) != 0 {
                client.pending -= len as u32;
                client.slow = client.slow.wrapping_add(1);
                self.stats.drop(Reason::ClientSlow, 1);
            }
        }
        self.down.pop();
    }

    /// Returns a mask with the bit of every client.
    pub(super) fn everybody(&self) -> u8 {
        let there = |(index, client): (usize, &Option<Client>)| client.as_ref().map(|_| bit(index));
        self.clients.iter().enumerate().filter_map(there).fold(0, |all, one| all | one)
    }

    // ---- from the network ----

    pub(super) fn take_client(&mut self, now: HostTime, peer: Peer, packet: Raw<'_>) {
        let Some(index) = self.open(now, peer) else {
            self.stats.drop(Reason::TooManyClients, 1);
            return;
        };
        if let Some(client) = &mut self.clients[index] {
            let lost = client.note(now, packet);
            self.stats.net.lost = self.stats.net.lost.wrapping_add(lost);
        }
        let target = packet.target();
        let bridge_messages = self.address();
        if self.is_ours(target) {
            self.handle_own(now, Some(index), packet);
            return;
        }
        if target.0 == 0 || (target.0 == bridge_messages.0 && target.1 == 0) {
            // Broadcast, so also for the bridge.
            self.handle_own(now, Some(index), packet);
        }
        let holders = self.holders(target, index);
        if holders != 0 {
            self.push_down(now, packet.source(), kind(packet.id()), holders, false, packet.bytes());
            return;
        }
        self.failsafe.note_packet(now, packet.source(), is_stream(packet.id()));
        self.signing.note(now, packet, self.settings.vehicle_key.as_ref());
        self.note_to_autopilot(now, packet);
        let tag = Tag {
            kind: kind(packet.id()),
            source: packet.source(),
            to: 0,
            ours: false,
            stamp_ms: millis(now),
        };
        self.push_up(tag, packet.bytes());
    }

    /// Returns the other clients that hold `target`; 0 if the target is the vehicle.
    fn holders(&self, target: (u8, u8), except: usize) -> u8 {
        let vehicle = self.autopilot.is_some_and(|(system, _)| system == target.0);
        if target.0 == 0 || vehicle {
            return 0;
        }
        let mut holders = 0;
        for (index, client) in self.clients.iter().enumerate() {
            if index != except && client.as_ref().is_some_and(|client| client.holds(target)) {
                holders |= bit(index);
            }
        }
        holders
    }

    /// Adds a packet to one of the queues for the autopilot's port.
    pub(super) fn push_up(&mut self, tag: Tag, bytes: &[u8]) {
        if overtakes(tag.kind) {
            self.make_way(bytes.len());
            self.urgent.push(tag, bytes);
        } else if self.normal.fits(bytes.len()) {
            self.normal.push(tag, bytes);
        } else {
            self.stats.drop(Reason::UartFull, 1);
        }
    }

    /// Makes room in the urgent queue. The oldest setpoints and poses are dropped first, because newer ones supersede
    /// them; commands are dropped only if none of those is left.
    fn make_way(&mut self, len: usize) {
        let mut commands = 0;
        while !self.urgent.fits(len) {
            let mut packet = [0; MAX_PACKET];
            let Some((tag, len)) = take(&mut self.urgent, &mut packet) else { return };
            if streams(tag.kind) {
                self.stats.drop(Reason::Superseded, 1);
            } else if commands < URGENT / len {
                // Requeue it at the end. After one round, every stream packet has been checked.
                commands += 1;
                self.urgent.push(tag, &packet[..len]);
            } else {
                self.stats.drop(Reason::UartFull, 1);
            }
        }
    }

    /// Returns the index of a client. Adds a new client if a place is free or replaceable.
    pub(super) fn open(&mut self, now: HostTime, peer: Peer) -> Option<usize> {
        if let Some(index) = self.place_of(peer) {
            return Some(index);
        }
        let free = self.clients.iter().position(Option::is_none);
        let index = free.or_else(|| self.replaceable(now))?;
        self.clients[index] = Some(Client::new(peer, false, now, self.down.head()));
        Some(index)
    }

    /// Returns the index of a client.
    pub(super) fn place_of(&self, peer: Peer) -> Option<usize> {
        let here = |client: &Option<Client>| client.as_ref().is_some_and(|c| c.peer == peer);
        self.clients.iter().position(here)
    }

    /// Returns the index of the UDP client with the longest silence, if it exceeds [`REPLACEABLE_S`].
    fn replaceable(&self, now: HostTime) -> Option<usize> {
        self.clients
            .iter()
            .enumerate()
            .filter_map(|(index, client)| Some((index, client.as_ref()?)))
            .filter(|(_, client)| matches!(client.peer, Peer::Udp(_)) && !client.fixed)
            .map(|(index, client)| (index, now.seconds_since(client.received_at)))
            .filter(|&(_, silent_s)| silent_s > REPLACEABLE_S)
            .max_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(index, _)| index)
    }

    pub(super) fn close(&mut self, peer: Peer) {
        if let Some(index) = self.place_of(peer) {
            self.clients[index] = None;
        }
    }

    /// Returns the name of the bridge's own network.
    pub(super) fn network_name(&self) -> heapless::String<32> {
        if !self.settings.ap_ssid.is_empty() {
            return self.settings.ap_ssid.clone();
        }
        let [.., a, b, c] = self.chip.address;
        let mut name = heapless::String::new();
        // 14 characters fit.
        let _ = write!(name, "vizflyt-{a:02x}{b:02x}{c:02x}");
        name
    }

    // ---- time ----

    /// Runs all due work: silence of clients and autopilot, the messages of each second, link loss.
    pub(super) fn poll(&mut self, now: HostTime) {
        for place in &mut self.clients {
            let Some(client) = place else { continue };
            if client.is_stalled(now) {
                self.stats.stalled = self.stats.stalled.wrapping_add(1);
                *place = None;
            } else if client.is_gone(now, &self.settings) {
                *place = None;
            }
        }
        if self.autopilot.is_some() && now.seconds_since(self.autopilot_at) > LOST_AFTER_S {
            self.autopilot = None;
            self.flight = Flight::UNKNOWN;
        }
        self.poll_component(now);
    }

    /// Returns when the next work other than sending is due.
    pub(super) fn due(&self) -> HostTime {
        let mut due = self.save_at.map_or(self.second_at, |at| at.min(self.second_at));
        if let Some(at) = self.failsafe.due(self.flight, self.settings.loss_ms) {
            due = due.min(at);
        }
        due
    }
}

/// Removes the oldest packet of a queue and copies it into `out`.
pub(super) fn take<const N: usize>(
    ring: &mut Ring<N>,
    out: &mut [u8; MAX_PACKET],
) -> Option<(Tag, usize)> {
    let (tag, len, _) = ring.peek(ring.tail())?;
    ring.copy(ring.tail(), &mut out[..len]);
    ring.pop();
    Some((tag, len))
}

/// Returns a message number as stored in the ring.
pub(super) fn kind(id: u32) -> u16 {
    u16::try_from(id).unwrap_or(u16::MAX)
}

/// Returns milliseconds of a clock that wraps after 65.5 s.
pub(super) fn millis(now: HostTime) -> u16 {
    (now.as_ns() / 1_000_000) as u16
}

/// Whether only the newest message of this kind matters.
pub(super) fn streams(kind: u16) -> bool {
    is_stream(kind.into())
}

/// Whether a message overtakes others on the way to the autopilot: streams, commands and time synchronization.
fn overtakes(kind: u16) -> bool {
    // HEARTBEAT, SET_MODE, COMMAND_INT, COMMAND_LONG, COMMAND_CANCEL, TIMESYNC.
    streams(kind) || matches!(kind, 0 | 11 | 75 | 76 | 80 | 111)
}

/// Whether a message from the autopilot is sent without waiting for a full batch.
fn hurries_down(kind: u16) -> bool {
    // COMMAND_ACK, TIMESYNC.
    matches!(kind, 77 | 111)
}
