//! OptiTrack Motive's NatNet, 3 and 4: packets in, the poses of the named rigid bodies out. Sans-IO.
//!
//! ```text
//! ours -> CONNECT ------------> SERVERINFO: version, ticks per second of its clock
//! ours -> REQUEST_MODELDEF ---> MODELDEF: names of rigid bodies and their streaming ids
//!         FRAMEOFDATA, by multicast, or by unicast while we keep alive: ids, poses, stamps
//! ```
//! The wire format is the crate `natnet`'s: no unsafe code, no dependency, every count checked
//! against the bytes that are there, tested against captures of Motive 3.1; its sockets stay out. What
//! is ours is the conversation, and time: Motive's clock is related to ours by the packets' `transmit`
//! stamps, and a pose is as old as `transmit - mid exposure`.

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
use super::udp::{PoseStream, Silence};
use super::vehicle_names::{FrameOrder, VehicleNames};
use crate::poses::settings::LocalizationConfig;

/// Who Motive is, and how it streams.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Motive {
    /// By multicast; who sends is asked for names.
    Multicast,
    /// To us alone, because we ask; this is where it takes commands.
    Unicast(SocketAddr),
}

/// The conversation with Motive.
#[derive(Debug)]
pub struct NatnetStream {
    names: VehicleNames,
    motive: Motive,
    /// Where commands go.
    server: Option<SocketAddr>,
    session: Option<MotiveSession>,
    /// What the server is asked to speak, if its own version is not known here.
    wanted: Option<Version>,
    clock: SenderClock,
    outbox: VecDeque<Vec<u8>>,
    asked: Option<ServerTime>,
    asked_names: Option<ServerTime>,
    kept_alive: Option<ServerTime>,
    received_at: Option<ServerTime>,
    warned_of_version: bool,
}

/// What is known of the Motive that sends.
#[derive(Debug)]
struct MotiveSession {
    decoder: Decoder,
    ticks_hz: u64,
    /// Whose rigid body has this id; none: nobody's.
    vehicles: HashMap<i32, Option<usize>>,
    has_names: bool,
}

impl NatnetStream {
    /// Makes a stream that yields the poses of the vehicles named, the first at index 0, and so on.
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
                // Motive can be asked to speak an older version to one listener.
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

    fn handle_frame(&mut self, now: ServerTime, bytes: &[u8]) {
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
            // A person may name a rigid body by its streaming id, too.
            let vehicle = named.or_else(|| self.names.find(body.id.to_string().as_bytes()));
            if let Some(vehicle) = vehicle {
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
        // Single precision, so a few digits of unit length.
        if !(p.abs().cmple(DVec3::splat(MAX_VALUE)).all()
            && (rotation.length() - 1.0).abs() <= 0.01)
        {
            let error =
                format!("rigid body {} at {p} with rotation {rotation} is no pose", body.id);
            return self.names.bad(&error, NOT_MOTIVE);
        }
        let stamp = stamp.unwrap_or_else(|| self.names.stamp(vehicle, number, now));
        self.names.measure(vehicle, (stamp, now), (p, rotation.normalize()), None);
    }

    /// Returns when the cameras were exposed for a frame; `None` if it does not state it.
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

    fn is_due(at: &mut Option<ServerTime>, now: ServerTime, every_s: f64) -> bool {
        let due = at.is_none_or(|at| now.seconds_since(at) >= every_s);
        if due {
            *at = Some(now);
        }
        due
    }

    fn ask(&mut self, now: ServerTime) {
        let unicast = matches!(self.motive, Motive::Unicast(_));
        // Motive was restarted, or the network was away: it has forgotten us.
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
        self.names.begin();
        match MessageHeader::parse(bytes).map(|header| header.message_id) {
            Ok(NAT_SERVERINFO) => self.handle_info(bytes),
            Ok(NAT_MODELDEF) => self.handle_names(bytes),
            Ok(NAT_FRAMEOFDATA) => self.handle_frame(now, bytes),
            // Chat between Motive and its clients.
            Ok(id) if id <= MAX_ID => {}
            Ok(id) => self.names.bad(&format!("message {id} is not NatNet's"), NOT_MOTIVE),
            Err(error) => self.names.bad(&error, NOT_MOTIVE),
        }
        self.names.measured()
    }

    fn handle_packet_from(
        &mut self,
        now: ServerTime,
        from: SocketAddr,
        bytes: &[u8],
    ) -> &[Measurement] {
        if self.server.is_none() {
            self.server = Some(SocketAddr::new(from.ip(), COMMAND_PORT));
        }
        self.handle_packet(now, bytes)
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

/// Where Motive takes commands, unless someone changed it.
pub const COMMAND_PORT: u16 = 1510;
const NOT_MOTIVE: &str = "is something other than Motive's NatNet sent to this port?";
const RENAME: &str = "rename the rigid body in Motive's Assets pane, or set `objects`";
/// Bit of a frame's parameters: rigid bodies were added or renamed.
const LIST_CHANGED: u16 = 2;
/// The highest id of a NatNet message (NAT_UNRECOGNIZED_REQUEST).
const MAX_ID: u16 = 100;
/// Rigid bodies of one Motive at most, as far as we look.
const MAX_BODIES: usize = 256;
/// No lab is a thousand kilometres wide, not in millimetres either.
const MAX_VALUE: f64 = 1e9;
/// A frame is not sent later after its exposure. [ns]
const OLDEST_NS: u64 = 1_000_000_000;
/// How often is asked who is there, and for names. [s]
const ASK_EVERY_S: f64 = 0.5;
const NAMES_EVERY_S: f64 = 1.0;
/// Motive forgets a unicast listener that is silent for some seconds. [s]
const ALIVE_EVERY_S: f64 = 1.0;
const FORGOTTEN_S: f64 = 3.0;

#[cfg(test)]
mod tests;
