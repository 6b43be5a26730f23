//! What a plugin publishes beside its setpoints: its own estimate of where it is.

use std::sync::{Mutex, PoisonError};

use vizflyt_protocol::geometry::{Body, Odom, Pose};
use vizflyt_protocol::messages::{MAX_ODOMETRY_PER_REPLY, Odometry};
use vizflyt_protocol::time::HostTime;

/// Why an estimate is not published.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OdometryError {
    /// It is no pose.
    #[error(
        "the estimate is no pose: numbers must be finite, the quaternion (xyzw) of unit length, the place within 100 km"
    )]
    Invalid,
    /// There were too many since the last reply.
    #[error(
        "more than {MAX_ODOMETRY_PER_REPLY} estimates since the last reply; publish one for each image"
    )]
    TooMany,
}

/// What waits for the next reply.
static WAITING: Mutex<Vec<Odometry>> = Mutex::new(Vec::new());

/// Publishes where the plugin thinks the vehicle was at `stamp`; of an estimate from an image that is
/// [`CameraImage::shown`](crate::CameraImage::shown). It leaves with the reply to the image, is logged on `/odometry`,
/// and `vizflyt grade` reports how far off it was. Nothing is flown by it.
///
/// z of the frame `odom` is up; its origin and heading are the plugin's choice. Estimates are to come in the order of
/// their stamps; the runtime drops what is older than 10 s.
///
/// # Errors
/// [`OdometryError::Invalid`] for what is no pose, [`OdometryError::TooMany`] for more than four in one `on_image`.
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

/// Takes what was published since the last call: for main loops in other languages, which send it before the reply.
pub fn take_odometry() -> Vec<Odometry> {
    std::mem::take(&mut *WAITING.lock().unwrap_or_else(PoisonError::into_inner))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};

    #[test]
    fn estimates_wait_for_the_reply_and_nonsense_is_refused() {
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
