//! Driver for Vicon Tracker's UDP object stream. Sans-IO.
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
//! Rotation, unless the setting `euler` overrides it: about the fixed x, then y, then z axis, `R = Rz(rz) *
//! Ry(ry) * Rx(rx)`. `vizflyt doctor localization` checks it on site.
//!
//! Stamps: the stream has a frame counter but no time, and Tracker's clock is independent. So the stamp is the
//! arrival on CLOCK_MONOTONIC, less the jitter that [`super::frame_clock`] determines from the frame counter.
//! The constant delay of Tracker (a few ms) remains.

use std::net::SocketAddr;

use glam::DVec3;
use vizflyt_arena::config::MAX_VEHICLES;
use vizflyt_protocol::time::ServerTime;

use super::source::{Measurement, SourceCounters};
use super::udp::{PoseStream, Silence};
use super::vehicle_names::{FrameOrder, MAX_NAMES, VehicleNames};
use crate::poses::settings::{Euler, LocalizationConfig};

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViconObject<'a> {
    /// Name without padding; Tracker writes ASCII, but any byte may occur.
    pub name: &'a [u8],
    /// Position in the stream's unit (Tracker uses millimetres).
    pub p_stream: DVec3,
    /// Angles about x, y and z; `None` if Tracker did not see the object (it then sends zeros). [rad]
    pub angles_rad: Option<DVec3>,
}

/// Why a packet is invalid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ViconError {
    /// Packet shorter than its head.
    #[error("packet of {0} bytes is shorter than its head of 5")]
    Short(usize),
    /// Item that exceeds the packet.
    #[error("item {item} needs {need} bytes at offset {offset}, {have} are left")]
    Cut {
        /// Index of the item.
        item: u8,
        /// Start of the item.
        offset: usize,
        /// Required bytes.
        need: usize,
        /// Remaining bytes.
        have: usize,
    },
    /// Object of unsupported size.
    #[error("item {item} is an object of {size} bytes instead of 72")]
    Size {
        /// Index of the item.
        item: u8,
        size: u16,
    },
    /// Coordinate or angle out of range.
    #[error("item {item} has a coordinate or angle that is not finite or absurdly large")]
    NotFinite {
        /// Index of the item.
        item: u8,
    },
}

/// Calls `visit` for every object of a packet, in order; returns the frame number.
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
        if !(value.abs() <= MAX_VALUE) {
            return None;
        }
    }
    let [x, y, z, rx, ry, rz] = values;
    let seen = values != [0.0; 6];
    Some(ViconObject {
        name,
        p_stream: DVec3::new(x, y, z),
        angles_rad: seen.then_some(DVec3::new(rx, ry, rz)),
    })
}

/// Driver for the Vicon stream.
#[derive(Debug)]
pub struct ViconStream {
    names: VehicleNames,
    euler: Euler,
}

impl ViconStream {
    /// Creates a stream for the named vehicles, at most [`MAX_VEHICLES`]; the first has index 0, and so on.
    pub fn new(config: &LocalizationConfig, source: u8, vehicles: &[&str]) -> Self {
        let names = VehicleNames::new(config, source, vehicles);
        Self { names, euler: config.euler.unwrap_or_default() }
    }
}

impl PoseStream for ViconStream {
    fn handle_packet_from(
        &mut self,
        now: ServerTime,
        from: SocketAddr,
        bytes: &[u8],
    ) -> &[Measurement] {
        self.names.begin();
        let mut found = [None; MAX_VEHICLES];
        let mut others = heapless::Vec::<_, MAX_NAMES>::new();
        let parsed = parse(bytes, |object| match self.names.find(object.name) {
            Some(vehicle) => found[vehicle] = Some(object),
            None => drop(others.push(object.name)),
        });
        let frame = match parsed {
            Ok(frame) => frame,
            Err(error) => {
                let advice =
                    "is something other than Tracker's UDP object stream sent to this port?";
                self.names.bad(&error, advice);
                return &[];
            }
        };
        if found.iter().all(Option::is_none) && !others.is_empty() {
            let names = others.iter().filter_map(|name| std::str::from_utf8(name).ok());
            self.names.others(names, "rename the object in Tracker, or set `objects`");
        }
        for (vehicle, object) in found.into_iter().enumerate() {
            let Some(object) = object else { continue };
            if !self.names.is_from_sender(vehicle, from, now)
                || self.names.is_next(vehicle, frame, now) == FrameOrder::Old
            {
                continue;
            }
            let Some(angles_rad) = object.angles_rad else {
                self.names.occluded(vehicle);
                continue;
            };
            let stamp = self.names.stamp(vehicle, frame, now);
            let pose = (object.p_stream, self.euler.rotation(angles_rad));
            self.names.measure(vehicle, (stamp, now), pose, None);
        }
        self.names.measured()
    }

    fn next_warning(&mut self) -> Option<String> {
        self.names.next_warning()
    }

    fn counters(&self, vehicle: usize) -> SourceCounters {
        self.names.counters(vehicle)
    }

    fn silence(&self) -> Silence {
        Silence {
            at_first: "in Tracker enable the UDP object stream to this computer and set it to Live",
            later: "set Tracker to Live, then retry",
        }
    }
}

const HEAD: usize = 5;
const ITEM_HEAD: usize = 3;
const OBJECT_ID: u8 = 0;
const NAME_SIZE: usize = 24;
const OBJECT_SIZE: usize = 72;
/// Maximum value: no lab is a thousand kilometres wide [mm], and no angle has this many turns [rad].
const MAX_VALUE: f64 = 1e9;

#[cfg(test)]
mod tests;
