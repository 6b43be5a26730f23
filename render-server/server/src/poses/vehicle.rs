//! Localization of one vehicle: newest pose, and IMU readings of the autopilot.

use std::collections::VecDeque;
use std::sync::Mutex;

use tokio::sync::watch;
use vizflyt_arena::pose::PoseQuality;
use vizflyt_protocol::messages::{ImuReading, PoseSample};

use super::newest::Localized;
use crate::poses::drivers::SourceCounters;
use vizflyt_process::lock;

#[derive(Debug)]
pub struct VehiclePose {
    /// Newest pose and motion; latest wins. This is the only copy.
    pub newest: watch::Sender<Option<Localized>>,
    /// Counters of the sources for this vehicle.
    pub counters: Mutex<SourceCounters>,
    /// Quality estimated by the pose filter.
    pub quality: Mutex<PoseQuality>,
    /// IMU readings that the pose thread has not processed yet, oldest first.
    imu: Mutex<VecDeque<ImuReading>>,
}

impl Default for VehiclePose {
    fn default() -> Self {
        Self {
            newest: watch::Sender::new(None),
            counters: Mutex::default(),
            quality: Mutex::default(),
            imu: Mutex::new(VecDeque::with_capacity(IMU_CAPACITY)),
        }
    }
}

impl VehiclePose {
    /// Returns the newest pose.
    pub fn sample(&self) -> Option<PoseSample> {
        self.newest.borrow().map(|localized| localized.sample)
    }

    /// Queues readings of the autopilot's IMU; when the queue is full, the oldest are dropped.
    pub fn push_imu(&self, readings: &[ImuReading]) {
        let mut queue = lock(&self.imu);
        for &reading in readings {
            if queue.len() == IMU_CAPACITY {
                queue.pop_front();
            }
            queue.push_back(reading);
        }
    }

    /// Removes the oldest reading of the IMU from the queue and returns it.
    pub fn pop_imu(&self) -> Option<ImuReading> {
        lock(&self.imu).pop_front()
    }
}

/// Capacity of the IMU queue: 0.6 s at 100 Hz.
const IMU_CAPACITY: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use vizflyt_protocol::time::ServerTime;

    #[test]
    fn a_full_imu_queue_keeps_the_newest_readings() {
        let vehicle = VehiclePose::default();
        let reading = |ns| ImuReading {
            stamp: ServerTime::from_ns(ns),
            accel_mps2: DVec3::Z,
            gyro_radps: DVec3::ZERO,
        };
        for ns in 0..100 {
            vehicle.push_imu(&[reading(2 * ns), reading(2 * ns + 1)]);
        }
        let queued: Vec<_> = std::iter::from_fn(|| vehicle.pop_imu()).collect();
        assert_eq!((queued.len(), queued[0].stamp.as_ns()), (IMU_CAPACITY, 200 - 64));
    }
}
