//! VRPN 7, as Motive, Tracker and many others stream it: bytes of a server's TCP connection in, the poses of the
//! named trackers out. Sans-IO; the connection itself is [`connection`].
//!
//! ```text
//! both ways    24 bytes: "vrpn: ver. 07.35  0", zeros
//! server ->    messages, big-endian, each filled up to a multiple of 8 bytes:
//!                u32 length without the filling, u32 s, u32 us, i32 sender, i32 type, 4 bytes, then the body
//!   type -1    the sender of this number has this name: u32 length, the name, a zero
//!   type -2    the type of this number has this name, likewise
//!   the type "vrpn_Tracker Pos_Quat"
//!              i32 sensor, i32 again, f64 x, y, z, f64 qx, qy, qz, qw
//! ```
//! Nothing is asked for: a server sends all that it has to whoever connects. It uses UDP only toward a client that
//! names a port for it, and this one names none: every pose comes over TCP, in order and without loss.
//!
//! Stamps are of the server's own clock, which [`super::sender_clock`] relates to ours.

pub mod connection;

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};
use vizflyt_protocol::time::ServerTime;

use super::sender_clock::SenderClock;
use super::source::{Measurement, SourceCounters};
use super::vehicle_names::{FrameOrder, MAX_NAMES, VehicleNames};
use crate::poses::settings::LocalizationConfig;

/// What both ends begin with; the two digits at the end of the version may differ, the last digit asks for no log.
pub const COOKIE: &[u8; 24] = b"vrpn: ver. 07.35  0\0\0\0\0\0";

/// A message of the stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Message<'a> {
    /// When it was true; 0 if it does not say. [ns, server's wall clock]
    pub stamp_ns: u64,
    /// Number of its sender, or what it describes.
    pub sender: i32,
    /// Number of its type; those of the protocol itself are negative.
    pub kind: i32,
    /// What it says.
    pub body: &'a [u8],
}

/// A report of a tracker.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackerReport {
    /// Which of the tracker's sensors.
    pub sensor: i32,
    /// Where it is, in the stream's unit.
    pub p_stream: DVec3,
    /// Rotation of its axes into the stream's, of unit length; `None` if the tracker did not see it (some servers then
    /// send zeros).
    pub rotation: Option<DQuat>,
}

/// Why bytes are no VRPN; after the first three nothing that follows can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum VrpnError {
    /// It begins differently.
    #[error("it does not begin as VRPN does")]
    Cookie,
    /// Another version.
    #[error("it speaks VRPN {0}, this server knows 7")]
    Version(u8),
    /// A message of no such length.
    #[error("a message of {0} bytes is no VRPN")]
    Length(u32),
    /// A name that is not there.
    #[error("a name of {length} bytes is in a message of {have}")]
    Name {
        /// What the message says.
        length: u32,
        /// Bytes of the message.
        have: usize,
    },
    /// A report of another size.
    #[error("a tracker's report of {0} bytes is shorter than 64")]
    Report(usize),
    /// A report whose numbers are none.
    #[error("a tracker reports a position or rotation that is none")]
    NotAPose,
}

/// Checks the first bytes of a connection; returns whether they are all there.
///
/// # Errors
/// It is no VRPN, or another version.
pub fn check_cookie(bytes: &[u8]) -> Result<bool, VrpnError> {
    let known =
        bytes.iter().zip(COOKIE).take(FAMILY.len()).all(|(byte, expected)| byte == expected);
    if !known {
        return Err(VrpnError::Cookie);
    }
    // "07.": the digits before the point must be ours.
    let major = bytes.get(FAMILY.len()..FAMILY.len() + 3);
    match major {
        Some([b'0', b'7', b'.']) | None => Ok(bytes.len() >= COOKIE.len()),
        Some([tens @ b'0'..=b'9', ones @ b'0'..=b'9', b'.']) => {
            Err(VrpnError::Version((tens - b'0') * 10 + (ones - b'0')))
        }
        Some(_) => Err(VrpnError::Cookie),
    }
}

/// Returns the first message and how many bytes it takes; `None` if it is not there as a whole.
///
/// # Errors
/// It has a length that no message has.
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

/// Returns what the body of a tracker's report says.
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
    // Some trackers measure in single precision.
    if !((rotation.length() - 1.0).abs() <= 0.01) {
        return Err(VrpnError::NotAPose);
    }
    Ok(TrackerReport { sensor, p_stream, rotation: Some(rotation.normalize()) })
}

/// Selects our vehicles from what a server sends, keeps the counters, and notices what is wrong.
#[derive(Debug)]
pub struct VrpnStream {
    names: VehicleNames,
    sensor: i32,
    /// Of each vehicle.
    tracks: Vec<Track>,
    /// What came and is not read, and when its end came.
    unread: Vec<u8>,
    came: ServerTime,
    /// What the server has said of itself.
    session: Session,
}

/// What a server says at the beginning of a connection, and what was seen on it.
#[derive(Debug, Default)]
struct Session {
    has_cookie: bool,
    /// Number of the type of trackers' reports.
    report_kind: Option<i32>,
    senders: BTreeMap<i32, Sender>,
    /// When the first report came, of whatever tracker, and the newest.
    first_at: Option<ServerTime>,
    newest_at: Option<ServerTime>,
    has_looked_for_ours: bool,
}

/// Who sends, on one connection.
#[derive(Debug)]
struct Sender {
    name: String,
    vehicle: Option<usize>,
    /// A sensor of which it has reported.
    sensor: Option<i32>,
}

/// The reports of one vehicle's tracker. Each has a clock: a server may pass on what others have stamped.
#[derive(Debug, Default)]
struct Track {
    clock: SenderClock,
    stamp_ns: Option<u64>,
    /// Counts reports with stamps of their own.
    number: u32,
    has_reported: bool,
}

impl VrpnStream {
    /// Makes a stream that yields the poses of the vehicles named, the first at index 0, and so on.
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

    /// Forgets the last connection: another has begun, perhaps of a server that was restarted.
    pub fn begin_connection(&mut self) {
        self.unread.clear();
        self.session = Session::default();
        for track in &mut self.tracks {
            *track = Track { number: track.number, ..Track::default() };
        }
    }

    /// Takes bytes that arrived at `now`; [`Self::read`] is to read them all before more are given.
    pub fn handle_bytes(&mut self, now: ServerTime, bytes: &[u8]) {
        self.came = now;
        self.unread.extend_from_slice(bytes);
    }

    /// Reads on until it has a pose of each vehicle, or one of them has a second; returns whether there are any, in
    /// [`Self::measured`]. None: all has been read that came.
    ///
    /// # Errors
    /// What came is no VRPN, and the connection of no use any more.
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

    /// Whether a message is of a tracker that this round has yielded a pose of.
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
            // The address for UDP, logs, answers, velocities, buttons.
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
        // The same stamp again is the same report again, of a server that repeats what it has.
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

    /// Says once what reports instead, if nothing of ours has after a while.
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

    /// Returns the poses that [`Self::read`] found, at most one of each vehicle.
    pub fn measured(&self) -> &[Measurement] {
        self.names.measured()
    }

    /// Returns how many bytes wait for the rest of their message: at most 64 KiB, once all is read.
    pub fn unread_bytes(&self) -> usize {
        self.unread.len()
    }

    /// Returns when the newest report came on this connection, of whatever tracker.
    pub fn newest_at(&self) -> Option<ServerTime> {
        self.session.newest_at
    }

    /// Returns what the server of this connection has, for people; `None` if it has not even begun.
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

    /// Returns what a person should know by now, once per occurrence.
    pub fn next_warning(&mut self) -> Option<String> {
        self.names.next_warning()
    }

    /// Counts what is no VRPN.
    fn refuse(&mut self, error: VrpnError) {
        self.names.bad(&error, NOT_VRPN);
    }

    /// Returns the counters of a vehicle.
    pub fn counters(&self, vehicle: usize) -> SourceCounters {
        self.names.counters(vehicle)
    }
}

/// Where VRPN servers listen, unless someone changed it.
pub const PORT: u16 = 3883;
/// What every version's beginning has in common.
const FAMILY: &[u8] = b"vrpn: ver. ";
const NOT_VRPN: &str = "is that address a VRPN server's?";
const RENAME: &str = "rename the object in the motion capture's program, or set `objects`";
const REPORT_NAME: &[u8] = b"vrpn_Tracker Pos_Quat";
/// What the senders begin with that are VRPN's own: "VRPN Control", "vrpn_Forwarder_Brain".
const INTERNAL: [&str; 2] = ["VRPN ", "vrpn_"];
const SENDER_DESCRIPTION: i32 = -1;
const TYPE_DESCRIPTION: i32 = -2;
/// A message's head, with its filling.
const HEAD: usize = 24;
/// A tracker's report.
const REPORT: usize = 64;
/// A server's own buffer holds no larger message.
const MAX_BODY: usize = 64_000;
/// A name's length at most, with its zero, by the protocol.
const MAX_NAME: usize = 100;
/// Senders at most, by the protocol.
const MAX_SENDERS: usize = 2000;
/// No lab is a thousand kilometres wide, not in millimetres either.
const MAX_VALUE: f64 = 1e9;
/// After so long every tracker of a server has reported. [s]
const LOOK_S: f64 = 1.0;

#[cfg(test)]
mod tests;
