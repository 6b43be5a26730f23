//! What a source of poses yields, and what it counts.

use std::net::SocketAddr;
use std::time::Duration;

use vizflyt_arena::pose::{Measured, PoseSigma};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;

/// One raw pose of a vehicle, as its localization system gave it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measurement {
    /// Index of the vehicle.
    pub vehicle: usize,
    /// Index of the source, in the order in which they were set up.
    pub source: u8,
    /// When the pose was true, as precisely as the source states it.
    pub stamp: ServerTime,
    /// When it reached this computer.
    pub arrival: ServerTime,
    /// Where the vehicle was.
    pub world_from_body: Pose<World, Body>,
    /// Its standard deviations, where the source states them.
    pub sigma: Option<PoseSigma>,
}

impl Measurement {
    /// Returns what the pose filter is to know of it.
    pub fn with_covariance(&self) -> Measured {
        let Self { source, stamp, arrival, world_from_body, sigma, .. } = *self;
        Measured { source, stamp, arrival, world_from_body, sigma }
    }
}

/// Yields poses; owns its I/O.
pub trait PoseSource: Send {
    /// Waits at most `timeout` for the next poses, which came together, at most one of each
    /// vehicle; none if none came.
    fn receive(&mut self, timeout: Duration) -> &[Measurement];

    /// Returns what a person should know by now, once per occurrence.
    fn next_warning(&mut self) -> Option<String>;

    /// Returns the counters of a vehicle, for the page and the report.
    fn counters(&self, vehicle: usize) -> SourceCounters;
}

/// What came in of one vehicle, since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct SourceCounters {
    /// Poses of the vehicle used.
    pub poses: u64,
    /// Packets that did not parse, of whatever vehicle.
    pub bad_packets: u64,
    /// Packets that came twice or out of order.
    pub stale_packets: u64,
    /// Frames that never came, by the frame counter.
    pub lost_frames: u64,
    /// Frames in which the vehicle was not seen.
    pub occluded: u64,
    /// Poses that the pose filter rejected; counted by the pose thread.
    pub rejected: u64,
    /// What the newest pose rests on, where it comes of tags.
    pub tags: Option<TagsSeen>,
}

/// What a pose rests on that comes of tags, as `vizflyt tags locate` says.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TagsSeen {
    /// How many; one in two cameras counts twice.
    pub tags: u32,
    /// In how many cameras.
    pub cameras: u32,
    /// Root mean square distance of corners from where the pose puts them. [px]
    pub rms_px: f32,
    /// Time to find them in an image. [ms]
    pub image_ms: f32,
    /// Port of the live view on the computer that sees them.
    #[serde(default, skip_serializing)]
    pub view_port: Option<u16>,
    /// Where the live view is.
    #[serde(skip_deserializing)]
    pub view: Option<SocketAddr>,
}

impl SourceCounters {
    /// Returns the counters of several vehicles of one source together.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            poses: self.poses + other.poses,
            // Counted once for all.
            bad_packets: self.bad_packets.max(other.bad_packets),
            stale_packets: self.stale_packets + other.stale_packets,
            lost_frames: self.lost_frames + other.lost_frames,
            occluded: self.occluded + other.occluded,
            rejected: self.rejected + other.rejected,
            tags: self.tags.or(other.tags),
        }
    }
}
