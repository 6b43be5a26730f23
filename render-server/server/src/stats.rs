//! What the server measures of itself: time per stage, counts, peak memory.
//!
//! Stages bear the names of the tracing spans: `pose render encode send`. Each thread adds to its
//! own [`StageDurations`]; the page reads the recent past, the report the whole run. These are the times that
//! the server *works*; what a stage adds to an image's age the runtime reports
//! ([`vizflyt_protocol::messages::Timing`]), and [`VehicleStats`] has both.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use serde::{Deserialize, Serialize};
use vizflyt_arena::pose::PoseQuality;
use vizflyt_protocol::histogram::Histogram;
use vizflyt_protocol::messages::{StageTimes, Timing};
use vizflyt_protocol::time::ServerTime;

use crate::clock;
use crate::flights::vehicle::{ImageCounters, Vehicle};
use crate::hub::{Hub, RendererInfo};
use crate::lock::lock;
use crate::poses::drivers::SourceCounters;
use crate::stream::delivery::Delivery;

/// Everything measured; shared by all threads.
#[derive(Debug, Default)]
pub struct Stats {
    /// Arrival of a pose to the end of gate and referee.
    pub pose: StageDurations,
    /// Drawing all cameras of a tick.
    pub render: StageDurations,
    /// Quantising and encoding one camera's image.
    pub encode: StageDurations,
    /// Handing an image to the transport until the runtime has acknowledged all of it.
    pub send: StageDurations,
    /// Ticks rendered.
    pub ticks: AtomicU64,
    /// Ticks rendered that no one took before the next.
    pub ticks_skipped: AtomicU64,
}

/// Durations of one stage.
#[derive(Debug)]
pub struct StageDurations(Mutex<Samples>);

#[derive(Debug)]
struct Samples {
    recent: [f32; RECENT],
    next: usize,
    /// Of the whole run.
    overall: Box<Histogram>,
}

impl Default for StageDurations {
    fn default() -> Self {
        Self(Mutex::new(Samples { recent: [0.0; RECENT], next: 0, overall: Box::default() }))
    }
}

impl StageDurations {
    /// Adds a duration. [ms]
    pub fn add_ms(&self, ms: f64) {
        let mut samples = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let next = samples.next;
        samples.recent[next] = ms as f32;
        samples.next = (next + 1) % RECENT;
        samples.overall.add(ms);
    }

    /// Adds the time from `start` to `end`.
    pub fn add(&self, start: ServerTime, end: ServerTime) {
        self.add_ms(end.seconds_since(start) * 1e3);
    }

    /// Returns percentiles of the newest samples, a few seconds' worth.
    pub fn recent(&self) -> StageTimes {
        let (mut values, count) = {
            let samples = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            (samples.recent, samples.overall.count().min(RECENT as u64) as usize)
        };
        let values = &mut values[..count];
        values.sort_unstable_by(f32::total_cmp);
        let at = |share: f64| {
            let index = (share * (count as f64 - 1.0)).round().max(0.0) as usize;
            values.get(index).copied().unwrap_or(0.0)
        };
        StageTimes { p50: at(0.5), p90: at(0.9), p99: at(0.99), max: at(1.0) }
    }

    /// Returns percentiles of the whole run, to within 1.6 %.
    pub fn overall(&self) -> StageTimes {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).overall.times()
    }
}

/// Counts a rate over the last second. [Hz]
#[derive(Debug, Default)]
pub struct Rate(Mutex<Option<(ServerTime, u64, f64)>>);

impl Rate {
    /// Takes a running total at `now`; returns its rate, renewed twice a second. [1/s]
    pub fn of(&self, total: u64, now: ServerTime) -> f64 {
        let mut state = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (since, then, rate) = *state.get_or_insert((now, total, 0.0));
        let seconds = now.seconds_since(since);
        if !(seconds >= 0.5) {
            return rate;
        }
        let rate = total.saturating_sub(then) as f64 / seconds;
        *state = Some((now, total, rate));
        rate
    }
}

/// Everything known of one vehicle's images, as `GET /api/stats` tells it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VehicleStats {
    /// Whose.
    pub vehicle: String,
    /// The runtime that flies it, and where it is; absent if there is none.
    pub runtime: Option<String>,
    /// What the server's own stages take, of all vehicles. [ms]
    pub server: ServerStages,
    /// Where images get their age, by the runtime's newest report.
    pub timing: Option<Timing>,
    /// What became of them in this flight, by camera.
    pub images: Vec<CameraDelivery>,
    /// How the connection fares.
    pub connection: Option<Connection>,
    /// How good the localization is.
    pub pose: PoseQuality,
}

/// Percentiles of the server's own stages. [ms]
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ServerStages {
    /// Arrival of a pose to the end of gate and referee.
    pub pose: StageTimes,
    /// Drawing all cameras of a tick.
    pub render: StageTimes,
    /// Quantising and encoding one image.
    pub encode: StageTimes,
    /// Handing an image over until the runtime has acknowledged all of it.
    pub send: StageTimes,
}

/// The account of one camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraDelivery {
    /// Its name.
    pub camera: String,
    /// What became of its images.
    #[serde(flatten)]
    pub account: Delivery,
}

/// How a runtime's connection fares, from its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Connection {
    /// Round trip, smoothed. [ms]
    pub rtt_ms: f64,
    /// Bytes that may be unacknowledged. [bytes]
    pub window: u64,
    /// Largest packet. [bytes]
    pub mtu: u16,
    /// Packets sent.
    pub packets_sent: u64,
    /// Packets lost on the way; what they held was sent again.
    pub packets_lost: u64,
    /// Times that the congestion controller was told of congestion.
    pub congestion_events: u64,
    /// Bytes sent on the network, everything included. [bytes]
    pub bytes_sent: u64,
    /// How long it has lasted. [s]
    pub seconds: f64,
    /// Sent on average since it began. [Mbit/s]
    pub mbit_s: f64,
}

impl Connection {
    /// Returns how a connection that began at `since` fares.
    pub fn of(connection: &quinn::Connection, since: ServerTime) -> Self {
        let stats = connection.stats();
        let seconds = clock::now().seconds_since(since);
        let bytes_sent = stats.udp_tx.bytes;
        Self {
            rtt_ms: stats.path.rtt.as_secs_f64() * 1e3,
            window: stats.path.cwnd,
            mtu: stats.path.current_mtu,
            packets_sent: stats.path.sent_packets,
            packets_lost: stats.path.lost_packets,
            congestion_events: stats.path.congestion_events,
            bytes_sent,
            seconds,
            mbit_s: bytes_sent as f64 * 8e-6 / seconds.max(1e-3),
        }
    }
}

impl VehicleStats {
    /// Returns the figures of `vehicle` at this moment.
    pub fn of(hub: &Hub, vehicle: &Vehicle) -> Self {
        let runtime = vehicle.runtime();
        let stats = &hub.stats;
        Self {
            vehicle: vehicle.name.as_str().to_owned(),
            runtime: runtime.map(|runtime| format!("{} at {}", runtime.program, runtime.address)),
            server: ServerStages {
                pose: stats.pose.recent(),
                render: stats.render.recent(),
                encode: stats.encode.recent(),
                send: stats.send.recent(),
            },
            timing: vehicle.timing.borrow().clone(),
            images: vehicle.accounts(),
            connection: vehicle.connection(),
            pose: lock(&vehicle.quality).clone(),
        }
    }
}

/// The report printed when the server ends.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Drawing one tick, median. [ms]
    pub render_ms_p50: f32,
    /// 99th percentile. [ms]
    pub render_ms_p99: f32,
    /// Encoding one image, median. [ms]
    pub encode_ms_p50: f32,
    /// 99th percentile. [ms]
    pub encode_ms_p99: f32,
    /// Handing over to acknowledgement, median. [ms]
    pub send_ms_p50: f32,
    /// 99th percentile. [ms]
    pub send_ms_p99: f32,
    /// What the server's own stages took. [ms]
    pub stages: ServerStages,
    /// What became of the images of the last flight, by vehicle and camera.
    pub images: BTreeMap<String, Vec<CameraDelivery>>,
    /// Ticks rendered.
    pub ticks: u64,
    /// Ticks rendered that no one took before the next.
    pub ticks_skipped: u64,
    /// Images that a runtime acknowledged.
    pub images_sent: u64,
    /// Images given up past their deadline.
    pub images_late: u64,
    /// Megabytes of images acknowledged. [MB]
    pub sent_mb: f64,
    /// What the localization delivered.
    pub source: SourceCounters,
    /// How good it was in the end, by vehicle.
    pub pose: BTreeMap<String, PoseQuality>,
    /// Peak resident memory of this process. [MB]
    pub peak_rss_mb: f64,
    /// Which renderer drew.
    pub renderer: String,
    /// Why it was this one.
    pub renderer_reason: String,
}

impl Stats {
    /// Returns the report over the whole run.
    pub fn report(
        &self,
        vehicles: &[Arc<Vehicle>],
        source: SourceCounters,
        renderer: &RendererInfo,
    ) -> Report {
        let total = |counter: fn(&ImageCounters) -> &AtomicU64| -> u64 {
            vehicles.iter().map(|vehicle| counter(&vehicle.images).load(Ordering::Relaxed)).sum()
        };
        let (render, encode, send) =
            (self.render.overall(), self.encode.overall(), self.send.overall());
        Report {
            render_ms_p50: render.p50,
            render_ms_p99: render.p99,
            encode_ms_p50: encode.p50,
            encode_ms_p99: encode.p99,
            send_ms_p50: send.p50,
            send_ms_p99: send.p99,
            stages: ServerStages { pose: self.pose.overall(), render, encode, send },
            images: vehicles
                .iter()
                .map(|vehicle| (vehicle.name.as_str().to_owned(), vehicle.accounts()))
                .collect(),
            ticks: self.ticks.load(Ordering::Relaxed),
            ticks_skipped: self.ticks_skipped.load(Ordering::Relaxed),
            images_sent: total(|images| &images.sent),
            images_late: total(|images| &images.late),
            sent_mb: total(|images| &images.bytes) as f64 / 1e6,
            source,
            pose: vehicles
                .iter()
                .map(|vehicle| (vehicle.name.as_str().to_owned(), lock(&vehicle.quality).clone()))
                .collect(),
            peak_rss_mb: peak_rss_mb().unwrap_or(0.0),
            renderer: renderer.name.clone(),
            renderer_reason: renderer.reason.clone(),
        }
    }
}

/// Returns the peak resident memory of this process; `None` where /proc is absent. [MB]
pub fn peak_rss_mb() -> Option<f64> {
    parse_peak(&std::fs::read_to_string("/proc/self/status").ok()?)
}

fn parse_peak(status: &str) -> Option<f64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib * 1024.0 / 1e6)
}

/// Samples behind the page's figures: 4 s at 60 Hz.
const RECENT: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_samples() {
        let span = StageDurations::default();
        assert_eq!(span.recent(), StageTimes::default());
        assert_eq!(span.overall(), StageTimes::default());
        for value in 1..=200 {
            span.add_ms(f64::from(value));
        }
        let recent = span.recent();
        assert!((recent.p50 - 100.0).abs() <= 1.0 && (recent.p99 - 198.0).abs() <= 1.0);
        assert_eq!(recent.max, 200.0);
        let overall = span.overall();
        assert!((overall.p50 / 100.0 - 1.0).abs() < 0.03, "{overall:?}");
        assert!((overall.p99 / 198.0 - 1.0).abs() < 0.03, "{overall:?}");
        // Extremes land in the end buckets.
        span.add_ms(-1.0);
        span.add_ms(f64::NAN);
        span.add_ms(1e12);
    }

    #[test]
    fn a_rate_is_counted_over_half_a_second() {
        let rate = Rate::default();
        let at = |ms: u64| ServerTime::from_ns(ms * 1_000_000);
        assert_eq!(rate.of(100, at(0)), 0.0);
        assert_eq!(rate.of(120, at(400)), 0.0);
        assert_eq!(rate.of(160, at(1000)), 60.0);
        assert_eq!(rate.of(161, at(1010)), 60.0);
    }

    #[test]
    fn peak_memory_is_read_from_the_status_file() {
        assert_eq!(parse_peak("Name:\tx\nVmHWM:\t  1000 kB\n"), Some(1.024));
        assert_eq!(parse_peak("Name:\tx\n"), None);
        assert!(peak_rss_mb().is_some_and(|mb| mb > 1.0));
    }
}
