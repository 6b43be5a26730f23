//! VizFlyt's own pose packet: one JSON object a datagram, from any program. Sans-IO.
//!
//! ```json
//! {"vizflyt_pose": 1, "object": "vizflyt", "seq": 12, "stamp_ns": 123456789, "clock": "sender",
//!  "position_m": [1.0, 2.0, 0.5], "rotation_xyzw": [0, 0, 0, 1],
//!  "position_sigma_m": [0.002, 0.002, 0.004], "rotation_sigma_rad": [0.01, 0.01, 0.01]}
//! ```
//! `seq`, `stamp_ns`, `clock` and the sigmas may be left out. Stamps are of this computer's
//! CLOCK_MONOTONIC (`"clock": "server"`), or of any clock of the sender's (`"sender"`, also if
//! nothing is given), which [`super::sender_clock`] relates to ours. Without a stamp, `seq` gives the
//! rhythm; without either, a pose is as old as its arrival. `quality` is what `vizflyt tags locate` saw:
//! `{"tags": 3, "cameras": 2, "rms_px": 0.2, "image_ms": 1.4, "view_port": 8091}`. `notes` are sentences for people,
//! `["left camera moved by 2.4 cm: survey again"]`, in each packet for as long as they are true: the page shows each once.
//! What else the object holds is ignored.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use glam::{DQuat, DVec3};
use serde::Deserialize;
use vizflyt_arena::pose::PoseSigma;
use vizflyt_protocol::time::ServerTime;

use super::sender_clock::SenderClock;
use super::source::{Measurement, SourceCounters, TagsSeen};
use super::udp::{PoseStream, Silence};
use super::vehicle_names::{FrameOrder, VehicleNames};
use crate::poses::settings::LocalizationConfig;

/// A packet, as it is written.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct PosePacket<'a> {
    /// Version: 1.
    vizflyt_pose: u32,
    /// Name of the object.
    #[serde(borrow)]
    pub object: Cow<'a, str>,
    /// Counts packets of this object.
    #[serde(default)]
    pub seq: Option<u64>,
    /// When the pose was true. [ns, clock]
    #[serde(default)]
    pub stamp_ns: Option<u64>,
    /// Whose clock that is.
    #[serde(default)]
    pub clock: StampClock,
    /// Where the object is. [m, world]
    pub position_m: [f64; 3],
    /// Rotation of its axes into the world's.
    pub rotation_xyzw: [f64; 4],
    /// Standard deviation of the position. [m, world]
    #[serde(default)]
    pub position_sigma_m: Option<[f64; 3]>,
    /// Standard deviation of the rotation. [rad, body]
    #[serde(default)]
    pub rotation_sigma_rad: Option<[f64; 3]>,
    /// What the pose rests on, if that is tags.
    #[serde(default, deserialize_with = "tags_if_any")]
    pub quality: Option<TagsSeen>,
    /// What its sender has to tell people.
    #[serde(borrow, default)]
    pub notes: Vec<Cow<'a, str>>,
}

/// Reads the `quality` of `vizflyt tags locate`; what another program means by `quality` is its own affair.
fn tags_if_any<'de, D: serde::Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<TagsSeen>, D::Error> {
    let value = serde_json::Value::deserialize(deserializer)?;
    Ok(TagsSeen::deserialize(value).ok())
}

/// Whose clock a stamp is of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StampClock {
    /// CLOCK_MONOTONIC of the render server's computer.
    Server,
    /// Another.
    #[default]
    Sender,
}

/// Why bytes are no packet.
#[derive(Debug, thiserror::Error)]
pub enum JsonError {
    /// It is no such JSON object.
    #[error("packet of {length} bytes is no pose packet: {error}")]
    Json {
        /// Its length.
        length: usize,
        /// What the reader says.
        error: serde_json::Error,
    },
    /// A version this parser does not know.
    #[error("vizflyt_pose is {0}, this server knows 1")]
    Version(u32),
    /// Numbers that are no position.
    #[error("position_m {0:?} is absurdly large")]
    Position([f64; 3]),
    /// A quaternion that is no rotation.
    #[error("rotation_xyzw {0:?} is not of unit length")]
    Rotation([f64; 4]),
    /// Invalid sigmas.
    #[error("{key} {value:?}: give positive numbers")]
    Sigma {
        /// The key.
        key: &'static str,
        /// What it says.
        value: [f64; 3],
    },
}

impl<'a> PosePacket<'a> {
    /// Reads a packet and checks its numbers.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, JsonError> {
        let packet: Self = serde_json::from_slice(bytes)
            .map_err(|error| JsonError::Json { length: bytes.len(), error })?;
        if packet.vizflyt_pose != 1 {
            return Err(JsonError::Version(packet.vizflyt_pose));
        }
        // JSON has no NaN, but numbers that overflow.
        if !packet.position_m.iter().all(|value| value.abs() <= MAX_VALUE) {
            return Err(JsonError::Position(packet.position_m));
        }
        let length = DQuat::from_array(packet.rotation_xyzw).length();
        // Three digits are enough to write a quaternion by.
        if !((length - 1.0).abs() <= 0.01) {
            return Err(JsonError::Rotation(packet.rotation_xyzw));
        }
        for (key, value) in [
            ("position_sigma_m", packet.position_sigma_m),
            ("rotation_sigma_rad", packet.rotation_sigma_rad),
        ] {
            if let Some(value) = value
                && !value.iter().all(|sigma| *sigma > 0.0 && *sigma <= MAX_VALUE)
            {
                return Err(JsonError::Sigma { key, value });
            }
        }
        Ok(packet)
    }
}

/// Selects our vehicles from the packets.
#[derive(Debug)]
pub struct JsonStream {
    names: VehicleNames,
    /// Of each vehicle: its packets may come from different programs.
    clocks: Vec<SenderClock>,
    /// What the newest pose of each vehicle rests on.
    tags: Vec<Option<TagsSeen>>,
    notes: Notes,
    warned_of_clock: bool,
}

impl JsonStream {
    /// Makes a stream that yields the poses of the vehicles named, the first at index 0, and so on.
    pub fn new(config: &LocalizationConfig, source: u8, vehicles: &[&str]) -> Self {
        let names = VehicleNames::new(config, source, vehicles);
        let clocks = vec![SenderClock::default(); names.len()];
        let tags = vec![None; names.len()];
        Self { names, clocks, tags, notes: Notes::default(), warned_of_clock: false }
    }

    fn stamp(&mut self, vehicle: usize, packet: &PosePacket<'_>, now: ServerTime) -> ServerTime {
        match (packet.stamp_ns, packet.clock) {
            (Some(stamp_ns), StampClock::Server) => {
                let stamp = ServerTime::from_ns(stamp_ns);
                let age_s = now.seconds_since(stamp);
                if (-FUTURE_S..=OLDEST_S).contains(&age_s) {
                    return stamp.min(now);
                }
                if !std::mem::replace(&mut self.warned_of_clock, true) {
                    self.names.warn(format!(
                        "json: '{}' is stamped {age_s:.3} s before it came; `\"clock\": \"server\"` \
                         means CLOCK_MONOTONIC of this very computer: leave `clock` out if the sender \
                         runs elsewhere; till then poses are stamped as they come",
                        packet.object
                    ));
                }
                now
            }
            (Some(stamp_ns), StampClock::Sender) => {
                let clock = &mut self.clocks[vehicle];
                let stamp = clock.map_in_order(stamp_ns, now);
                if let Some(jump_s) = clock.take_jump_s() {
                    self.names.warn(format!(
                        "json: the clock that stamps '{}' has jumped by {jump_s:.3} s; if its sender was \
                         not restarted, use a monotonic one (in Python time.monotonic_ns())",
                        packet.object
                    ));
                }
                stamp
            }
            (None, _) => match packet.seq {
                Some(seq) => self.names.stamp(vehicle, seq as u32, now),
                None => now,
            },
        }
    }
}

impl PoseStream for JsonStream {
    fn handle_packet(&mut self, now: ServerTime, bytes: &[u8]) -> &[Measurement] {
        self.handle_packet_from(now, NOBODY, bytes)
    }

    fn handle_packet_from(
        &mut self,
        now: ServerTime,
        from: SocketAddr,
        bytes: &[u8],
    ) -> &[Measurement] {
        self.names.begin();
        let packet = match PosePacket::parse(bytes) {
            Ok(packet) => packet,
            Err(error) => {
                let advice = "docs/guides/localization.md shows a packet";
                self.names.bad(&error, advice);
                return &[];
            }
        };
        let Some(vehicle) = self.names.find(packet.object.as_bytes()) else {
            let advice = "correct `object` in the sender, or start the server with --vehicle";
            self.names.others(std::iter::once(&*packet.object), advice);
            return &[];
        };
        for note in &packet.notes {
            if let Some(note) = self.notes.news(note, now) {
                self.names.warn(format!("{}: {note}", packet.object));
            }
        }
        let order = packet.seq.map(|seq| self.names.is_next(vehicle, seq as u32, now));
        match order {
            Some(FrameOrder::Old) => return &[],
            // Its clock may have begun anew, too.
            Some(FrameOrder::Restarted) => self.clocks[vehicle] = SenderClock::default(),
            Some(FrameOrder::Next) | None => {}
        }
        let stamp = self.stamp(vehicle, &packet, now);
        let sigma = packet
            .position_sigma_m
            .zip(packet.rotation_sigma_rad)
            .map(|(p, r)| PoseSigma { position_m: p.into(), rotation_rad: r.into() });
        self.tags[vehicle] = packet.quality.map(|seen| {
            // A port, and not an address, as anyone on the network can send a packet: the page's link leads to
            // the sender itself.
            let view = seen.view_port.map(|port| SocketAddr::new(from.ip(), port));
            TagsSeen { view, ..seen }
        });
        let rotation = DQuat::from_array(packet.rotation_xyzw).normalize();
        let pose = (DVec3::from(packet.position_m), rotation);
        self.names.measure(vehicle, (stamp, now), pose, sigma);
        self.names.measured()
    }

    fn next_warning(&mut self) -> Option<String> {
        self.names.next_warning()
    }

    fn counters(&self, vehicle: usize) -> SourceCounters {
        let tags = self.tags.get(vehicle).copied().flatten();
        SourceCounters { tags, ..self.names.counters(vehicle) }
    }

    fn silence(&self) -> Silence {
        Silence {
            at_first: "start the program that sends pose packets, to this address",
            later: "does the program that sends pose packets still run?",
        }
    }
}

/// Which notes of senders people know already.
#[derive(Debug, Default)]
struct Notes {
    /// Without its numbers, and when it came last.
    told: VecDeque<(String, ServerTime)>,
    told_at: Option<ServerTime>,
}

impl Notes {
    /// Returns a note as it is to be shown, unless it was not long ago but for its numbers.
    fn news(&mut self, note: &str, now: ServerTime) -> Option<String> {
        let printable = note.chars().filter(|c| !c.is_control()).take(MAX_NOTE);
        let note: String = printable.collect();
        let stem: String = note.chars().filter(|c| !(c.is_ascii_digit() || *c == '.')).collect();
        if let Some((_, last)) = self.told.iter_mut().find(|(told, _)| *told == stem) {
            let is_known = now.seconds_since(*last) < FORGOTTEN_S;
            *last = now;
            if is_known {
                return None;
            }
        } else {
            // Whoever can send poses must not flood the page.
            if self.told_at.is_some_and(|at| now.seconds_since(at) < NOTES_APART_S) {
                return None;
            }
            if self.told.len() == MAX_NOTES {
                self.told.pop_front();
            }
            self.told.push_back((stem, now));
        }
        self.told_at = Some(now);
        Some(note)
    }
}

/// Longest note. [characters]
const MAX_NOTE: usize = 320;
/// So many are remembered.
const MAX_NOTES: usize = 16;
/// One that has not come for so long is news again. [s]
const FORGOTTEN_S: f64 = 30.0;
/// New ones are this far apart; others wait for a later packet. [s]
const NOTES_APART_S: f64 = 0.5;
/// The default sender.
const NOBODY: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::UNSPECIFIED), 0);
/// No lab is a thousand kilometres wide, not in millimetres either.
const MAX_VALUE: f64 = 1e9;
/// Two readings of one clock, rounded. [s]
const FUTURE_S: f64 = 0.001;
/// A pose that took longer is another clock's. [s]
const OLDEST_S: f64 = 2.0;

#[cfg(test)]
mod tests;
