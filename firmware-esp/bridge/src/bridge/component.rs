//! The bridge as a MAVLink component of the vehicle: it shows itself, answers for its parameters,
//! measures the round trip, reports the radio, and lands the vehicle when the companion is silent.

use core::fmt::Write as _;

use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::mavlink::dialect::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, MavAutopilot, MavCmd, MavModeFlag, MavResult, MavSeverity,
    MavState, MavType, RADIO_STATUS_DATA, STATUSTEXT_DATA, TIMESYNC_DATA,
};
use vizflyt_protocol::time::HostTime;

use super::clients::{Client, bit};
use super::fields::Fields;
use super::loss::{Flight, LossAction};
use super::router::{PacketRouter, kind, millis};
use crate::access::{self, Access};
use crate::mavlink_writer::{BridgeMessage, write_message, write_packet};
use crate::packet::Raw;
use crate::ring::Tag;
use crate::settings::{Settings, typed_key};

/// Our component: MAV_COMP_ID_UDP_BRIDGE.
pub const COMPONENT_ID: u8 = 240;
/// The vehicle's system number before its first heartbeat.
const SYSTEM_ID: u8 = 1;

/// What the shell is to do; only it touches flash and chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// Write [`Bridge::settings`](super::Bridge::settings) to flash.
    Save,
    /// Restart the chip, once what is queued has gone out.
    Restart,
}

/// What was asked of others and awaits its answer, and who may ask us.
#[derive(Clone, Debug)]
pub(super) struct OutstandingRequests {
    /// TIMESYNC requests under way: their `ts1`, and when they passed.
    syncs: heapless::Deque<(i64, HostTime), 4>,
    /// When a client last asked: then we need not.
    client_asked_at: Option<HostTime>,
    pub(super) access: Access,
}

impl OutstandingRequests {
    pub(super) const fn new(nonce: [u8; 16]) -> Self {
        Self { syncs: heapless::Deque::new(), client_asked_at: None, access: Access::new(nonce) }
    }

    fn note_sync(&mut self, now: HostTime, ts1: i64) {
        if self.syncs.is_full() {
            self.syncs.pop_front();
        }
        // There is room now.
        let _ = self.syncs.push_back((ts1, now));
    }
}

/// After this silence of clients' TIMESYNC we ask ourselves. [s]
const SYNC_S: f64 = 2.0;
/// Heartbeats and reports. [s]
pub(super) const SECOND_S: f64 = 1.0;
/// Changes of parameters are kept together after this. [s]
const SAVE_S: f64 = 1.0;
/// The password that the bridge made is told this often. [s]
const TELL_S: f64 = 10.0;
/// No reading, in RADIO_STATUS.
const UNKNOWN: u8 = 255;

const HEARTBEAT: u32 = 0;
pub(super) const PARAM_REQUEST_READ: u32 = 20;
pub(super) const PARAM_REQUEST_LIST: u32 = 21;
pub(super) const PARAM_SET: u32 = 23;
const COMMAND_LONG: u32 = 76;
const COMMAND_ACK: u32 = 77;
const TIMESYNC: u32 = 111;
pub(super) const TUNNEL: u32 = 385;

impl PacketRouter {
    /// Returns our system and component.
    pub(super) fn address(&self) -> (u8, u8) {
        (self.autopilot.map_or(SYSTEM_ID, |(system, _)| system), COMPONENT_ID)
    }

    /// Whether a packet for `target` is for us alone; who does not know the vehicle's number yet
    /// may leave it out.
    pub(super) fn is_ours(&self, target: (u8, u8)) -> bool {
        target == self.address() || target == (0, COMPONENT_ID)
    }

    // ---- what passes by ----

    /// Takes note of a packet from the autopilot.
    pub(super) fn note_from_autopilot(&mut self, now: HostTime, packet: Raw<'_>) {
        let field = Fields(packet.payload());
        match packet.id() {
            HEARTBEAT => {
                let autopilot = field.byte(5);
                if autopilot == MavAutopilot::MAV_AUTOPILOT_INVALID as u8 {
                    return;
                }
                self.signing.note_heartbeat(packet);
                self.autopilot = Some(packet.source());
                self.autopilot_at = now;
                self.flight = Flight {
                    armed: field.byte(6) & MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED.bits() != 0,
                    mode: field.u32(0),
                    px4: autopilot == MavAutopilot::MAV_AUTOPILOT_PX4 as u8,
                };
                self.heartbeat = heapless::Vec::from_slice(packet.bytes()).unwrap_or_default();
            }
            COMMAND_ACK => {
                let ours = packet.target() == self.address();
                let land = u32::from(field.u16(0)) == MavCmd::MAV_CMD_NAV_LAND as u32;
                if ours && land && field.byte(2) == MavResult::MAV_RESULT_ACCEPTED as u8 {
                    self.loss.note_acknowledged(now);
                }
            }
            TIMESYNC if field.i64(0) != 0 => {
                let ts1 = field.i64(8);
                if let Some(&(_, at)) =
                    self.outstanding.syncs.iter().find(|&&(sent, _)| sent == ts1)
                {
                    self.stats.round_trip_us = (now.seconds_since(at) * 1e6) as u32;
                }
            }
            _ => {}
        }
    }

    /// Takes note of what clients ask the autopilot.
    pub(super) fn note_to_autopilot(&mut self, now: HostTime, packet: Raw<'_>) {
        let field = Fields(packet.payload());
        if packet.id() == TIMESYNC && field.i64(0) == 0 {
            self.outstanding.note_sync(now, field.i64(8));
            self.outstanding.client_asked_at = Some(now);
        }
        if packet.id() == HEARTBEAT {
            self.loss.note_heartbeat(packet.source(), field.bytes(0));
        }
    }

    // ---- what is for us ----

    /// Answers a packet for us, from the client `from` or from the autopilot.
    pub(super) fn handle_own(&mut self, now: HostTime, from: Option<usize>, packet: Raw<'_>) {
        match packet.id() {
            PARAM_REQUEST_LIST | PARAM_REQUEST_READ | PARAM_SET => {
                self.handle_parameter(now, from, packet);
            }
            COMMAND_LONG if self.is_ours(packet.target()) => {
                self.handle_command(now, from, packet);
            }
            TUNNEL if self.is_ours(packet.target()) => self.handle_tunnel(now, from, packet),
            _ => {}
        }
    }

    /// Whether a packet may change us: signed with the bridge's key, and the vehicle disarmed.
    pub(super) fn may_change(&mut self, now: HostTime, packet: Raw<'_>) -> bool {
        let reason = if self.flight.armed {
            "bridge: nothing is changed while armed"
        } else if !self.is_signed_by_owner(packet) {
            "bridge: changes need its key: vizflyt bridge configure"
        } else {
            return true;
        };
        self.stats.refused = self.stats.refused.wrapping_add(1);
        self.send_status_text(now, MavSeverity::MAV_SEVERITY_WARNING, reason);
        false
    }

    /// Whether a packet is signed with the bridge's key, or with the vehicle's: whoever has that commands
    /// the vehicle itself.
    fn is_signed_by_owner(&mut self, packet: Raw<'_>) -> bool {
        let keys = [self.settings.key.as_ref(), self.settings.vehicle_key.as_ref()];
        let access = &mut self.outstanding.access;
        keys.into_iter().any(|key| access.signed_by(key, packet))
    }

    fn handle_command(&mut self, now: HostTime, from: Option<usize>, packet: Raw<'_>) {
        let field = Fields(packet.payload());
        let command = u32::from(field.u16(28));
        let request = if command == MavCmd::MAV_CMD_PREFLIGHT_STORAGE as u32 {
            match field.f32(0) {
                1.0 => Some(access::ShellRequest::Save),
                2.0 => Some(access::ShellRequest::Reset),
                _ => None,
            }
        } else if command == MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN as u32 {
            Some(access::ShellRequest::Restart)
        } else {
            None
        };
        let result = match request {
            None => MavResult::MAV_RESULT_UNSUPPORTED,
            Some(request) if self.may_change(now, packet) => {
                self.grant(now, request);
                self.save_soon(now);
                MavResult::MAV_RESULT_ACCEPTED
            }
            Some(_) => MavResult::MAV_RESULT_DENIED,
        };
        let [low, high] = field.u16(28).to_le_bytes();
        let (system, component) = packet.source();
        let ack = [low, high, result as u8, 0, 0, 0, 0, 0, system, component];
        self.reply(now, from, COMMAND_ACK, &ack);
    }

    /// Does what was rightfully asked.
    pub(super) fn grant(&mut self, now: HostTime, request: access::ShellRequest) {
        match request {
            access::ShellRequest::Save => {
                // A request that comes twice counts once; four different ones do not exist.
                let _ = self.events.push_back(Event::Save);
            }
            access::ShellRequest::Reset => {
                // Keys and the own network's password stay: who resets the settings neither opens the
                // bridge to others nor locks its owner out.
                let Settings { ap_password, wifi_open, key, vehicle_key, page_key, .. } =
                    self.settings.clone();
                self.settings = Settings {
                    ap_password,
                    wifi_open,
                    key,
                    vehicle_key,
                    page_key,
                    ..Settings::default()
                };
                self.apply_settings(now);
            }
            access::ShellRequest::Restart => {
                let _ = self.events.push_back(Event::Restart);
            }
        }
    }

    fn handle_tunnel(&mut self, now: HostTime, from: Option<usize>, packet: Raw<'_>) {
        let field = Fields(packet.payload());
        if field.u16(0) != access::TUNNEL_TYPE {
            return;
        }
        let mut request = [0; access::BODY];
        for (at, byte) in request.iter_mut().enumerate() {
            *byte = field.byte(5 + at);
        }
        let len = usize::from(field.byte(4)).min(access::BODY);
        let mut answer = [0; 5 + access::BODY];
        let used = self.handle_request(now, &request[..len], &mut answer[5..]);
        let [low, high] = access::TUNNEL_TYPE.to_le_bytes();
        let (system, component) = packet.source();
        answer[..5].copy_from_slice(&[low, high, system, component, used as u8]);
        self.reply(now, from, TUNNEL, &answer[..5 + used]);
    }

    // ---- messages of our own ----

    /// Once a second, and when the companion is silent.
    pub(super) fn poll_component(&mut self, now: HostTime) {
        while let Some(act) = self.loss.poll(now, self.flight, self.settings.loss_ms) {
            self.act(now, act);
        }
        if self.save_at.is_some_and(|at| at <= now) {
            self.save_at = None;
            self.grant(now, access::ShellRequest::Save);
        }
        if now < self.second_at {
            return;
        }
        self.second_at = now.plus_seconds(SECOND_S);
        if self.transparent {
            return;
        }
        self.tell_key(now);
        self.beacon_due = self.settings.beacon && self.autopilot.is_some();
        self.send_to_clients(
            now,
            &BridgeMessage::HEARTBEAT(HEARTBEAT_DATA {
                mavtype: MavType::MAV_TYPE_GENERIC,
                autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
                system_status: MavState::MAV_STATE_ACTIVE,
                mavlink_version: 3,
                ..HEARTBEAT_DATA::default()
            }),
        );
        if let Some(text) = self.untold.take_if(|_| self.clients.iter().any(Option::is_some)) {
            self.send_status_text(now, MavSeverity::MAV_SEVERITY_ERROR, text);
        }
        if self.autopilot.is_none() {
            return;
        }
        if self.settings.radio_status {
            let status = BridgeMessage::RADIO_STATUS(self.radio_status());
            self.send_to_clients(now, &status);
            self.send_to_autopilot(now, &status);
        }
        let asked_s = self.outstanding.client_asked_at.map(|at| now.seconds_since(at));
        if !asked_s.is_some_and(|asked_s| asked_s < SYNC_S) {
            let ts1 = now.as_ns().cast_signed().max(1);
            self.outstanding.note_sync(now, ts1);
            self.send_to_autopilot(
                now,
                &BridgeMessage::TIMESYNC(TIMESYNC_DATA { ts1, ..Default::default() }),
            );
        }
    }

    fn act(&mut self, now: HostTime, act: LossAction) {
        let Some(target) = self.autopilot else { return };
        match act {
            LossAction::Land { confirmation } => {
                if confirmation == 0 {
                    self.stats.landings = self.stats.landings.wrapping_add(1);
                    let text = "bridge: the companion is silent: asks for LAND";
                    self.send_status_text(now, MavSeverity::MAV_SEVERITY_CRITICAL, text);
                }
                let land = COMMAND_LONG_DATA {
                    command: MavCmd::MAV_CMD_NAV_LAND,
                    target_system: target.0,
                    target_component: target.1,
                    confirmation,
                    ..Default::default()
                };
                self.send_to_autopilot(now, &BridgeMessage::COMMAND_LONG(land));
            }
            LossAction::AnnounceLanding => {
                let text = "bridge: landing";
                self.send_status_text(now, MavSeverity::MAV_SEVERITY_CRITICAL, text);
            }
            LossAction::ReportSilence => {
                let unsigned = self.signing.is_required() && self.settings.vehicle_key.is_none();
                let text = if unsigned {
                    "bridge: LAND not acknowledged: vehicle.key missing"
                } else {
                    "bridge: LAND is not acknowledged"
                };
                self.send_status_text(now, MavSeverity::MAV_SEVERITY_EMERGENCY, text);
            }
            LossAction::Beat(system, beat) => {
                let mut packet = [0; MAX_PACKET];
                let source = (system, COMPONENT_ID);
                let len = write_packet(&mut packet, source, 0, HEARTBEAT, &beat);
                self.deliver(now, None, HEARTBEAT, &packet[..len]);
            }
        }
    }

    /// Keeps the settings in a moment: several changes come together.
    pub(super) fn save_soon(&mut self, now: HostTime) {
        self.save_at = Some(now.plus_seconds(SAVE_S));
    }

    /// Makes the own network's password where there is none and nobody asked for an open one.
    pub(super) fn ensure_password(&mut self, now: HostTime) {
        if self.settings.wifi_open || !self.settings.ap_password.is_empty() {
            return;
        }
        let key = typed_key(&access::key_bytes(&self.chip.random));
        let mut password = heapless::String::new();
        // 19 characters fit into 64.
        let _ = password.push_str(&key);
        if self.settings.page_key.is_empty() {
            self.settings.page_key = password.clone();
        }
        self.settings.ap_password = password;
        self.grant(now, access::ShellRequest::Save);
        self.tell_key_at = Some(now);
    }

    /// Tells the password that it made by itself, at the autopilot's wire and nowhere else, until
    /// somebody has claimed the bridge.
    fn tell_key(&mut self, now: HostTime) {
        let due = self.tell_key_at.is_some_and(|at| at <= now) && self.settings.key.is_none();
        if due && self.autopilot.is_some() {
            self.tell_key_at = Some(now.plus_seconds(TELL_S));
            let mut text = heapless::String::<50>::new();
            // 27 characters and 19: it fits.
            let _ = write!(text, "bridge: its network's key: {}", self.settings.ap_password);
            let message = status_text(MavSeverity::MAV_SEVERITY_NOTICE, &text);
            self.send_to_autopilot(now, &message);
        }
    }

    pub(super) fn note_saved(&mut self, now: HostTime, saved: bool) {
        if !saved {
            let text = "bridge: its flash did not take the settings";
            self.send_status_text(now, MavSeverity::MAV_SEVERITY_ERROR, text);
        }
    }

    fn radio_status(&self) -> RADIO_STATUS_DATA {
        // The companion's, which the vehicle flies by; without one whoever is quickest: a client that
        // does not take its packets must not slow the others down.
        let companion = self.loss.companion();
        let is_companion = |client: &&Client| companion.is_some_and(|source| client.holds(source));
        let clients = || self.clients.iter().flatten();
        let waiting = match clients().find(is_companion) {
            Some(client) => client.pending,
            None => clients().map(|client| client.pending).min().unwrap_or(0),
        };
        // As SiK radios count: 1.9 steps per decibel above -127 dBm.
        let rssi = self
            .signal_dbm
            .map_or(UNKNOWN, |dbm| ((f32::from(dbm) + 127.0) * 1.9).clamp(0.0, 254.0) as u8);
        RADIO_STATUS_DATA {
            rxerrors: self.stats.uart.cut.bad_checksum as u16,
            fixed: 0,
            rssi,
            remrssi: UNKNOWN,
            // What the autopilot slows its streams by.
            txbuf: 100 - (waiting * 100 / super::router::DOWN as u32).min(100) as u8,
            noise: UNKNOWN,
            remnoise: UNKNOWN,
        }
    }

    /// Says a sentence of at most 50 characters to everybody.
    fn send_status_text(&mut self, now: HostTime, severity: MavSeverity, text: &str) {
        if self.transparent {
            return;
        }
        let message = status_text(severity, text);
        self.send_to_clients(now, &message);
        self.send_to_autopilot(now, &message);
    }

    /// Sends a message to whoever asked.
    fn reply(&mut self, now: HostTime, to: Option<usize>, id: u32, payload: &[u8]) {
        let mut packet = [0; MAX_PACKET];
        let len = write_packet(&mut packet, self.address(), 0, id, payload);
        self.deliver(now, to, id, &packet[..len]);
    }

    fn send_to_clients(&mut self, now: HostTime, message: &BridgeMessage) {
        let mut packet = [0; MAX_PACKET];
        let len = write_message(&mut packet, self.address(), 0, message);
        let everybody = self.everybody();
        self.push_down(now, self.address(), kind(message.id()), everybody, true, &packet[..len]);
    }

    fn send_to_autopilot(&mut self, now: HostTime, message: &BridgeMessage) {
        let mut packet = [0; MAX_PACKET];
        let len = write_message(&mut packet, self.address(), 0, message);
        self.deliver(now, None, message.id(), &packet[..len]);
    }

    /// Puts a packet of ours into the queue of a client or of the autopilot; its number follows
    /// when it goes out.
    pub(super) fn deliver(&mut self, now: HostTime, to: Option<usize>, id: u32, packet: &[u8]) {
        let source = self.address();
        if let Some(index) = to {
            self.push_down(now, source, kind(id), bit(index), true, packet);
        } else {
            let tag = Tag { kind: kind(id), source, to: 0, ours: true, stamp_ms: millis(now) };
            self.push_up(tag, packet);
        }
    }
}

fn status_text(severity: MavSeverity, text: &str) -> BridgeMessage {
    let data = STATUSTEXT_DATA { severity, text: text.into(), ..Default::default() };
    BridgeMessage::STATUSTEXT(data)
}
