//! VizFlyt's JSON pose packet: one JSON object per datagram, from any program. Sans-IO.
//!
//! ```json
//! {"vizflyt_pose": 1, "object": "vizflyt", "seq": 12, "stamp_ns": 123456789, "clock": "sender",
//!  "position_m": [1.0, 2.0, 0.5], "rotation_xyzw": [0, 0, 0, 1],
//!  "position_sigma_m": [0.002, 0.002, 0.004], "rotation_sigma_rad": [0.01, 0.01, 0.01]}
//! ```
//! `seq`, `stamp_ns`, `clock`, `tracked` and the sigmas are optional. `"tracked": false` marks a pose of an object
//! that the sender's system does not see. Stamps use CLOCK_MONOTONIC of this computer
//! (`"clock": "server"`), or any clock of the sender (`"sender"`, the default), which [`super::sender_clock`]
//! maps to the server's. Without a stamp, `seq` gives the rhythm. Without either, the arrival is the stamp.
//! `quality` is the evidence of `vizflyt tags locate`:
//! `{"tags": 3, "cameras": 2, "rms_px": 0.2, "image_ms": 1.4, "view_port": 8091}`. `notes` are sentences for
//! users, `["left camera moved by 2.4 cm: survey again"]`, repeated in each packet while they are true; the page
//! shows each once. Other keys of the object are ignored.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::net::SocketAddr;

use glam::{DQuat, DVec3};
use serde::Deserialize;
use vizflyt_arena::pose::PoseSigma;
use vizflyt_protocol::time::ServerTime;

use super::sender_clock::{SenderClock, unit_name};
use super::source::{Measurement, SourceCounters, TagsSeen};
use super::udp::{PoseStream, Silence};
use super::vehicle_names::{FrameOrder, VehicleNames};
use crate::poses::settings::LocalizationConfig;

/// Pose packet as received.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct PosePacket<'a> {
    /// Version: 1.
    vizflyt_pose: u32,
    /// Name of the object.
    #[serde(borrow)]
    pub object: Cow<'a, str>,
    /// Counter of this object's packets.
    #[serde(default)]
    pub seq: Option<u64>,
    /// Time of measurement. [ns, clock]
    #[serde(default, deserialize_with = "whole_ns")]
    pub stamp_ns: Option<u64>,
    /// Clock of `stamp_ns`.
    #[serde(default)]
    pub clock: StampClock,
    /// Whether the sender's system sees the object; otherwise the pose is not used.
    #[serde(default = "is_tracked")]
    pub tracked: bool,
    /// Position of the object. [m, world]
    pub position_m: [f64; 3],
    /// Rotation from the object's axes to the world's.
    pub rotation_xyzw: [f64; 4],
    /// Standard deviation of the position. [m, world]
    #[serde(default)]
    pub position_sigma_m: Option<[f64; 3]>,
    /// Standard deviation of the rotation. [rad, body]
    #[serde(default)]
    pub rotation_sigma_rad: Option<[f64; 3]>,
    /// Tags behind the pose, if it comes from tags.
    #[serde(default, deserialize_with = "tags_if_any")]
    pub quality: Option<TagsSeen>,
    /// Messages of the sender for users.
    #[serde(borrow, default)]
    pub notes: Vec<Cow<'a, str>>,
}

fn is_tracked() -> bool {
    true
}

/// Reads a whole number of nanoseconds; the error names the unit of any other number by its magnitude.
fn whole_ns<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Option<u64>, D::Error> {
    let Some(number) = Option::<serde_json::Number>::deserialize(deserializer)? else {
        return Ok(None);
    };
    if let Some(ns) = number.as_u64() {
        return Ok(Some(ns));
    }
    let unit = match number.as_f64().unwrap_or(f64::NAN).abs() {
        ..1e11 => "seconds",
        ..1e14 => "milliseconds",
        ..1e17 => "microseconds",
        _ => "nanoseconds with a point",
    };
    Err(serde::de::Error::custom(format!(
        "stamp_ns is {number}, which looks like {unit}; give whole nanoseconds, in Python time.monotonic_ns()"
    )))
}

/// Reads the `quality` of `vizflyt tags locate`; other contents of `quality` are ignored.
fn tags_if_any<'de, D: serde::Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<TagsSeen>, D::Error> {
    let value = serde_json::Value::deserialize(deserializer)?;
    Ok(TagsSeen::deserialize(value).ok())
}

/// Clock of a stamp.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StampClock {
    /// CLOCK_MONOTONIC of the render server's computer.
    Server,
    /// Any other clock of the sender.
    #[default]
    Sender,
}

/// Why a packet is invalid.
#[derive(Debug, thiserror::Error)]
pub enum JsonError {
    /// Not a valid JSON object of this format.
    #[error("packet of {length} bytes is not a pose packet: {error}")]
    Json {
        /// Length of the packet.
        length: usize,
        /// Error of the JSON parser.
        error: serde_json::Error,
    },
    /// Unsupported version.
    #[error("vizflyt_pose is {0}, this server knows 1; send \"vizflyt_pose\": 1")]
    Version(u32),
    /// Position out of range.
    #[error("position_m {0:?} is absurdly large; send metres")]
    Position([f64; 3]),
    /// Quaternion without unit length.
    #[error(
        "rotation_xyzw {0:?} is not of unit length; send a unit quaternion in the order x, y, z, w"
    )]
    Rotation([f64; 4]),
    /// Invalid sigmas.
    #[error("{key} {value:?}: give positive numbers")]
    Sigma {
        /// The key.
        key: &'static str,
        /// Value of the key.
        value: [f64; 3],
    },
}

impl<'a> PosePacket<'a> {
    /// Parses a packet and checks its numbers.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, JsonError> {
        let packet: Self = serde_json::from_slice(bytes)
            .map_err(|error| JsonError::Json { length: bytes.len(), error })?;
        if packet.vizflyt_pose != 1 {
            return Err(JsonError::Version(packet.vizflyt_pose));
        }
        // JSON has no NaN, but numbers may overflow.
        if !packet.position_m.iter().all(|value| value.abs() <= MAX_VALUE) {
            return Err(JsonError::Position(packet.position_m));
        }
        let length = DQuat::from_array(packet.rotation_xyzw).length();
        // Tolerance: a quaternion written with three digits is accepted.
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

/// Driver for JSON packets.
#[derive(Debug)]
pub struct JsonStream {
    names: VehicleNames,
    /// Clocks by vehicle: packets may come from different programs.
    clocks: Vec<SenderClock>,
    /// Tags behind the newest pose of each vehicle.
    tags: Vec<Option<TagsSeen>>,
    notes: Notes,
    warned_of_clock: bool,
}

impl JsonStream {
    /// Creates a stream for the named vehicles; the first has index 0, and so on.
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
                    if let Some(unit) = unit_of_clock(stamp_ns, now) {
                        self.names.warn(wrong_unit(&packet.object, stamp_ns, unit));
                        return now;
                    }
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
                if let Some(unit) = clock.take_unit(1e-9) {
                    self.names.warn(wrong_unit(&packet.object, stamp_ns, unit));
                } else if let Some(jump_s) = clock.take_jump_s() {
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
        if !self.names.is_from_sender(vehicle, from, now) {
            return &[];
        }
        for note in &packet.notes {
            if let Some(note) = self.notes.news(note, now) {
                self.names.warn(format!("{}: {note}", packet.object));
            }
        }
        let order = packet.seq.map(|seq| self.names.is_next(vehicle, seq as u32, now));
        match order {
            Some(FrameOrder::Old) => return &[],
            // The sender's clock may also have restarted.
            Some(FrameOrder::Restarted) => self.clocks[vehicle] = SenderClock::default(),
            Some(FrameOrder::Next) | None => {}
        }
        if !packet.tracked {
            self.names.occluded(vehicle);
            return &[];
        }
        let stamp = self.stamp(vehicle, &packet, now);
        let sigma = packet
            .position_sigma_m
            .zip(packet.rotation_sigma_rad)
            .map(|(p, r)| PoseSigma { position_m: p.into(), rotation_rad: r.into() });
        self.tags[vehicle] = packet.quality.map(|seen| {
            // The packet contains only a port, because any computer on the network can send a packet: the
            // page's link leads to the sender itself.
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

fn wrong_unit(object: &str, stamp_ns: u64, unit: &str) -> String {
    format!(
        "json: stamp_ns of '{object}' is in {unit} ({stamp_ns}): give nanoseconds, in Python time.monotonic_ns(); till \
         then poses are stamped as they come"
    )
}

/// Returns the unit in which a number is the time `now`, if it is coarser than nanoseconds.
fn unit_of_clock(stamp: u64, now: ServerTime) -> Option<&'static str> {
    [(1e-6, 1e3), (1e-3, 1e6), (1.0, 1e9)].into_iter().find_map(|(unit_s, ns)| {
        let age_s = (now.as_ns() as f64 - stamp as f64 * ns) * 1e-9;
        (stamp > 0 && age_s.abs() < OLDEST_S).then(|| unit_name(unit_s))?
    })
}

/// Notes of senders that were shown recently.
#[derive(Debug, Default)]
struct Notes {
    /// Text without digits, and time of the last arrival.
    told: VecDeque<(String, ServerTime)>,
    told_at: Option<ServerTime>,
}

impl Notes {
    /// Returns the text to show; `None` if the same note, apart from its numbers, was shown recently.
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
            // Limits the rate, so that a sender cannot flood the page.
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

/// Maximum length of a note. [characters]
const MAX_NOTE: usize = 320;
/// Maximum number of stored notes.
const MAX_NOTES: usize = 16;
/// A note that has not arrived for this long is shown again. [s]
const FORGOTTEN_S: f64 = 30.0;
/// Minimum time between new notes; others wait for a later packet. [s]
const NOTES_APART_S: f64 = 0.5;
/// Maximum coordinate: no lab is a thousand kilometres wide, even in millimetres.
const MAX_VALUE: f64 = 1e9;
/// Tolerance for two readings of one clock, rounded. [s]
const FUTURE_S: f64 = 0.001;
/// Maximum age of a pose; an older stamp is of another clock. [s]
const OLDEST_S: f64 = 2.0;

#[cfg(test)]
mod tests;
