//! Vicon Tracker's UDP object stream: bytes in, the poses of the named objects out. Sans-IO.
//!
//! Layout (Tracker 3 user guide, "UDP object stream"; little-endian, packed):
//! ```text
//! u32 frame, u8 items, then per item:
//!   u8 id, u16 size, then `size` bytes; for id 0 (object) size is 72:
//!     char[24] name (NUL-padded), f64 x, y, z [mm], f64 rx, ry, rz [rad]
//! ```
//! Tracker pads packets to a block size: bytes after the last item are ignored. Items with
//! another id are skipped by their size.
//!
//! Rotation: turns about the fixed x, then the fixed y, then the fixed z axis,
//! `R = Rz(rz) * Ry(ry) * Rx(rx)`. To check it on site: tilt the object 30 degrees nose-up, turn it
//! by 90 degrees of yaw; the page must show the nose turned and the horizon tilted, not rolled.
//!
//! Stamps: the stream carries a frame counter but no time, and Tracker's clock is not ours. So a
//! pose is stamped with its arrival on CLOCK_MONOTONIC, less the jitter that the frame counter
//! reveals ([`super::frame_clock`]). The constant part of Tracker's own delay (a few ms) stays in.

use std::collections::BTreeSet;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::time::ServerTime;

use super::frame_clock::FrameClock;
use super::{Measurement, SourceCounters};
use crate::hub::MAX_VEHICLES;

/// One object of a packet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViconObject<'a> {
    /// Name, without the padding; Tracker writes ASCII, but any byte may come.
    pub name: &'a [u8],
    /// Where it is. [m, world]
    pub p_world_m: DVec3,
    /// Rotation of its axes into the world's, or `None` if Tracker did not see the object (it
    /// then sends zeros).
    pub rotation: Option<DQuat>,
}

/// Why bytes are no packet of the stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ViconError {
    /// Fewer bytes than the packet's head.
    #[error("packet of {0} bytes is shorter than its head of 5")]
    Short(usize),
    /// An item runs past the end.
    #[error("item {item} needs {need} bytes at offset {offset}, {have} are left")]
    Cut {
        /// Index of the item.
        item: u8,
        /// Where it begins.
        offset: usize,
        /// What it needs.
        need: usize,
        /// What is left.
        have: usize,
    },
    /// An object of a size this parser does not know.
    #[error("item {item} is an object of {size} bytes instead of 72")]
    Size {
        /// Index of the item.
        item: u8,
        /// Its stated size.
        size: u16,
    },
    /// A coordinate or an angle is not a sensible number.
    #[error("item {item} has a coordinate or angle that is not finite or absurdly large")]
    NotFinite {
        /// Index of the item.
        item: u8,
    },
}

/// Returns the frame number and gives every object of a packet to `visit`, in order.
pub fn parse<'a>(
    bytes: &'a [u8],
    mut visit: impl FnMut(ViconObject<'a>),
) -> Result<u32, ViconError> {
    let Some((head, _)) = bytes.split_first_chunk::<HEAD>() else {
        return Err(ViconError::Short(bytes.len()));
    };
    let frame = u32::from_le_bytes([head[0], head[1], head[2], head[3]]);
    let mut offset = HEAD;
    for item in 0..head[4] {
        let rest = &bytes[offset..];
        let cut = |need| ViconError::Cut { item, offset, need, have: rest.len() };
        let (item_head, body) = rest.split_first_chunk::<ITEM_HEAD>().ok_or(cut(ITEM_HEAD))?;
        let size = u16::from_le_bytes([item_head[1], item_head[2]]);
        let need = ITEM_HEAD + usize::from(size);
        let body = body.get(..usize::from(size)).ok_or(cut(need))?;
        offset += need;
        if item_head[0] == OBJECT_ID {
            let body: &[u8; OBJECT_SIZE] =
                body.try_into().map_err(|_| ViconError::Size { item, size })?;
            visit(object(body).ok_or(ViconError::NotFinite { item })?);
        }
    }
    Ok(frame)
}

fn object(body: &[u8; OBJECT_SIZE]) -> Option<ViconObject<'_>> {
    let (name, numbers) = body.split_at(NAME_SIZE);
    let name = &name[..name.iter().position(|&byte| byte == 0).unwrap_or(NAME_SIZE)];
    let mut values = [0.0f64; 6];
    for (value, bytes) in values.iter_mut().zip(numbers.chunks_exact(8)) {
        *value = f64::from_le_bytes(bytes.try_into().ok()?);
        if !(value.abs() <= MOST) {
            return None;
        }
    }
    let [x, y, z, rx, ry, rz] = values;
    let seen = values != [0.0; 6];
    let rotation =
        DQuat::from_rotation_z(rz) * DQuat::from_rotation_y(ry) * DQuat::from_rotation_x(rx);
    Some(ViconObject {
        name,
        p_world_m: DVec3::new(x, y, z) * 1e-3,
        rotation: seen.then_some(rotation.normalize()),
    })
}

/// Selects our vehicles from the stream, keeps the counters, and notices what is wrong.
#[derive(Debug)]
pub struct ViconStream {
    objects: Vec<Tracked>,
    bad_packets: u64,
    /// What the newest packet yielded.
    measured: Vec<Measurement>,
    others: BTreeSet<String>,
    warned_of_others: bool,
    warned_of_bad: bool,
    warnings: Vec<String>,
}

/// One vehicle's object. Tracker counts all objects' frames together, but several simulators that
/// send to one server each count their own.
#[derive(Debug)]
struct Tracked {
    name: String,
    clock: FrameClock,
    last_frame: Option<u32>,
    counters: SourceCounters,
}

impl ViconStream {
    /// Makes a stream that yields the poses of the objects named, the first at index 0, and so on;
    /// at most [`MAX_VEHICLES`].
    pub fn new(names: &[&str]) -> Self {
        let tracked = |name: &&str| Tracked {
            name: (*name).to_owned(),
            clock: FrameClock::default(),
            last_frame: None,
            counters: SourceCounters::default(),
        };
        Self {
            objects: names.iter().take(MAX_VEHICLES).map(tracked).collect(),
            bad_packets: 0,
            measured: Vec::with_capacity(MAX_VEHICLES),
            others: BTreeSet::new(),
            warned_of_others: false,
            warned_of_bad: false,
            warnings: Vec::new(),
        }
    }

    /// Takes one UDP packet that arrived at `now`; returns the poses of our vehicles that are in it
    /// and newer than the last.
    pub fn handle_packet(&mut self, now: ServerTime, bytes: &[u8]) -> &[Measurement] {
        self.measured.clear();
        let mut found = [None; MAX_VEHICLES];
        let mut other = None;
        let parsed = parse(bytes, |object| {
            let named = |tracked: &Tracked| tracked.name.as_bytes() == object.name;
            match self.objects.iter().position(named) {
                Some(vehicle) => found[vehicle] = Some(object),
                None => other = Some(object.name),
            }
        });
        let frame = match parsed {
            Ok(frame) => frame,
            Err(error) => {
                self.notice_bad(error);
                return &[];
            }
        };
        if found.iter().all(Option::is_none) {
            self.notice_other(other);
            return &[];
        }
        for (vehicle, (tracked, object)) in self.objects.iter_mut().zip(found).enumerate() {
            let Some(object) = object else { continue };
            if !tracked.is_next(frame) {
                continue;
            }
            let Some(rotation) = object.rotation else {
                tracked.counters.occluded += 1;
                continue;
            };
            tracked.counters.poses += 1;
            self.measured.push(Measurement {
                vehicle,
                stamp: tracked.clock.stamp(frame, now),
                arrival: now,
                world_from_body: Pose::new(object.p_world_m, rotation),
            });
        }
        &self.measured
    }

    fn notice_bad(&mut self, error: ViconError) {
        self.bad_packets += 1;
        if !std::mem::replace(&mut self.warned_of_bad, true) {
            self.warnings.push(format!(
                "vicon: {error}; is something other than Tracker's UDP object stream sent to this \
                 port? (further bad packets are only counted)"
            ));
        }
    }

    fn notice_other(&mut self, other: Option<&[u8]>) {
        let poses = self.objects.iter().any(|tracked| tracked.counters.poses > 0);
        if poses || self.warned_of_others {
            return;
        }
        let Some(name) = other else { return };
        self.warned_of_others = true;
        if self.others.len() < MOST_NAMES {
            self.others.insert(String::from_utf8_lossy(name).into_owned());
        }
        let quoted = |name: &String| format!("'{name}'");
        let others: Vec<_> = self.others.iter().map(quoted).collect();
        let ours: Vec<_> = self.objects.iter().map(|tracked| quoted(&tracked.name)).collect();
        self.warnings.push(format!(
            "vicon: object {} streams, but {} was asked for; rename the object in Tracker, or start \
             the server with --vehicle",
            others.join(", "),
            ours.join(", "),
        ));
    }

    /// Returns the next thing a person should know, each once.
    pub fn next_warning(&mut self) -> Option<String> {
        (!self.warnings.is_empty()).then(|| self.warnings.remove(0))
    }

    /// Returns the counters of a vehicle.
    pub fn counters(&self, vehicle: usize) -> SourceCounters {
        let own = self.objects.get(vehicle).map_or_else(SourceCounters::default, |t| t.counters);
        SourceCounters { bad_packets: self.bad_packets, ..own }
    }
}

impl Tracked {
    /// Takes the next frame's number; returns whether it is newer than the last, and counts.
    fn is_next(&mut self, frame: u32) -> bool {
        if let Some(last) = self.last_frame {
            let ahead = frame.wrapping_sub(last).cast_signed();
            // A counter that falls back by more than any reordering is Tracker restarted.
            if ahead <= 0 && ahead > -RESTART_FRAMES {
                self.counters.stale_packets += 1;
                return false;
            }
            if (2..RESTART_FRAMES).contains(&ahead) {
                self.counters.lost_frames += (ahead - 1) as u64;
            }
        }
        self.last_frame = Some(frame);
        true
    }
}

const HEAD: usize = 5;
const ITEM_HEAD: usize = 3;
const OBJECT_ID: u8 = 0;
const NAME_SIZE: usize = 24;
const OBJECT_SIZE: usize = 72;
/// No lab is a thousand kilometres wide [mm], and no angle has this many turns [rad].
const MOST: f64 = 1e9;
/// Ten seconds at 200 Hz: beyond any reordering on a LAN.
const RESTART_FRAMES: i32 = 2000;
/// Names remembered for the warning.
const MOST_NAMES: usize = 8;

#[cfg(test)]
mod tests;
