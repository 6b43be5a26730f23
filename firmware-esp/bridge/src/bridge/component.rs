//! The bridge as a MAVLink component of the vehicle: state that it derives from forwarded packets, and the requests
//! that it serves.

use vizflyt_protocol::failsafe::Flight;
use vizflyt_protocol::mavlink::dialect::{MavCmd, MavResult, MavSeverity};
use vizflyt_protocol::mavlink::{HeartbeatSender, heartbeat_sender};
use vizflyt_protocol::time::HostTime;

use super::fields::Fields;
use super::router::PacketRouter;
use crate::access::{self, Access};
use crate::packet::Raw;
use crate::settings::Settings;

/// Component number of the bridge: MAV_COMP_ID_UDP_BRIDGE.
pub const COMPONENT_ID: u8 = 240;
/// System number until the vehicle's first heartbeat.
const SYSTEM_ID: u8 = 1;

/// Task for the shell; only the shell accesses flash and chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// Write [`Bridge::settings`](super::Bridge::settings) to flash.
    Save,
    /// Restart the chip after all queued packets are sent.
    Restart,
}

/// Requests that await a reply, and the access control of the bridge.
#[derive(Clone, Debug)]
pub(super) struct OutstandingRequests {
    /// Pending TIMESYNC requests: `ts1`, and when they were forwarded.
    syncs: heapless::Deque<(i64, HostTime), 4>,
    /// Time of the last TIMESYNC of a client. After a recent one, the bridge sends none.
    pub(super) client_asked_at: Option<HostTime>,
    pub(super) access: Access,
}

impl OutstandingRequests {
    pub(super) const fn new(nonce: [u8; 16]) -> Self {
        Self { syncs: heapless::Deque::new(), client_asked_at: None, access: Access::new(nonce) }
    }

    pub(super) fn note_sync(&mut self, now: HostTime, ts1: i64) {
        if self.syncs.is_full() {
            self.syncs.pop_front();
        }
        // The removal above made room.
        let _ = self.syncs.push_back((ts1, now));
    }
}

pub(super) const HEARTBEAT: u32 = 0;
pub(super) const PARAM_REQUEST_READ: u32 = 20;
pub(super) const PARAM_REQUEST_LIST: u32 = 21;
pub(super) const PARAM_SET: u32 = 23;
const COMMAND_LONG: u32 = 76;
pub(super) const COMMAND_ACK: u32 = 77;
const TIMESYNC: u32 = 111;
pub(super) const TUNNEL: u32 = 385;

impl PacketRouter {
    /// Returns system and component of the bridge.
    pub(super) fn address(&self) -> (u8, u8) {
        (self.autopilot.map_or(SYSTEM_ID, |(system, _)| system), COMPONENT_ID)
    }

    /// Whether a packet for `target` is only for the bridge. A sender without the vehicle's system number may use 0.
    pub(super) fn is_ours(&self, target: (u8, u8)) -> bool {
        target == self.address() || target == (0, COMPONENT_ID)
    }

    // ---- forwarded packets ----

    /// Records the state in a packet from the autopilot.
    pub(super) fn note_from_autopilot(&mut self, now: HostTime, packet: Raw<'_>) {
        let field = Fields(packet.payload());
        match packet.id() {
            HEARTBEAT => {
                let source = packet.source();
                let sender = heartbeat_sender(source.1, field.byte(4), field.byte(5));
                if !self.is_autopilot(source, sender) {
                    return;
                }
                self.signing.note_heartbeat(packet);
                self.autopilot = Some(source);
                self.autopilot_at = now;
                self.flight = Flight::of(sender, field.byte(6), field.u32(0));
                self.heartbeat = heapless::Vec::from_slice(packet.bytes()).unwrap_or_default();
            }
            COMMAND_ACK => {
                let ours = packet.target() == self.address();
                let land = u32::from(field.u16(0)) == MavCmd::MAV_CMD_NAV_LAND as u32;
                if ours && land && field.byte(2) == MavResult::MAV_RESULT_ACCEPTED as u8 {
                    self.failsafe.note_acknowledged(now);
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

    /// Whether the sender of a heartbeat is the autopilot of this vehicle. The first one keeps its place until it is
    /// silent, but a multirotor replaces another vehicle, for example an antenna tracker on the same line.
    fn is_autopilot(&self, source: (u8, u8), sender: HeartbeatSender) -> bool {
        let is_free = self.autopilot.is_none_or(|known| known == source);
        match sender {
            HeartbeatSender::Multirotor { .. } => {
                is_free || self.flight.sender == HeartbeatSender::OtherVehicle
            }
            HeartbeatSender::OtherVehicle => is_free,
            HeartbeatSender::Device => false,
        }
    }

    /// Records requests of clients to the autopilot.
    pub(super) fn note_to_autopilot(&mut self, now: HostTime, packet: Raw<'_>) {
        let field = Fields(packet.payload());
        if packet.id() == TIMESYNC && field.i64(0) == 0 {
            self.outstanding.note_sync(now, field.i64(8));
            self.outstanding.client_asked_at = Some(now);
        }
        if packet.id() == HEARTBEAT {
            self.failsafe.note_heartbeat(packet.source(), field.bytes(0));
        }
    }

    // ---- packets for the bridge ----

    /// Answers a packet for the bridge from client `from`, or from the autopilot.
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

    /// Whether a packet may change the bridge: it is signed by an owner and the vehicle is disarmed.
    pub(super) fn may_change(&mut self, now: HostTime, packet: Raw<'_>) -> bool {
        let reason = if self.flight.armed {
            "bridge: nothing is changed while armed"
        } else if !self.is_signed_by_owner(packet) {
            "bridge: needs its key: vizflyt bridge configure"
        } else {
            return true;
        };
        self.stats.refused = self.stats.refused.wrapping_add(1);
        self.send_status_text(now, MavSeverity::MAV_SEVERITY_WARNING, reason);
        false
    }

    /// Whether a packet is signed with the bridge's key or with the vehicle's key. The latter already gives control of
    /// the vehicle.
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

    /// Executes an authorized request.
    pub(super) fn grant(&mut self, now: HostTime, request: access::ShellRequest) {
        match request {
            access::ShellRequest::Save => {
                // The queue holds four events: it is full only if the same request is already queued.
                let _ = self.events.push_back(Event::Save);
            }
            access::ShellRequest::Reset => {
                // Keep the keys and the network's password: a reset neither opens the bridge to others nor locks its
                // owner out.
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
}
