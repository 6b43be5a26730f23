//! Conversions to Foxglove's schemas.

use foxglove::messages as fox;
use vizflyt_protocol::geometry::Pose;

/// Frame id of the body.
pub(super) const BODY: &str = "body";

/// Converts a time since 1970 [ns] to Foxglove's type.
pub(super) fn timestamp(at_ns: u64) -> fox::Timestamp {
    let (seconds, nanoseconds) = (at_ns / 1_000_000_000, at_ns % 1_000_000_000);
    fox::Timestamp::new(u32::try_from(seconds).unwrap_or(u32::MAX), nanoseconds as u32)
}

/// Returns position and orientation of a pose.
pub(super) fn parts<A, B>(pose: &Pose<A, B>) -> (fox::Vector3, fox::Quaternion) {
    let (p, q) = (pose.translation_m, pose.rotation);
    (fox::Vector3 { x: p.x, y: p.y, z: p.z }, fox::Quaternion { x: q.x, y: q.y, z: q.z, w: q.w })
}
