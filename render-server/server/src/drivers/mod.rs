//! Sources of poses. A driver owns its socket; the parser beside it is sans-IO.
//!
//! ```text
//! Vicon UDP -> vicon_udp (socket, arrival stamp) -> vicon (bytes -> objects -> our vehicles)
//!           -> frame_clock (stamp without the network's jitter) -> Measurements -> tick
//! ```
//! 100 to 300 Hz. The pose thread of [`crate::tick`] owns the driver and calls
//! [`PoseSource::receive`].

pub mod frame_clock;
pub mod vicon;
mod vicon_udp;

pub use vicon_udp::ViconUdp;

use std::time::Duration;

use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;

/// One raw pose of a vehicle, as its localization system gave it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measurement {
    /// Index of the vehicle.
    pub vehicle: usize,
    /// When the pose was true, as well as the source lets one tell.
    pub stamp: ServerTime,
    /// When it reached this computer.
    pub arrival: ServerTime,
    /// Where the vehicle was.
    pub world_from_body: Pose<World, Body>,
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
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
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
    /// Poses that the referee's gate did not believe; counted by the pose thread.
    pub rejected: u64,
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
        }
    }
}
