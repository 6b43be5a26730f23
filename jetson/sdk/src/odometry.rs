//! Odometry that a plugin publishes in addition to its setpoints.

use std::sync::{Mutex, PoisonError};

use vizflyt_protocol::geometry::{Body, Odom, Pose};
use vizflyt_protocol::messages::{MAX_ODOMETRY_PER_REPLY, Odometry};
use vizflyt_protocol::time::HostTime;

/// Why an estimate was rejected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OdometryError {
    /// The estimate is not a valid pose.
    #[error(
        "the estimate is not a valid pose: numbers must be finite, \
         the quaternion (xyzw) of unit length, the position within 100 km"
    )]
    Invalid,
    /// Too many estimates since the last reply.
    #[error(
        "more than {MAX_ODOMETRY_PER_REPLY} estimates since the last reply; publish one for each image"
    )]
    TooMany,
}

/// Estimates to be sent with the next reply.
static WAITING: Mutex<Vec<Odometry>> = Mutex::new(Vec::new());

/// Publishes the plugin's estimate of the vehicle's pose at `stamp`. For an estimate from an image, use
/// [`CameraImage::shown`](crate::CameraImage::shown) as the stamp. The estimate is sent with the reply to the image and
/// logged on `/odometry`, and `vizflyt grade` reports its error. It does not control the flight.
///
/// z of the frame `odom` is up; the plugin chooses its origin and heading. Publish estimates in the order of their
/// stamps; the runtime drops estimates older than 10 s.
///
/// # Errors
/// [`OdometryError::Invalid`] for an invalid pose, [`OdometryError::TooMany`] for more than four in one `on_image`.
///
/// ```
/// use vizflyt_sdk::{HostTime, Pose, publish_odometry};
/// publish_odometry(HostTime::from_ns(1), Pose::IDENTITY).unwrap();
/// ```
pub fn publish_odometry(
    stamp: HostTime,
    odom_from_body: Pose<Odom, Body>,
) -> Result<(), OdometryError> {
    let odometry = Odometry { stamp, odom_from_body };
    if !odometry.is_valid() {
        return Err(OdometryError::Invalid);
    }
    let mut waiting = WAITING.lock().unwrap_or_else(PoisonError::into_inner);
    if waiting.len() >= MAX_ODOMETRY_PER_REPLY {
        return Err(OdometryError::TooMany);
    }
    waiting.push(odometry);
    Ok(())
}

/// Takes the estimates published since the last call. For main loops in other languages, which send them before the
/// reply.
pub fn take_odometry() -> Vec<Odometry> {
    std::mem::take(&mut *WAITING.lock().unwrap_or_else(PoisonError::into_inner))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};

    #[test]
    fn queues_estimates_for_the_reply_and_rejects_invalid_ones() {
        let publish =
            |ns, p_m, rotation| publish_odometry(HostTime::from_ns(ns), Pose::new(p_m, rotation));
        for (p_m, rotation) in [
            (DVec3::new(f64::NAN, 0.0, 0.0), DQuat::IDENTITY),
            (DVec3::X * 1e6, DQuat::IDENTITY),
            (DVec3::ZERO, DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0)),
            (DVec3::ZERO, DQuat::from_xyzw(0.0, f64::INFINITY, 0.0, 1.0)),
        ] {
            assert_eq!(publish(1, p_m, rotation), Err(OdometryError::Invalid), "{p_m} {rotation}");
        }
        for ns in 1..=4 {
            publish(ns, DVec3::X, DQuat::IDENTITY).unwrap();
        }
        assert_eq!(publish(5, DVec3::X, DQuat::IDENTITY), Err(OdometryError::TooMany));
        let stamps: Vec<u64> = take_odometry().iter().map(|one| one.stamp.as_ns()).collect();
        assert_eq!(stamps, [1, 2, 3, 4]);
        assert!(take_odometry().is_empty());
    }
}
