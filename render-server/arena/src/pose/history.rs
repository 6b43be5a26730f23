//! What the filter has taken in lately, in the order of stamps, so that a reading of the past can still be put where it
//! belongs.
//!
//! Putting a reading in costs next to nothing: what was known after it is forgotten. [`History::settle`] takes in again
//! what has no estimate, once for all the readings that came late since, and only when a pose is asked for.

use std::collections::VecDeque;

use glam::{DMat3, DQuat, DVec3};
use vizflyt_protocol::time::ServerTime;

use super::estimate::{Estimate, Manoeuvre};

/// One reading, with its covariance of that time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Input {
    /// An accepted pose, and how far what was known before it is to be inflated.
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

/// A reading and when it was made.
#[derive(Clone, Copy, Debug)]
pub(super) struct Record {
    pub stamp: ServerTime,
    pub input: Input,
    /// Whether it has been taken in before.
    pub is_known: bool,
}

/// The newest readings, oldest first, and what was known after each.
#[derive(Clone, Debug)]
pub(super) struct History {
    records: VecDeque<Record>,
    /// After each of the first of them. Where there is a record, there is the first's.
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
    /// Forgets all, and begins with a reading after which this is known.
    pub(super) fn begin(&mut self, stamp: ServerTime, input: Input, estimate: &Estimate) {
        self.records.clear();
        self.estimates.clear();
        self.records.push_back(Record { stamp, input, is_known: true });
        self.estimates.push_back(*estimate);
    }

    /// Returns the newest reading's time and what is known after it; of the last that was settled.
    pub(super) fn newest(&self) -> Option<(ServerTime, &Estimate)> {
        let estimate = self.estimates.back()?;
        Some((self.records.get(self.estimates.len() - 1)?.stamp, estimate))
    }

    /// Returns the same of the newest pose that was settled.
    pub(super) fn newest_pose(&self) -> Option<(ServerTime, &Estimate)> {
        let mut settled = self.records.iter().zip(&self.estimates).rev();
        let (record, estimate) =
            settled.find(|(record, _)| matches!(record.input, Input::Pose { .. }))?;
        Some((record.stamp, estimate))
    }

    /// Whether a reading of this time can still be put in.
    pub(super) fn reaches(&self, stamp: ServerTime) -> bool {
        self.records.front().is_some_and(|oldest| oldest.stamp <= stamp)
    }

    /// Returns what was known just before `stamp`, which the history must reach, by what came before it.
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

    /// Returns what would have been known just before `stamp`, up to which all is settled, had `change` come about at
    /// `since`.
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

    /// Changes what was known at `since`, and so all that is known after it.
    pub(super) fn change(&mut self, since: ServerTime, change: impl FnOnce(&mut Estimate)) {
        let first = self.place(since).max(1) - 1;
        self.estimates.truncate(first + 1);
        if let Some(estimate) = self.estimates.get_mut(first) {
            change(estimate);
        }
    }

    /// Puts a reading where it belongs, behind those of the same time; the history must reach there. What is known
    /// after it waits for [`Self::settle`].
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
        // Between the one that was forgotten just now and the next: nothing is known that it could follow.
        if place == 0 {
            return;
        }
        self.records.insert(place, Record { stamp, input, is_known: false });
        self.estimates.truncate(place);
    }

    /// Takes in again what is not settled.
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

    /// Returns where a reading of this time belongs. Most are among the newest.
    fn place(&self, stamp: ServerTime) -> usize {
        let later = self.records.iter().rev().take_while(|record| record.stamp > stamp).count();
        self.records.len() - later
    }
}

/// 0.4 s of mocap at 200 Hz and an IMU at 100 Hz; 0.3 MB for each vehicle.
const READINGS: usize = 128;
