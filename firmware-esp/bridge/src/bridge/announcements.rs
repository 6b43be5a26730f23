//! Messages that the bridge sends unprompted: once per second, when the companion is silent, and status texts.

use core::fmt::Write as _;

use vizflyt_protocol::failsafe::{FailsafeAction, land};
use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::mavlink::dialect::{
    HEARTBEAT_DATA, MavAutopilot, MavSeverity, MavState, MavType, RADIO_STATUS_DATA,
    STATUSTEXT_DATA, TIMESYNC_DATA,
};
use vizflyt_protocol::time::HostTime;

use super::clients::{Client, bit};
use super::component::{COMPONENT_ID, HEARTBEAT};
use super::router::{PacketRouter, SECOND_S, kind, millis};
use crate::access;
use crate::mavlink_writer::{BridgeMessage, write_message, write_packet};
use crate::ring::Tag;
use crate::settings::typed_key;

/// Time without a client's TIMESYNC after which the bridge sends one [s].
const SYNC_S: f64 = 2.0;
/// Delay until changed parameters are saved; further changes within it are saved together [s].
const SAVE_S: f64 = 1.0;
/// Interval at which the generated password is announced [s].
const TELL_S: f64 = 10.0;
/// "No reading" in RADIO_STATUS.
const UNKNOWN: u8 = 255;

impl PacketRouter {
    /// Sends the messages of each second, and acts when the companion is silent.
    pub(super) fn poll_component(&mut self, now: HostTime) {
        while let Some(act) = self.failsafe.poll(now, self.flight, self.settings.loss_ms) {
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
        let listens = |client: &Client| client.speaks(now, &self.settings);
        if let Some(text) = self.untold.take_if(|_| self.clients.iter().flatten().any(listens)) {
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

    fn act(&mut self, now: HostTime, act: FailsafeAction) {
        let Some(target) = self.autopilot else { return };
        match act {
            FailsafeAction::Land { confirmation } => {
                if confirmation == 0 {
                    self.stats.landings = self.stats.landings.wrapping_add(1);
                    let text = "bridge: the companion is silent: asks for LAND";
                    self.send_status_text(now, MavSeverity::MAV_SEVERITY_CRITICAL, text);
                }
                let land = BridgeMessage::COMMAND_LONG(land(target, confirmation));
                self.send_to_autopilot(now, &land);
            }
            FailsafeAction::AnnounceLanding => {
                let text = "bridge: landing";
                self.send_status_text(now, MavSeverity::MAV_SEVERITY_CRITICAL, text);
            }
            FailsafeAction::ReportSilence => {
                let unsigned = self.signing.is_required() && self.settings.vehicle_key.is_none();
                let text = if unsigned {
                    "bridge: LAND not acknowledged: vehicle.key missing"
                } else {
                    "bridge: LAND is not acknowledged"
                };
                self.send_status_text(now, MavSeverity::MAV_SEVERITY_EMERGENCY, text);
            }
            FailsafeAction::Beat(system, beat) => {
                let mut packet = [0; MAX_PACKET];
                let source = (system, COMPONENT_ID);
                let len = write_packet(&mut packet, source, 0, HEARTBEAT, &beat);
                self.deliver(now, None, HEARTBEAT, &packet[..len]);
            }
        }
    }

    /// Schedules a save of the settings, so that several changes are saved together.
    pub(super) fn save_soon(&mut self, now: HostTime) {
        self.save_at = Some(now.plus_seconds(SAVE_S));
    }

    /// Generates the password of the bridge's own network, unless one is set or an open network is configured.
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

    /// Announces the generated password until the bridge is claimed. It is sent only to the autopilot's wire.
    fn tell_key(&mut self, now: HostTime) {
        let due = self.tell_key_at.is_some_and(|at| at <= now) && self.settings.key.is_none();
        if due && self.autopilot.is_some() {
            self.tell_key_at = Some(now.plus_seconds(TELL_S));
            let mut text = heapless::String::<50>::new();
            // 27 and 19 characters fit into 50.
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
        // Queue of the companion, which controls the vehicle. Without a companion, the shortest queue counts: a client
        // that does not read its packets must not slow down the others.
        let companion = self.failsafe.companion();
        let is_companion = |client: &&Client| companion.is_some_and(|source| client.holds(source));
        let clients = || self.clients.iter().flatten();
        let waiting = match clients().find(is_companion) {
            Some(client) => client.pending,
            None => clients().map(|client| client.pending).min().unwrap_or(0),
        };
        // Scale of SiK radios: 1.9 steps per decibel above -127 dBm.
        let rssi = self
            .signal_dbm
            .map_or(UNKNOWN, |dbm| ((f32::from(dbm) + 127.0) * 1.9).clamp(0.0, 254.0) as u8);
        RADIO_STATUS_DATA {
            rxerrors: self.stats.uart.cut.bad_checksum as u16,
            fixed: 0,
            rssi,
            remrssi: UNKNOWN,
            // The autopilot throttles its streams by this value.
            txbuf: 100 - (waiting * 100 / crate::capacity::DOWN as u32).min(100) as u8,
            noise: UNKNOWN,
            remnoise: UNKNOWN,
        }
    }

    /// Sends a status text of at most 50 characters to all clients and the autopilot.
    pub(super) fn send_status_text(&mut self, now: HostTime, severity: MavSeverity, text: &str) {
        if self.transparent {
            return;
        }
        let message = status_text(severity, text);
        self.send_to_clients(now, &message);
        self.send_to_autopilot(now, &message);
    }

    /// Sends a message to the sender of the request.
    pub(super) fn reply(&mut self, now: HostTime, to: Option<usize>, id: u32, payload: &[u8]) {
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

    /// Queues a packet of the bridge for a client, or for the autopilot. Its sequence number is set when it is sent.
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
    debug_assert!(text.len() <= 50, "truncated: {text}");
    let data = STATUSTEXT_DATA { severity, text: text.into(), ..Default::default() };
    BridgeMessage::STATUSTEXT(data)
}
