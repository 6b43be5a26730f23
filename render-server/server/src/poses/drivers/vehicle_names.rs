//! Common parts of all drivers: objects by vehicle, counters, conversion to the world frame, and warnings for
//! users. Sans-IO.

use std::collections::VecDeque;
use std::fmt::Display;
use std::net::SocketAddr;

use glam::{DMat3, DQuat, DVec3};
use vizflyt_arena::config::MAX_VEHICLES;
use vizflyt_arena::pose::{PoseSigma, Resolution};
use vizflyt_protocol::time::ServerTime;

use super::frame_clock::FrameClock;
use super::sender::{Heard, Sender};
use super::source::{Measurement, SourceCounters};
use crate::poses::settings::{Alignment, Driver, LocalizationConfig};

/// Objects and counters of one stream.
#[derive(Debug)]
pub(super) struct VehicleNames {
    driver: Driver,
    source: u8,
    alignment: Alignment,
    /// Constant delay of the source. [s]
    latency_s: f64,
    resolution: Resolution,
    objects: Vec<Object>,
    bad_packets: u64,
    /// Measurements of the newest packet.
    measured: Vec<Measurement>,
    warned_of_others: bool,
    warned_of_bad: bool,
    warned_of_far: bool,
    warnings: VecDeque<String>,
}

/// Object of one vehicle. Tracker counts the frames of all objects together, but if several simulators send to
/// one server, each has its own counter.
#[derive(Debug)]
struct Object {
    name: String,
    sender: Sender,
    clock: FrameClock,
    last_frame: Option<u32>,
    /// Time of the last frame, and mean interval. [s]
    last_at: ServerTime,
    interval_s: f64,
    /// Newest of the frames with lower numbers that rise again, and their count.
    fallen: Option<(u32, u32)>,
    /// Time since which the last frame has been repeated.
    stuck_since: Option<ServerTime>,
    warned_of_stuck: bool,
    counters: SourceCounters,
}

impl VehicleNames {
    /// Creates the table of the named vehicles, at most [`MAX_VEHICLES`]; the first has index 0, and so on. Its
    /// measurements are marked with `source`.
    pub(super) fn new(config: &LocalizationConfig, source: u8, vehicles: &[&str]) -> Self {
        let object = |vehicle: &&str| Object {
            name: config.object_of(vehicle).to_owned(),
            sender: Sender::default(),
            clock: FrameClock::default(),
            last_frame: None,
            last_at: ServerTime::ZERO,
            interval_s: 0.0,
            fallen: None,
            stuck_since: None,
            warned_of_stuck: false,
            counters: SourceCounters::default(),
        };
        Self {
            driver: config.driver,
            source,
            alignment: config.alignment(),
            latency_s: config.latency_ms * 1e-3,
            resolution: Resolution::default(),
            objects: vehicles.iter().take(MAX_VEHICLES).map(object).collect(),
            bad_packets: 0,
            measured: Vec::with_capacity(MAX_VEHICLES),
            warned_of_others: false,
            warned_of_bad: false,
            warned_of_far: false,
            warnings: VecDeque::new(),
        }
    }

    /// Sets the differences up to which two poses are equal; bit for bit by default.
    #[must_use]
    pub(super) fn with_resolution(self, resolution: Resolution) -> Self {
        Self { resolution, ..self }
    }

    /// Returns the vehicle of the object with this name.
    pub(super) fn find(&self, name: &[u8]) -> Option<usize> {
        self.objects.iter().position(|object| object.name.as_bytes() == name)
    }

    pub(super) fn len(&self) -> usize {
        self.objects.len()
    }

    /// Starts a packet: clears the measurements.
    pub(super) fn begin(&mut self) {
        self.measured.clear();
    }

    /// Returns the measurements of the packet.
    pub(super) fn measured(&self) -> &[Measurement] {
        &self.measured
    }

    /// Whether a packet without a pose may be of a vehicle: no other address has sent poses of it lately.
    pub(super) fn may_be_sender(&self, vehicle: usize, from: SocketAddr, now: ServerTime) -> bool {
        self.objects[vehicle].sender.may_be(from, now)
    }

    /// Processes the address of a packet with a pose of a vehicle. Returns whether the packet may be used: it is of
    /// the pinned sender, and no other sends poses of the vehicle.
    pub(super) fn is_from_sender(
        &mut self,
        vehicle: usize,
        from: SocketAddr,
        now: ServerTime,
    ) -> bool {
        let object = &mut self.objects[vehicle];
        let heard = object.sender.handle_packet(from, now);
        let (driver, name) = (self.driver, &object.name);
        let text = match heard {
            Heard::Pinned | Heard::TookOver(None) => return true,
            Heard::Other | Heard::Conflict(None) => return false,
            Heard::TookOver(Some(former)) => format!(
                "{driver}: poses of '{name}' now come from {from}, since {former} is silent (if this is one program, \
                 let it keep its port)"
            ),
            Heard::Conflict(Some(other)) => format!(
                "{driver}: {from} and {other} both send poses of '{name}'; none is used while both send: stop one of \
                 them"
            ),
        };
        self.warn(text);
        matches!(heard, Heard::TookOver(_))
    }

    /// Processes the frame number of a vehicle, and counts. Returns whether the frame is newer than the last
    /// one, or the first of a restarted sender.
    pub(super) fn is_next(&mut self, vehicle: usize, frame: u32, now: ServerTime) -> FrameOrder {
        let object = &mut self.objects[vehicle];
        let mut order = FrameOrder::Next;
        if let Some(last) = object.last_frame {
            let ahead = frame.wrapping_sub(last).cast_signed();
            if ahead == 0 {
                object.counters.stale_packets += 1;
                self.notice_stuck(vehicle, frame, now);
                return FrameOrder::Old;
            }
            if ahead < 0 && !object.is_restart(frame, now) {
                object.counters.stale_packets += 1;
                return FrameOrder::Old;
            }
            if (2..MAX_LOST_FRAMES).contains(&ahead) {
                object.counters.lost_frames += (ahead - 1) as u64;
            }
            if ahead < 0 {
                order = FrameOrder::Restarted;
                let (driver, name) = (self.driver, &object.name);
                let text = format!(
                    "{driver}: the sender of '{name}' was restarted: its frames begin again, at {frame} \
                     after {last}"
                );
                self.warn(text);
            }
        }
        let object = &mut self.objects[vehicle];
        object.accept_frame(frame, now);
        order
    }

    /// Warns if the same frame is repeated: the source is paused, or shows a still.
    fn notice_stuck(&mut self, vehicle: usize, frame: u32, now: ServerTime) {
        let object = &mut self.objects[vehicle];
        let since = *object.stuck_since.get_or_insert(now);
        if now.seconds_since(since) > STUCK_S
            && !std::mem::replace(&mut object.warned_of_stuck, true)
        {
            let (driver, name) = (self.driver, &object.name);
            self.warnings.push_back(format!(
                "{driver}: '{name}' streams frame {frame} again and again; the source is paused or \
                 plays nothing: set it to live"
            ));
        }
    }

    /// Returns the time of measurement of a frame without a stamp.
    pub(super) fn stamp(&mut self, vehicle: usize, frame: u32, arrival: ServerTime) -> ServerTime {
        self.objects[vehicle].clock.stamp(frame, arrival)
    }

    /// Counts a frame in which the vehicle was occluded.
    pub(super) fn occluded(&mut self, vehicle: usize) {
        self.objects[vehicle].counters.occluded += 1;
    }

    /// Adds a streamed pose: position and rotation of the object, with the position's sigma along the stream's
    /// axes and the rotation's sigma about the object's axes.
    pub(super) fn measure(
        &mut self,
        vehicle: usize,
        (stamp, arrival): (ServerTime, ServerTime),
        (p_stream, stream_from_object): (DVec3, DQuat),
        sigma: Option<PoseSigma>,
    ) {
        let alignment = &self.alignment;
        let world_from_body = alignment.world_from_body(p_stream, stream_from_object);
        let far_m = world_from_body.translation_m.abs().max_element();
        self.notice_far(vehicle, far_m);
        let alignment = &self.alignment;
        let sigma = sigma.map(|sigma| {
            let turn = DMat3::from_rotation_z(alignment.offset.yaw_deg.to_radians());
            PoseSigma {
                position_m: spread(
                    turn * alignment.axes.matrix(),
                    sigma.position_m * alignment.unit_m,
                ),
                rotation_rad: spread(alignment.body_from_object(), sigma.rotation_rad),
            }
        });
        self.objects[vehicle].counters.poses += 1;
        let (source, stamp) = (self.source, stamp.plus_seconds(-self.latency_s));
        self.measured.push(Measurement {
            vehicle,
            source,
            stamp,
            arrival,
            world_from_body,
            sigma,
            is_origin: p_stream == DVec3::ZERO,
            resolution: self.resolution,
        });
    }

    fn notice_far(&mut self, vehicle: usize, far_m: f64) {
        if far_m > FAR_M && !std::mem::replace(&mut self.warned_of_far, true) {
            let (driver, name) = (self.driver, &self.objects[vehicle].name);
            self.warnings.push_back(format!(
                "{driver}: '{name}' is {far_m:.0} m from the origin; no room is that large: are these \
                 millimetres? set `units` (vizflyt doctor localization finds which)"
            ));
        }
    }

    /// Counts a packet that does not parse; the first one is reported, with advice.
    pub(super) fn bad(&mut self, why: &dyn Display, advice: &str) {
        self.bad_packets += 1;
        if !std::mem::replace(&mut self.warned_of_bad, true) {
            let driver = self.driver;
            self.warnings.push_back(format!(
                "{driver}: {why}; {advice} (further bad packets are only counted)"
            ));
        }
    }

    /// Warns once that the stream contains only objects of no configured vehicle, unless one has been seen
    /// before.
    pub(super) fn others<'a>(&mut self, names: impl Iterator<Item = &'a str>, advice: &str) {
        if self.warned_of_others || self.objects.iter().any(|object| object.counters.poses > 0) {
            return;
        }
        self.warned_of_others = true;
        let quoted = |name: &str| format!("'{name}'");
        let others: Vec<_> = names.take(MAX_NAMES).map(quoted).collect();
        let ours: Vec<_> = self.objects.iter().map(|object| quoted(&object.name)).collect();
        let (driver, others, ours) = (self.driver, others.join(", "), ours.join(", "));
        self.warnings.push_back(format!(
            "{driver}: object {others} streams, but {ours} was asked for; {advice}"
        ));
    }

    /// Queues a warning for the user.
    pub(super) fn warn(&mut self, text: String) {
        // Limits the queue in case it is not read.
        if self.warnings.len() < MAX_WARNINGS {
            self.warnings.push_back(text);
        }
    }

    /// Returns the next warning for the user, once per occurrence.
    pub(super) fn next_warning(&mut self) -> Option<String> {
        self.warnings.pop_front()
    }

    /// Returns the counters of a vehicle.
    pub(super) fn counters(&self, vehicle: usize) -> SourceCounters {
        let own = self.objects.get(vehicle).map_or_else(SourceCounters::default, |o| o.counters);
        SourceCounters { bad_packets: self.bad_packets, ..own }
    }
}

impl Object {
    /// Returns whether a lower frame number comes from a restarted sender: after a silence, or if numbers rise
    /// again after the earlier frames have stopped. A reordered frame comes alone, and a replayed recording
    /// next to its live source finds no gap.
    fn is_restart(&mut self, frame: u32, now: ServerTime) -> bool {
        let silent_s = now.seconds_since(self.last_at);
        let count = match self.fallen {
            Some((newest, count)) if frame.wrapping_sub(newest).cast_signed() > 0 => count + 1,
            _ => 1,
        };
        self.fallen = Some((frame, count));
        silent_s > SILENT_S
            || count >= RISING_FRAMES
                && self.interval_s > 0.0
                && silent_s > SILENT_INTERVALS * self.interval_s
    }

    fn accept_frame(&mut self, frame: u32, now: ServerTime) {
        if self.last_frame.is_some() {
            let interval_s = now.seconds_since(self.last_at).min(SILENT_S);
            let share = if self.interval_s > 0.0 { INTERVAL_SHARE } else { 1.0 };
            self.interval_s += (interval_s - self.interval_s) * share;
        }
        (self.last_frame, self.last_at, self.fallen) = (Some(frame), now, None);
        (self.stuck_since, self.warned_of_stuck) = (None, false);
    }
}

/// Order of a frame among those of its object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FrameOrder {
    /// Newer than the last.
    Next,
    /// First frame of a restarted sender.
    Restarted,
    /// Duplicate or older; must not be used.
    Old,
}

/// Returns the standard deviations along other axes, for uncorrelated ones along the original axes.
fn spread(axes: DMat3, sigma: DVec3) -> DVec3 {
    let squared = sigma * sigma;
    let row = |index: usize| {
        let row = axes.row(index);
        (row * row).dot(squared).sqrt()
    };
    DVec3::new(row(0), row(1), row(2))
}

/// A larger gap means another counter instead of lost frames: ten seconds at 200 Hz.
const MAX_LOST_FRAMES: i32 = 2000;
/// A sender has restarted if this many frames rise after a fall, and the earlier frames have stopped for this
/// many intervals, or for this time [s].
const RISING_FRAMES: u32 = 3;
const SILENT_INTERVALS: f64 = 2.5;
const SILENT_S: f64 = 0.5;
/// Weight of a new interval in the mean.
const INTERVAL_SHARE: f64 = 0.1;
/// Maximum number of names in a warning.
pub(super) const MAX_NAMES: usize = 8;
/// Maximum number of queued warnings.
const MAX_WARNINGS: usize = 16;
/// Maximum plausible coordinate. [m]
const FAR_M: f64 = 100.0;
/// Time of repetition of a frame that counts as stuck. [s]
const STUCK_S: f64 = 1.0;

#[cfg(test)]
mod tests;
