//! Recent readings of the filter in the order of their stamps, so that a late reading can be inserted at its
//! place.
//!
//! Inserting a reading is cheap: it discards the estimates after it. [`History::settle`] recomputes missing
//! estimates, once for all late readings, and only when a pose is requested.

use std::collections::VecDeque;

use glam::{DMat3, DQuat, DVec3};
use vizflyt_protocol::time::ServerTime;

use super::estimate::{Estimate, Manoeuvre};

/// A reading, with its covariance at that time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Input {
    /// An accepted pose, and the inflation of the covariance before it.
    Pose {
        p_world_m: DVec3,
        rotation: DQuat,
        variance_m2: DMat3,
        variance_rad2: DMat3,
        manoeuvre: Option<Manoeuvre>,
    },
    /// The autopilot's accelerometer and gyroscope.
    Imu { accel_mps2: DVec3, gyro_radps: DVec3 },
}

/// A reading and its stamp.
#[derive(Clone, Copy, Debug)]
pub(super) struct Record {
    pub stamp: ServerTime,
    pub input: Input,
    /// Whether it has been fused before.
    pub is_known: bool,
}

/// The newest readings, oldest first, and the estimate after each.
#[derive(Clone, Debug)]
pub(super) struct History {
    records: VecDeque<Record>,
    /// Estimates after the first records. If there is a record, there is an estimate after the first.
    estimates: VecDeque<Estimate>,
}

impl Default for History {
    fn default() -> Self {
        Self {
            records: VecDeque::with_capacity(READINGS),
            estimates: VecDeque::with_capacity(READINGS),
        }
    }
}

impl History {
    /// Clears the history, and starts with a reading and the estimate after it.
    pub(super) fn begin(&mut self, stamp: ServerTime, input: Input, estimate: &Estimate) {
        self.records.clear();
        self.estimates.clear();
        self.records.push_back(Record { stamp, input, is_known: true });
        self.estimates.push_back(*estimate);
    }

    /// Returns the time of the newest settled reading, and the estimate after it.
    pub(super) fn newest(&self) -> Option<(ServerTime, &Estimate)> {
        let estimate = self.estimates.back()?;
        Some((self.records.get(self.estimates.len() - 1)?.stamp, estimate))
    }

    /// Returns the time of the newest settled pose, and the estimate after it.
    pub(super) fn newest_pose(&self) -> Option<(ServerTime, &Estimate)> {
        let mut settled = self.records.iter().zip(&self.estimates).rev();
        let (record, estimate) =
            settled.find(|(record, _)| matches!(record.input, Input::Pose { .. }))?;
        Some((record.stamp, estimate))
    }

    /// Whether a reading of this time can still be inserted.
    pub(super) fn reaches(&self, stamp: ServerTime) -> bool {
        self.records.front().is_some_and(|oldest| oldest.stamp <= stamp)
    }

    /// Returns the estimate just before `stamp`, from all earlier readings. The history must reach that far.
    pub(super) fn at(
        &mut self,
        stamp: ServerTime,
        fuse: impl FnMut(&mut Estimate, &Record),
    ) -> Option<Estimate> {
        let place = self.place(stamp);
        self.settle_to(place, fuse);
        let index = place.checked_sub(1)?;
        let mut estimate = *self.estimates.get(index)?;
        estimate.advance(stamp.seconds_since(self.records.get(index)?.stamp));
        Some(estimate)
    }

    /// Returns the estimate just before `stamp` if `change` had been applied at `since`. All readings up to
    /// `stamp` must be settled.
    pub(super) fn at_after(
        &self,
        stamp: ServerTime,
        since: ServerTime,
        change: impl FnOnce(&mut Estimate),
        mut fuse: impl FnMut(&mut Estimate, &Record),
    ) -> Option<Estimate> {
        let first = self.place(since).max(1) - 1;
        let mut estimate = *self.estimates.get(first)?;
        change(&mut estimate);
        let mut newest = self.records.get(first)?.stamp;
        for record in self.records.range(first + 1..self.place(stamp).max(first + 1)) {
            estimate.advance(record.stamp.seconds_since(newest));
            newest = record.stamp;
            fuse(&mut estimate, record);
        }
        estimate.advance(stamp.seconds_since(newest));
        Some(estimate)
    }

    /// Applies `change` to the estimate at `since`, and discards all later estimates.
    pub(super) fn change(&mut self, since: ServerTime, change: impl FnOnce(&mut Estimate)) {
        let first = self.place(since).max(1) - 1;
        self.estimates.truncate(first + 1);
        if let Some(estimate) = self.estimates.get_mut(first) {
            change(estimate);
        }
    }

    /// Inserts a reading at its place, after those of the same time; the history must reach that far.
    /// [`Self::settle`] computes the estimates after it.
    pub(super) fn put(
        &mut self,
        stamp: ServerTime,
        input: Input,
        fuse: impl FnMut(&mut Estimate, &Record),
    ) {
        if self.records.len() == READINGS {
            self.settle_to(2, fuse);
            self.records.pop_front();
            self.estimates.pop_front();
        }
        let place = self.place(stamp);
        // The stamp is between the record that was dropped just above and the next: there is no estimate before
        // it.
        if place == 0 {
            return;
        }
        self.records.insert(place, Record { stamp, input, is_known: false });
        self.estimates.truncate(place);
    }

    /// Computes all missing estimates.
    pub(super) fn settle(&mut self, fuse: impl FnMut(&mut Estimate, &Record)) {
        self.settle_to(self.records.len(), fuse);
    }

    fn settle_to(&mut self, count: usize, mut fuse: impl FnMut(&mut Estimate, &Record)) {
        let first = self.estimates.len();
        let Some(newest) = self.estimates.back().filter(|_| first < count) else { return };
        let mut estimate = *newest;
        let mut stamp = self.records[first - 1].stamp;
        for record in self.records.range_mut(first..count) {
            estimate.advance(record.stamp.seconds_since(stamp));
            stamp = record.stamp;
            fuse(&mut estimate, record);
            record.is_known = true;
            self.estimates.push_back(estimate);
        }
    }

    /// Returns the index for a reading of this time. Most are among the newest.
    fn place(&self, stamp: ServerTime) -> usize {
        let later = self.records.iter().rev().take_while(|record| record.stamp > stamp).count();
        self.records.len() - later
    }
}

/// 0.4 s of mocap at 200 Hz and an IMU at 100 Hz; 0.3 MB per vehicle.
const READINGS: usize = 128;
