//! Measurements and counters of pose sources.

use std::net::SocketAddr;
use std::time::Duration;

use vizflyt_arena::pose::{Measured, PoseSigma, Resolution};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;

/// Raw pose of a vehicle from its localization system.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measurement {
    /// Index of the vehicle.
    pub vehicle: usize,
    /// Index of the source, in the order of configuration.
    pub source: u8,
    /// Time of the pose, as precisely as the source states it.
    pub stamp: ServerTime,
    /// Time of arrival at this computer.
    pub arrival: ServerTime,
    /// Pose of the vehicle.
    pub world_from_body: Pose<World, Body>,
    /// Standard deviations, if the source states them.
    pub sigma: Option<PoseSigma>,
    /// Whether the streamed position is exactly 0, 0, 0.
    pub is_origin: bool,
    /// Differences up to which two poses of the source are equal.
    pub resolution: Resolution,
}

impl Measurement {
    /// Returns the input for the pose filter.
    pub fn with_covariance(&self) -> Measured {
        let Self { source, stamp, arrival, world_from_body, sigma, is_origin, resolution, .. } =
            *self;
        Measured { source, stamp, arrival, world_from_body, sigma, is_origin, resolution }
    }
}

/// Source of poses; owns its I/O.
pub trait PoseSource: Send {
    /// Waits at most `timeout` for the next poses, at most one per vehicle. Empty if none arrived.
    fn receive(&mut self, timeout: Duration) -> &[Measurement];

    /// Returns the next warning for the user, once per occurrence.
    fn next_warning(&mut self) -> Option<String>;

    /// Returns the counters of a vehicle, for the page and the report.
    fn counters(&self, vehicle: usize) -> SourceCounters;
}

/// Counters of one vehicle since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct SourceCounters {
    /// Poses used.
    pub poses: u64,
    /// Packets that did not parse, of any vehicle.
    pub bad_packets: u64,
    /// Packets that arrived twice or out of order.
    pub stale_packets: u64,
    /// Missing frames, by the frame counter.
    pub lost_frames: u64,
    /// Frames in which the vehicle was not seen.
    pub occluded: u64,
    /// Poses that the pose filter rejected; counted by the pose thread.
    pub rejected: u64,
    /// Tags behind the newest pose, if it comes from tags.
    pub tags: Option<TagsSeen>,
}

/// Evidence of a pose from tags, as reported by `vizflyt tags locate`.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TagsSeen {
    /// Number of tags; a tag in two cameras counts twice.
    pub tags: u32,
    /// Number of cameras.
    pub cameras: u32,
    /// Root mean square reprojection error of the corners. [px]
    pub rms_px: f32,
    /// Detection time per image. [ms]
    pub image_ms: f32,
    /// Port of the live view on the sender's computer.
    #[serde(default, skip_serializing)]
    pub view_port: Option<u16>,
    /// Address of the live view.
    #[serde(skip_deserializing)]
    pub view: Option<SocketAddr>,
}

impl SourceCounters {
    /// Returns the combined counters of several vehicles of one source.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            poses: self.poses + other.poses,
            // The same for all vehicles.
            bad_packets: self.bad_packets.max(other.bad_packets),
            stale_packets: self.stale_packets + other.stale_packets,
            lost_frames: self.lost_frames + other.lost_frames,
            occluded: self.occluded + other.occluded,
            rejected: self.rejected + other.rejected,
            tags: self.tags.or(other.tags),
        }
    }
}
