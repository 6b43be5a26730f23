//! Driver for VRPN 7, as streamed by Motive, Tracker and many others: poses of the named trackers from the
//! bytes of a server's TCP connection. Sans-IO; the connection itself is in [`connection`].
//!
//! ```text
//! both ways    24 bytes: "vrpn: ver. 07.35  0", zeros
//! server ->    messages, big-endian, each padded to a multiple of 8 bytes:
//!                u32 length without the padding, u32 s, u32 us, i32 sender, i32 type, 4 bytes, then the body
//!   type -1    name of a sender number: u32 length, the name, a zero
//!   type -2    name of a type number, in the same form
//!   the type "vrpn_Tracker Pos_Quat"
//!              i32 sensor, i32 again, f64 x, y, z, f64 qx, qy, qz, qw
//! ```
//! The client sends no requests: a server sends everything to each client. It uses UDP only toward a client
//! that names a port for it. This client names none, so every pose arrives over TCP, in order and without loss.
//!
//! Stamps are of the server's own clock, which [`super::sender_clock`] maps to ours.

pub mod connection;

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};
use vizflyt_protocol::time::ServerTime;

use super::sender_clock::SenderClock;
use super::source::{Measurement, SourceCounters};
use super::vehicle_names::{FrameOrder, MAX_NAMES, VehicleNames};
use crate::poses::settings::LocalizationConfig;

/// First bytes of both sides; the last two digits of the version may differ, and the last digit requests no
/// log.
pub const COOKIE: &[u8; 24] = b"vrpn: ver. 07.35  0\0\0\0\0\0";

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Message<'a> {
    /// Time of the contents; 0 if unknown. [ns, server's wall clock]
    pub stamp_ns: u64,
    /// Number of its sender, or of the described sender or type.
    pub sender: i32,
    /// Number of its type; types of the protocol itself are negative.
    pub kind: i32,
    pub body: &'a [u8],
}

/// Report of a tracker.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackerReport {
    /// Number of the tracker's sensor.
    pub sensor: i32,
    /// Position in the stream's unit.
    pub p_stream: DVec3,
    /// Rotation from the sensor's axes to the stream's, of unit length; `None` if the tracker did not see it
    /// (some servers then send zeros).
    pub rotation: Option<DQuat>,
}

/// Why data are invalid; after the first three the rest of the stream cannot be parsed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum VrpnError {
    /// The first bytes are not VRPN's.
    #[error("it does not begin as VRPN does")]
    Cookie,
    /// Unsupported version.
    #[error("it speaks VRPN {0}, this server knows 7")]
    Version(u8),
    /// Invalid length of a message.
    #[error("a message of {0} bytes is not VRPN")]
    Length(u32),
    /// Name longer than its message.
    #[error("a name of {length} bytes is in a message of {have}")]
    Name {
        /// Length according to the message.
        length: u32,
        /// Bytes of the message.
        have: usize,
    },
    /// Report of invalid size.
    #[error("a tracker's report of {0} bytes is shorter than 64")]
    Report(usize),
    /// Invalid numbers in a report.
    #[error("a tracker reports an invalid position or rotation")]
    NotAPose,
}

/// Checks the first bytes of a connection; returns whether they are complete.
///
/// # Errors
/// The data are not VRPN, or of another version.
pub fn check_cookie(bytes: &[u8]) -> Result<bool, VrpnError> {
    let known =
        bytes.iter().zip(COOKIE).take(FAMILY.len()).all(|(byte, expected)| byte == expected);
    if !known {
        return Err(VrpnError::Cookie);
    }
    // "07.": the digits before the point must match.
    let major = bytes.get(FAMILY.len()..FAMILY.len() + 3);
    match major {
        Some([b'0', b'7', b'.']) | None => Ok(bytes.len() >= COOKIE.len()),
        Some([tens @ b'0'..=b'9', ones @ b'0'..=b'9', b'.']) => {
            Err(VrpnError::Version((tens - b'0') * 10 + (ones - b'0')))
        }
        Some(_) => Err(VrpnError::Cookie),
    }
}

/// Returns the first message and its size in bytes; `None` if it is incomplete.
///
/// # Errors
/// The length is invalid.
pub fn parse(bytes: &[u8]) -> Result<Option<(Message<'_>, usize)>, VrpnError> {
    let Some(length) = bytes.first_chunk().map(|bytes| u32::from_be_bytes(*bytes)) else {
        return Ok(None);
    };
    let size = length as usize;
    if !(HEAD..=HEAD + MAX_BODY).contains(&size) {
        return Err(VrpnError::Length(length));
    }
    let filled = size.next_multiple_of(8);
    let Some(message) = bytes.get(..filled) else { return Ok(None) };
    let word =
        |index: usize| u32::from_be_bytes(std::array::from_fn(|byte| message[4 * index + byte]));
    let message = Message {
        stamp_ns: u64::from(word(1)) * 1_000_000_000 + u64::from(word(2)) * 1_000,
        sender: word(3).cast_signed(),
        kind: word(4).cast_signed(),
        body: &message[HEAD..size],
    };
    Ok(Some((message, filled)))
}

/// Returns the name in the body of a description.
fn parse_name(body: &[u8]) -> Result<&[u8], VrpnError> {
    let cut = |length| VrpnError::Name { length, have: body.len() };
    let (length, rest) = body.split_first_chunk().ok_or(cut(0))?;
    let length = u32::from_be_bytes(*length);
    let name =
        rest.get(..length as usize).filter(|name| name.len() <= MAX_NAME).ok_or(cut(length))?;
    Ok(name.split(|&byte| byte == 0).next().unwrap_or_default())
}

/// Parses the body of a tracker's report.
fn parse_report(body: &[u8]) -> Result<TrackerReport, VrpnError> {
    let Some((body, _)) = body.split_first_chunk::<REPORT>() else {
        return Err(VrpnError::Report(body.len()));
    };
    let (numbers, _) = body[8..].as_chunks();
    let mut values = [0.0f64; 7];
    for (value, bytes) in values.iter_mut().zip(numbers) {
        *value = f64::from_be_bytes(*bytes);
    }
    let [x, y, z, qx, qy, qz, qw] = values;
    let sensor = i32::from_be_bytes(std::array::from_fn(|byte| body[byte]));
    let (p_stream, rotation) = (DVec3::new(x, y, z), DQuat::from_xyzw(qx, qy, qz, qw));
    if !p_stream.abs().cmple(DVec3::splat(MAX_VALUE)).all() {
        return Err(VrpnError::NotAPose);
    }
    if rotation == DQuat::from_array([0.0; 4]) {
        return Ok(TrackerReport { sensor, p_stream, rotation: None });
    }
    // Tolerance: some trackers use single precision.
    if !((rotation.length() - 1.0).abs() <= 0.01) {
        return Err(VrpnError::NotAPose);
    }
    Ok(TrackerReport { sensor, p_stream, rotation: Some(rotation.normalize()) })
}

/// Driver for VRPN.
#[derive(Debug)]
pub struct VrpnStream {
    names: VehicleNames,
    sensor: i32,
    /// Tracks by vehicle.
    tracks: Vec<Track>,
    /// Received bytes that are not parsed yet, and time of the last arrival.
    unread: Vec<u8>,
    came: ServerTime,
    /// State of the present connection.
    session: Session,
}

/// Descriptions sent by the server, and reports of one connection.
#[derive(Debug, Default)]
struct Session {
    has_cookie: bool,
    /// Type number of trackers' reports.
    report_kind: Option<i32>,
    senders: BTreeMap<i32, Sender>,
    /// Times of the first and the newest report of any tracker.
    first_at: Option<ServerTime>,
    newest_at: Option<ServerTime>,
    has_looked_for_ours: bool,
}

/// Sender of one connection.
#[derive(Debug)]
struct Sender {
    name: String,
    vehicle: Option<usize>,
    /// Number of a sensor that it has reported.
    sensor: Option<i32>,
}

/// Reports of one vehicle's tracker. Each has its own clock, because a server may forward stamps of other
/// computers.
#[derive(Debug, Default)]
struct Track {
    clock: SenderClock,
    stamp_ns: Option<u64>,
    /// Number of reports with different stamps.
    number: u32,
    has_reported: bool,
}

impl VrpnStream {
    /// Creates a stream for the named vehicles; the first has index 0, and so on.
    pub fn new(config: &LocalizationConfig, source: u8, vehicles: &[&str]) -> Self {
        let names = VehicleNames::new(config, source, vehicles);
        Self {
            sensor: i32::from(config.sensor.unwrap_or(0)),
            tracks: (0..names.len()).map(|_| Track::default()).collect(),
            names,
            unread: Vec::new(),
            came: ServerTime::ZERO,
            session: Session::default(),
        }
    }

    /// Resets the state for a new connection; the server may have been restarted.
    pub fn begin_connection(&mut self) {
        self.unread.clear();
        self.session = Session::default();
        for track in &mut self.tracks {
            *track = Track { number: track.number, ..Track::default() };
        }
    }

    /// Adds bytes that arrived at `now`. [`Self::read`] must parse all of them before more are added.
    pub fn handle_bytes(&mut self, now: ServerTime, bytes: &[u8]) {
        self.came = now;
        self.unread.extend_from_slice(bytes);
    }

    /// Parses until each vehicle has a pose, or one of them would have a second. Returns whether there are
    /// poses, in [`Self::measured`]; if not, all received bytes are parsed.
    ///
    /// # Errors
    /// The data are not VRPN; the connection must be closed.
    pub fn read(&mut self) -> Result<bool, VrpnError> {
        self.names.begin();
        let unread = std::mem::take(&mut self.unread);
        let mut rest = unread.as_slice();
        let read = self.read_from(&mut rest);
        let at = unread.len() - rest.len();
        self.unread = unread;
        self.unread.drain(..at);
        read.map(|()| !self.names.measured().is_empty())
    }

    fn read_from(&mut self, rest: &mut &[u8]) -> Result<(), VrpnError> {
        if !self.session.has_cookie {
            if !check_cookie(rest)? {
                return Ok(());
            }
            self.session.has_cookie = true;
            *rest = &rest[COOKIE.len()..];
        }
        while let Some((message, size)) = parse(rest)? {
            if self.has_measured_of(&message) {
                return Ok(());
            }
            *rest = &rest[size..];
            if let Err(error) = self.handle_message(&message) {
                self.names.bad(&error, NOT_VRPN);
            }
        }
        Ok(())
    }

    /// Returns whether a message is of a tracker whose vehicle already has a pose in this round.
    fn has_measured_of(&self, message: &Message<'_>) -> bool {
        self.session.report_kind == Some(message.kind)
            && self.session.senders.get(&message.sender).is_some_and(|sender| {
                self.names.measured().iter().any(|pose| Some(pose.vehicle) == sender.vehicle)
            })
    }

    fn handle_message(&mut self, message: &Message<'_>) -> Result<(), VrpnError> {
        match message.kind {
            SENDER_DESCRIPTION => {
                let name = parse_name(message.body)?;
                let senders = &mut self.session.senders;
                if senders.len() < MAX_SENDERS || senders.contains_key(&message.sender) {
                    let vehicle = self.names.find(name);
                    let name = String::from_utf8_lossy(name).into_owned();
                    senders.insert(message.sender, Sender { name, vehicle, sensor: None });
                }
            }
            TYPE_DESCRIPTION => {
                let is_report = parse_name(message.body)? == REPORT_NAME;
                let report_kind = &mut self.session.report_kind;
                if is_report {
                    *report_kind = Some(message.sender);
                } else if *report_kind == Some(message.sender) {
                    *report_kind = None;
                }
            }
            kind if self.session.report_kind == Some(kind) => {
                let report = parse_report(message.body)?;
                self.session.newest_at = Some(self.came);
                self.session.first_at.get_or_insert(self.came);
                self.handle_report(message, &report);
                self.look_for_ours();
            }
            // Ignored: address for UDP, logs, replies, velocities, buttons.
            _ => {}
        }
        Ok(())
    }

    fn handle_report(&mut self, message: &Message<'_>, report: &TrackerReport) {
        let now = self.came;
        let Some(sender) = self.session.senders.get_mut(&message.sender) else { return };
        sender.sensor = Some(report.sensor);
        let Some(vehicle) = sender.vehicle.filter(|_| report.sensor == self.sensor) else { return };
        let track = &mut self.tracks[vehicle];
        track.has_reported = true;
        // A repeated stamp means a repeated report: some servers send their last report again.
        let stamp_ns = (message.stamp_ns > 0).then_some(message.stamp_ns);
        if stamp_ns.is_none() || track.stamp_ns != stamp_ns {
            track.number = track.number.wrapping_add(1);
        }
        track.stamp_ns = stamp_ns;
        if self.names.is_next(vehicle, track.number, now) == FrameOrder::Old {
            return;
        }
        let Some(rotation) = report.rotation else { return self.names.occluded(vehicle) };
        let stamp = stamp_ns.map_or(now, |stamp_ns| track.clock.map_in_order(stamp_ns, now));
        if let Some(jump_s) = track.clock.take_jump_s() {
            self.names.warn(format!(
                "vrpn: the clock that stamps '{}' has jumped by {jump_s:.3} s; was it set?",
                sender.name
            ));
        }
        self.names.measure(vehicle, (stamp, now), (report.p_stream, rotation), None);
    }

    /// Warns once about the available trackers, if none of the configured ones has reported after [`LOOK_S`].
    fn look_for_ours(&mut self) {
        let since = self.session.first_at.unwrap_or(self.came);
        if self.session.has_looked_for_ours || self.came.seconds_since(since) < LOOK_S {
            return;
        }
        self.session.has_looked_for_ours = true;
        if self.tracks.iter().any(|track| track.has_reported) {
            return;
        }
        let reporting = || self.session.senders.values().filter(|sender| sender.sensor.is_some());
        let ours = reporting().find(|sender| sender.vehicle.is_some());
        if let Some((name, sensor)) = ours.and_then(|ours| Some((&ours.name, ours.sensor?))) {
            let text = format!(
                "vrpn: '{name}' reports sensor {sensor}, but {} was asked for; set `sensor`",
                self.sensor
            );
            return self.names.warn(text);
        }
        let others = reporting().map(|sender| sender.name.as_str());
        self.names.others(others, RENAME);
    }

    /// Returns the poses that [`Self::read`] found, at most one per vehicle.
    pub fn measured(&self) -> &[Measurement] {
        self.names.measured()
    }

    /// Returns the number of bytes of an incomplete message: at most 64 KiB, once all is parsed.
    pub fn unread_bytes(&self) -> usize {
        self.unread.len()
    }

    /// Returns the time of the newest report on this connection, of any tracker.
    pub fn newest_at(&self) -> Option<ServerTime> {
        self.session.newest_at
    }

    /// Returns the senders of the present server for display; `None` before its first bytes.
    pub fn described(&self) -> Option<String> {
        if !self.session.has_cookie {
            return None;
        }
        let names = self
            .session
            .senders
            .values()
            .filter(|sender| !INTERNAL.iter().any(|own| sender.name.starts_with(own)));
        let names: Vec<_> =
            names.take(MAX_NAMES).map(|sender| format!("'{}'", sender.name)).collect();
        Some(if names.is_empty() { "nothing".to_owned() } else { names.join(", ") })
    }

    /// Returns the next warning for the user, once per occurrence.
    pub fn next_warning(&mut self) -> Option<String> {
        self.names.next_warning()
    }

    /// Counts data that are not VRPN.
    fn refuse(&mut self, error: VrpnError) {
        self.names.bad(&error, NOT_VRPN);
    }

    /// Returns the counters of a vehicle.
    pub fn counters(&self, vehicle: usize) -> SourceCounters {
        self.names.counters(vehicle)
    }
}

/// Default port of VRPN servers.
pub const PORT: u16 = 3883;
/// Common beginning of all versions.
const FAMILY: &[u8] = b"vrpn: ver. ";
const NOT_VRPN: &str = "is that address a VRPN server's?";
const RENAME: &str = "rename the object in the motion capture's program, or set `objects`";
const REPORT_NAME: &[u8] = b"vrpn_Tracker Pos_Quat";
/// Prefixes of VRPN's internal senders: "VRPN Control", "vrpn_Forwarder_Brain".
const INTERNAL: [&str; 2] = ["VRPN ", "vrpn_"];
const SENDER_DESCRIPTION: i32 = -1;
const TYPE_DESCRIPTION: i32 = -2;
/// Size of a message's head, with its padding.
const HEAD: usize = 24;
/// Size of a tracker's report.
const REPORT: usize = 64;
/// Maximum size of a body; a server's own buffer holds no larger message.
const MAX_BODY: usize = 64_000;
/// Maximum length of a name with its zero, by the protocol.
const MAX_NAME: usize = 100;
/// Maximum number of senders, by the protocol.
const MAX_SENDERS: usize = 2000;
/// Maximum coordinate: no lab is a thousand kilometres wide, even in millimetres.
const MAX_VALUE: f64 = 1e9;
/// Time after which every tracker of a server has reported. [s]
const LOOK_S: f64 = 1.0;

#[cfg(test)]
mod tests;
