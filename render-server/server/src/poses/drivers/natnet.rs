//! Driver for OptiTrack Motive's NatNet, versions 3 and 4: poses of the named rigid bodies. Sans-IO.
//!
//! ```text
//! we send -> CONNECT ------------> SERVERINFO: version, ticks per second of its clock
//! we send -> REQUEST_MODELDEF ---> MODELDEF: names of rigid bodies and their streaming ids
//!         FRAMEOFDATA, by multicast, or by unicast while we send keep-alives: ids, poses, stamps
//! ```
//! The crate `natnet` parses the wire format: no unsafe code, no dependency, every count checked against the
//! available bytes, tested against captures of Motive 3.1. Its sockets are not used. This module implements the
//! conversation and the time: the packets' `transmit` stamps map Motive's clock to the server's, and the age of
//! a pose is `transmit - mid exposure`.

use std::collections::{HashMap, VecDeque};
use std::net::SocketAddr;

use glam::{DQuat, DVec3};
use natnet::command::{ConnectOptions, connect_request_with, keepalive_datagram, request_modeldef};
use natnet::{
    Decoder, FrameOfData, Message, MessageHeader, NAT_FRAMEOFDATA, NAT_MODELDEF, NAT_SERVERINFO,
    ParsePolicy, RigidBody, ServerInfo, Version,
};
use vizflyt_protocol::time::ServerTime;

use super::sender_clock::SenderClock;
use super::source::{Measurement, SourceCounters};
use super::udp::{PoseStream, Silence, UNNAMED};
use super::vehicle_names::{FrameOrder, VehicleNames};
use crate::poses::settings::LocalizationConfig;

/// Address and streaming mode of Motive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Motive {
    /// Multicast; names are requested from the sender.
    Multicast,
    /// Unicast on request; address for commands.
    Unicast(SocketAddr),
}

/// Driver for NatNet.
#[derive(Debug)]
pub struct NatnetStream {
    names: VehicleNames,
    motive: Motive,
    /// Address for commands.
    server: Option<SocketAddr>,
    session: Option<MotiveSession>,
    /// Requested protocol version, if the server's own is unsupported.
    wanted: Option<Version>,
    clock: SenderClock,
    outbox: VecDeque<Vec<u8>>,
    asked: Option<ServerTime>,
    asked_names: Option<ServerTime>,
    kept_alive: Option<ServerTime>,
    received_at: Option<ServerTime>,
    warned_of_version: bool,
    warned_of_sender: bool,
}

/// State of the connected Motive.
#[derive(Debug)]
struct MotiveSession {
    decoder: Decoder,
    ticks_hz: u64,
    /// Vehicle of each rigid body's id; `None` for other objects.
    vehicles: HashMap<i32, Option<usize>>,
    has_names: bool,
}

impl NatnetStream {
    /// Creates a stream for the named vehicles; the first has index 0, and so on.
    pub fn new(config: &LocalizationConfig, source: u8, vehicles: &[&str], motive: Motive) -> Self {
        Self {
            names: VehicleNames::new(config, source, vehicles),
            motive,
            server: match motive {
                Motive::Multicast => None,
                Motive::Unicast(server) => Some(server),
            },
            session: None,
            wanted: None,
            clock: SenderClock::default(),
            outbox: VecDeque::new(),
            asked: None,
            asked_names: None,
            kept_alive: None,
            received_at: None,
            warned_of_version: false,
            warned_of_sender: false,
        }
    }

    fn handle_info(&mut self, bytes: &[u8]) {
        let info = match ServerInfo::parse(bytes) {
            Ok(info) => info,
            Err(error) => return self.names.bad(&error, NOT_MOTIVE),
        };
        let options = ConnectOptions { bitstream_version: self.wanted, ..Default::default() };
        let version = options.stream_version(&info);
        let Ok(decoder) = Decoder::new(version) else {
            if self.motive != Motive::Multicast && self.wanted.is_none() {
                // On request, Motive sends an older version to one listener.
                self.wanted = Some(Version::V4_1);
                self.asked = None;
            } else if !std::mem::replace(&mut self.warned_of_version, true) {
                self.names.warn(format!(
                    "natnet: {} streams NatNet {version}, this server knows 3.0, 3.1, 4.0 and 4.1; \
                     stream by unicast, where it can be asked for 4.1, or update VizFlyt",
                    info.application_name
                ));
            }
            return;
        };
        let decoder = decoder.with_policy(ParsePolicy::Compatible);
        if self.session.as_ref().is_some_and(|session| session.decoder == decoder) {
            return;
        }
        self.session = Some(MotiveSession {
            decoder,
            ticks_hz: info.high_res_clock_frequency,
            vehicles: HashMap::new(),
            has_names: false,
        });
        self.asked_names = None;
    }

    fn handle_names(&mut self, bytes: &[u8]) {
        let Some(session) = &mut self.session else { return };
        let model = match session.decoder.parse(bytes).map(natnet::DecodedMessage::into_message) {
            Ok(Message::ModelDef(model)) => model,
            Ok(_) => return,
            Err(error) => return self.names.bad(&error, NOT_MOTIVE),
        };
        session.vehicles.clear();
        session.has_names = true;
        for (name, id) in model.rigid_bodies().take(MAX_BODIES) {
            session.vehicles.insert(id, self.names.find(name.as_bytes()));
        }
        if !session.vehicles.values().any(Option::is_some) {
            let names: Vec<_> = model.rigid_bodies().map(|(name, _)| name).collect();
            if !names.is_empty() {
                self.names.others(names.into_iter(), RENAME);
            }
        }
    }

    fn handle_frame(&mut self, now: ServerTime, from: SocketAddr, bytes: &[u8]) {
        let Some(session) = &mut self.session else { return };
        let frame = match session.decoder.parse(bytes).map(natnet::DecodedMessage::into_message) {
            Ok(Message::FrameOfData(frame)) => frame,
            Ok(_) => return,
            Err(error) => return self.names.bad(&error, NOT_MOTIVE),
        };
        self.received_at = Some(now);
        let unknown = |body: &RigidBody| !session.vehicles.contains_key(&body.id);
        if frame.params & LIST_CHANGED != 0 || frame.rigid_bodies.iter().any(unknown) {
            session.has_names = false;
        }
        let stamp = self.stamp(&frame, now);
        for body in frame.rigid_bodies.iter().take(MAX_BODIES) {
            let named =
                self.session.as_ref().and_then(|session| *session.vehicles.get(&body.id)?);
            // A rigid body may also be configured by its streaming id.
            let vehicle = named.or_else(|| self.names.find(body.id.to_string().as_bytes()));
            if let Some(vehicle) = vehicle
                && self.names.is_from_sender(vehicle, from, now)
            {
                self.handle_body(vehicle, &frame, body, (stamp, now));
            }
        }
    }

    fn handle_body(
        &mut self,
        vehicle: usize,
        frame: &FrameOfData,
        body: &RigidBody,
        (stamp, now): (Option<ServerTime>, ServerTime),
    ) {
        let number = frame.frame_number.cast_unsigned();
        if self.names.measured().iter().any(|measured| measured.vehicle == vehicle)
            || self.names.is_next(vehicle, number, now) == FrameOrder::Old
        {
            return;
        }
        if !body.tracking_valid() {
            return self.names.occluded(vehicle);
        }
        let p = DVec3::from(body.position.map(f64::from));
        let rotation = DQuat::from_array(body.orientation.map(f64::from));
        // Tolerance for single precision.
        if !(p.abs().cmple(DVec3::splat(MAX_VALUE)).all()
            && (rotation.length() - 1.0).abs() <= 0.01)
        {
            let error = format!(
                "rigid body {} at {p} with rotation {rotation} is not a valid pose",
                body.id
            );
            return self.names.bad(&error, NOT_MOTIVE);
        }
        let stamp = stamp.unwrap_or_else(|| self.names.stamp(vehicle, number, now));
        self.names.measure(vehicle, (stamp, now), (p, rotation.normalize()), None);
    }

    /// Returns the time of exposure of a frame; `None` if the frame does not contain it.
    fn stamp(&mut self, frame: &FrameOfData, now: ServerTime) -> Option<ServerTime> {
        let ticks_hz = self.session.as_ref()?.ticks_hz;
        let timing = &frame.timing;
        if ticks_hz == 0 || timing.transmit == 0 || timing.camera_mid_exposure == 0 {
            return None;
        }
        let ns = |ticks: u64| (u128::from(ticks) * 1_000_000_000 / u128::from(ticks_hz)) as u64;
        let sent = self.clock.map_in_order(ns(timing.transmit), now);
        if let Some(jump_s) = self.clock.take_jump_s() {
            self.names.warn(format!(
                "natnet: Motive's clock has jumped by {jump_s:.3} s; was Motive restarted?"
            ));
        }
        let age_ns = ns(timing.transmit.saturating_sub(timing.camera_mid_exposure));
        Some(sent.plus_ns(-(age_ns.min(OLDEST_NS) as i64)))
    }

    fn handle_message(
        &mut self,
        now: ServerTime,
        from: SocketAddr,
        bytes: &[u8],
    ) -> &[Measurement] {
        self.names.begin();
        match MessageHeader::parse(bytes).map(|header| header.message_id) {
            Ok(NAT_SERVERINFO) => self.handle_info(bytes),
            Ok(NAT_MODELDEF) => self.handle_names(bytes),
            Ok(NAT_FRAMEOFDATA) => self.handle_frame(now, from, bytes),
            // Other messages between Motive and its clients.
            Ok(id) if id <= MAX_ID => {}
            Ok(id) => self.names.bad(&format!("message {id} is not NatNet's"), NOT_MOTIVE),
            Err(error) => self.names.bad(&error, NOT_MOTIVE),
        }
        self.names.measured()
    }

    /// Returns whether a packet comes from the server's computer. By unicast, this is the configured one. By
    /// multicast, frames of any computer are compared by [`VehicleNames::is_from_sender`], so that two senders are
    /// noticed, and another computer is asked for names after the first one is silent.
    fn is_from_server(&mut self, now: ServerTime, from: SocketAddr) -> bool {
        let command = SocketAddr::new(from.ip(), COMMAND_PORT);
        let server = *self.server.get_or_insert(command);
        if server.ip() == from.ip() {
            return true;
        }
        if self.motive != Motive::Multicast {
            if !std::mem::replace(&mut self.warned_of_sender, true) {
                self.names.warn(format!(
                    "natnet: packets of {from} are ignored: poses are requested from {server}"
                ));
            }
            return false;
        }
        if self.received_at.is_none_or(|at| now.seconds_since(at) > FORGOTTEN_S) {
            (self.server, self.session) = (Some(command), None);
        }
        true
    }

    fn is_due(at: &mut Option<ServerTime>, now: ServerTime, every_s: f64) -> bool {
        let due = at.is_none_or(|at| now.seconds_since(at) >= every_s);
        if due {
            *at = Some(now);
        }
        due
    }

    fn ask(&mut self, now: ServerTime) {
        let unicast = matches!(self.motive, Motive::Unicast(_));
        // Motive restarted, or the network was interrupted: register again.
        if unicast && self.received_at.is_some_and(|at| now.seconds_since(at) > FORGOTTEN_S) {
            (self.session, self.received_at) = (None, None);
        }
        let Some(session) = &self.session else {
            let options = ConnectOptions { bitstream_version: self.wanted, ..Default::default() };
            if Self::is_due(&mut self.asked, now, ASK_EVERY_S)
                && let Ok(request) = connect_request_with(options)
            {
                self.outbox.push_back(request.as_bytes().to_vec());
            }
            return;
        };
        if !session.has_names
            && Self::is_due(&mut self.asked_names, now, NAMES_EVERY_S)
            && let Ok(request) = request_modeldef()
        {
            self.outbox.push_back(request.as_bytes().to_vec());
        }
        if unicast && Self::is_due(&mut self.kept_alive, now, ALIVE_EVERY_S) {
            self.outbox.push_back(keepalive_datagram().to_vec());
        }
    }
}

impl PoseStream for NatnetStream {
    fn handle_packet(&mut self, now: ServerTime, bytes: &[u8]) -> &[Measurement] {
        self.handle_message(now, UNNAMED, bytes)
    }

    fn handle_packet_from(
        &mut self,
        now: ServerTime,
        from: SocketAddr,
        bytes: &[u8],
    ) -> &[Measurement] {
        if self.is_from_server(now, from) {
            return self.handle_message(now, from, bytes);
        }
        self.names.begin();
        self.names.measured()
    }

    fn poll_transmit(&mut self, now: ServerTime) -> Option<(SocketAddr, Vec<u8>)> {
        let server = self.server?;
        if self.outbox.is_empty() {
            self.ask(now);
        }
        Some((server, self.outbox.pop_front()?))
    }

    fn next_warning(&mut self) -> Option<String> {
        self.names.next_warning()
    }

    fn counters(&self, vehicle: usize) -> SourceCounters {
        self.names.counters(vehicle)
    }

    fn silence(&self) -> Silence {
        match self.motive {
            Motive::Multicast => Silence {
                at_first: "in Motive's Streaming settings enable NatNet and set Transmission Type to \
                           Multicast; open UDP 1510 and 1511 in both firewalls; where this computer \
                           has several networks, set `interface`",
                later: "is Motive in Live mode, and its network there?",
            },
            Motive::Unicast(_) => Silence {
                at_first: "is that Motive's address? in its Streaming settings enable NatNet and set \
                           Transmission Type to Unicast; open UDP 1510 in its firewall",
                later: "is Motive in Live mode, and its network there?",
            },
        }
    }
}

/// Motive's default command port.
pub const COMMAND_PORT: u16 = 1510;
const NOT_MOTIVE: &str = "is something other than Motive's NatNet sent to this port?";
const RENAME: &str = "rename the rigid body in Motive's Assets pane, or set `objects`";
/// Bit of a frame's parameters: rigid bodies were added or renamed.
const LIST_CHANGED: u16 = 2;
/// The highest id of a NatNet message (NAT_UNRECOGNIZED_REQUEST).
const MAX_ID: u16 = 100;
/// Maximum rigid bodies processed per frame.
const MAX_BODIES: usize = 256;
/// Maximum coordinate: no lab is a thousand kilometres wide, even in millimetres.
const MAX_VALUE: f64 = 1e9;
/// Maximum delay between exposure and sending. [ns]
const OLDEST_NS: u64 = 1_000_000_000;
/// Interval of connection requests, and of name requests. [s]
const ASK_EVERY_S: f64 = 0.5;
const NAMES_EVERY_S: f64 = 1.0;
/// Interval of keep-alives: Motive drops a unicast listener that is silent for some seconds. [s]
const ALIVE_EVERY_S: f64 = 1.0;
const FORGOTTEN_S: f64 = 3.0;

#[cfg(test)]
mod tests;
