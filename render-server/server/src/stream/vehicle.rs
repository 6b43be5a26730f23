//! Stream of one vehicle: quality level, delivery statistics and connection.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use tokio::sync::watch;
use vizflyt_protocol::messages::{CameraInfo, MAX_CAMERAS, Timing};
use vizflyt_protocol::packet::feed::FeedKey;
use vizflyt_protocol::time::ServerTime;

use super::connection::Connection;
use super::delivery::{CameraCounters, CameraDelivery, DeliveryStats};
use super::rate_control::{self, Level};
use crate::clock;
use vizflyt_process::lock;

/// The stream of one vehicle.
#[derive(Debug, Default)]
pub struct VehicleStream {
    /// Stages of the image age, from the runtime's newest report.
    pub timing: watch::Sender<Option<Timing>>,
    pub images: ImageCounters,
    /// Level that fits the runtime's link: number of a [`rate_control::level`].
    pub level: AtomicUsize,
    /// Time from the start of rendering until the plugin receives the image, from the runtime's newest report;
    /// 0 if unknown. [ns]
    seen_after_ns: AtomicU64,
    delivery: Mutex<DeliveryStats>,
    /// Session of the runtime, its connection, and its start.
    connection: Mutex<Option<(u64, quinn::Connection, ServerTime)>>,
    /// Key of the newest flight's pose feed; kept after the connection has ended.
    feed_key: Mutex<Option<FeedKey>>,
}

/// Image counters of a vehicle.
#[derive(Debug, Default)]
pub struct ImageCounters {
    /// Images that the runtime acknowledged.
    pub sent: AtomicU64,
    /// Images reset past their deadline or refused by the runtime.
    pub late: AtomicU64,
    /// Bytes of images acknowledged.
    pub bytes: AtomicU64,
    /// Delivery counters by camera.
    pub cameras: [CameraCounters; MAX_CAMERAS],
}

impl VehicleStream {
    /// Begins a flight: resets its statistics.
    pub fn begin_flight(&self) {
        self.timing.send_replace(None);
        lock(&self.delivery).begin(&self.images.cameras);
    }

    /// Returns the level at which images are made.
    pub fn level(&self) -> &'static Level {
        rate_control::level(self.level.load(Ordering::Relaxed))
    }

    /// Records the runtime's report of times.
    pub fn report_timing(&self, timing: Timing) {
        lock(&self.delivery).report(&timing.cameras);
        let seen = &timing.waterfall;
        let seen_after_ms = seen.age.p50 - seen.stages.pose.p50;
        if seen.images > 0 && seen_after_ms > 0.0 {
            self.seen_after_ns.store((f64::from(seen_after_ms) * 1e6) as u64, Ordering::Relaxed);
        }
        self.timing.send_replace(Some(timing));
    }

    /// Returns the time from the start of rendering until the plugin receives the image, from the runtime's
    /// newest report. [s]
    pub fn seen_after_s(&self) -> Option<f64> {
        let ns = self.seen_after_ns.load(Ordering::Relaxed);
        (ns > 0).then_some(ns as f64 * 1e-9)
    }

    /// Returns the delivery statistics of the present flight, by camera.
    pub fn deliveries(&self, cameras: &[CameraInfo]) -> Vec<CameraDelivery> {
        let delivery = lock(&self.delivery);
        let cameras = cameras.iter().zip(&self.images.cameras).enumerate();
        let of =
            |(index, (info, counters)): (usize, (&CameraInfo, &CameraCounters))| CameraDelivery {
                camera: info.name.as_str().to_owned(),
                account: delivery.account(index, counters),
            };
        cameras.map(of).collect()
    }

    /// Registers the connection of session `id` of the runtime, until the guard is dropped.
    pub fn connect(&self, id: u64, connection: &quinn::Connection) -> Connected<'_> {
        *lock(&self.connection) = Some((id, connection.clone(), clock::now()));
        Connected { stream: self, id }
    }

    /// Begins the pose feed of a flight.
    pub fn open_feed(&self, key: FeedKey) {
        *lock(&self.feed_key) = Some(key);
    }

    /// Returns the key of the newest flight's pose feed.
    pub fn feed_key(&self) -> Option<FeedKey> {
        *lock(&self.feed_key)
    }

    /// Returns the statistics of the runtime's connection, if there is one.
    pub fn connection(&self) -> Option<Connection> {
        let connection = lock(&self.connection);
        let (_, connection, since) = connection.as_ref()?;
        Some(Connection::of(connection, *since))
    }
}

/// Registration of a runtime's connection; removed when dropped.
#[derive(Debug)]
pub struct Connected<'a> {
    stream: &'a VehicleStream,
    id: u64,
}

impl Drop for Connected<'_> {
    fn drop(&mut self) {
        let mut connection = lock(&self.stream.connection);
        if connection.as_ref().is_some_and(|(id, ..)| *id == self.id) {
            *connection = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn image_delay_comes_from_the_runtimes_report() {
        let stream = VehicleStream::default();
        stream.report_timing(Timing::default());
        assert_eq!(stream.seen_after_s(), None, "no image yet");
        let mut timing = Timing::default();
        timing.waterfall.images = 9;
        timing.waterfall.age.p50 = 25.0;
        timing.waterfall.stages.pose.p50 = 5.0;
        stream.report_timing(timing);
        assert!((stream.seen_after_s().unwrap() - 0.02).abs() < 1e-9);
        stream.begin_flight();
        assert!(stream.timing.borrow().is_none());
    }
}
