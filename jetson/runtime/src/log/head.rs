//! What logs of any protocol from 6 on hold in the head of an observation: its layout has only grown at the end of each
//! camera since. Reads bytes at their places, as `ObservationHeader` refuses other versions.

use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::packet::{CameraHeader, ImuRecord, MAX_IMU};
use zerocopy::FromBytes;

/// The first protocol of this layout.
const FIRST: u32 = 6;
/// The first whose cameras have the body's pose behind what they had before.
const WITH_POSE: u32 = 12;
/// Where things are. [bytes]
const IMU_COUNT_AT: usize = 12;
const IMU_AT: usize = 152;
const CAMERAS_AT: usize = IMU_AT + MAX_IMU * size_of::<ImuRecord>();
const AHEAD_AT: usize = 172;
/// Of a camera before [`WITH_POSE`]. [bytes]
const OLD_CAMERA: usize = 176;

/// Returns when the newest pose behind camera `index`'s image was measured [ns, host], and by how much later the instant
/// is that it shows [ns]; `None` of a layout that is not known here.
pub(super) fn instants(head: &[u8], protocol: u32, index: usize) -> Option<(u64, i32)> {
    let stride = match protocol {
        FIRST..WITH_POSE => OLD_CAMERA,
        _ if protocol <= PROTOCOL_VERSION.into() && protocol >= WITH_POSE => {
            size_of::<CameraHeader>()
        }
        _ => return None,
    };
    let camera = head.get(CAMERAS_AT.checked_add(index.checked_mul(stride)?)?..)?;
    let pose_ns = u64::from_le_bytes(*camera.first_chunk()?);
    let ahead_ns = i32::from_le_bytes(*camera.get(AHEAD_AT..)?.first_chunk()?);
    Some((pose_ns, ahead_ns))
}

/// Returns the IMU samples of an observation, oldest first; none of a layout that is not known here, or that is cut.
pub(super) fn imu(head: &[u8], protocol: u32) -> impl Iterator<Item = ImuRecord> {
    let is_known = (FIRST..=PROTOCOL_VERSION.into()).contains(&protocol);
    let count = head.get(IMU_COUNT_AT..).and_then(<[u8]>::first_chunk);
    let count = count.map_or(0, |count| u32::from_le_bytes(*count) as usize);
    let samples = head.get(IMU_AT..).filter(|_| is_known).unwrap_or_default();
    samples
        .as_chunks::<{ size_of::<ImuRecord>() }>()
        .0
        .iter()
        .take(count.min(MAX_IMU))
        .filter_map(|bytes| ImuRecord::read_from_bytes(bytes).ok())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use vizflyt_protocol::packet::ObservationHeader;
    use zerocopy::IntoBytes;

    #[test]
    fn finds_what_the_header_of_this_version_has() {
        let mut header = ObservationHeader::new(1, 2, 0);
        (header.cameras[1].pose_ns, header.cameras[1].ahead_ns) = (77, -5);
        header.imu_count = 2;
        header.imu[1].stamp_ns = 9;
        let bytes = header.as_bytes();
        assert_eq!(instants(bytes, PROTOCOL_VERSION.into(), 1), Some((77, -5)));
        assert_eq!(instants(bytes, 99, 1), None);
        assert_eq!(instants(bytes, PROTOCOL_VERSION.into(), 8), None, "there is no such camera");
        let stamps: Vec<u64> = imu(bytes, 12).map(|sample| sample.stamp_ns).collect();
        assert_eq!(stamps, [0, 9]);
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_or_not(
            bytes in prop::collection::vec(any::<u8>(), 0..5000), protocol in 0u32..20, index: usize
        ) {
            let _ = instants(&bytes, protocol, index);
            prop_assert!(imu(&bytes, protocol).count() <= MAX_IMU);
        }
    }
}
