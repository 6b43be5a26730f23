//! What the server measures of itself: time per stage, counts, peak memory.
//!
//! Stages bear the names of the tracing spans: `pose render encode send`. Each thread adds to its
//! own [`Span`]; the page reads the recent past, the report the whole run.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use serde::Serialize;
use vizflyt_protocol::time::ServerTime;

use crate::drivers::SourceCounters;
use crate::hub::RendererInfo;
use crate::vehicle::ImageCounters;

/// Everything measured; shared by all threads.
#[derive(Debug, Default)]
pub struct Stats {
    /// Arrival of a pose to the end of gate and referee.
    pub pose: Span,
    /// Drawing all cameras of a tick.
    pub render: Span,
    /// Quantising and encoding one camera's image.
    pub encode: Span,
    /// Handing an image to the transport until the runtime has acknowledged all of it.
    pub send: Span,
    /// Ticks drawn.
    pub ticks: AtomicU64,
    /// Ticks drawn that no one took before the next.
    pub ticks_skipped: AtomicU64,
}

/// Durations of one stage.
#[derive(Debug)]
pub struct Span(Mutex<Samples>);

#[derive(Debug)]
struct Samples {
    recent: [f32; RECENT],
    next: usize,
    /// Counts by logarithm of the duration, over the whole run.
    buckets: Box<[u32; BUCKETS]>,
    count: u64,
}

impl Default for Span {
    fn default() -> Self {
        Self(Mutex::new(Samples {
            recent: [0.0; RECENT],
            next: 0,
            buckets: Box::new([0; BUCKETS]),
            count: 0,
        }))
    }
}

/// Percentiles of a stage. [ms]
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Percentiles {
    /// Median. [ms]
    pub p50: f32,
    /// 99th percentile. [ms]
    pub p99: f32,
}

impl Span {
    /// Adds a duration. [ms]
    pub fn add_ms(&self, ms: f64) {
        let mut samples = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let next = samples.next;
        samples.recent[next] = ms as f32;
        samples.next = (next + 1) % RECENT;
        samples.count += 1;
        samples.buckets[bucket(ms)] += 1;
    }

    /// Adds the time from `start` to `end`.
    pub fn add(&self, start: ServerTime, end: ServerTime) {
        self.add_ms(end.seconds_since(start) * 1e3);
    }

    /// Returns percentiles of the newest samples, a few seconds' worth.
    pub fn recent(&self) -> Percentiles {
        let (mut values, count) = {
            let samples = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            (samples.recent, samples.count.min(RECENT as u64) as usize)
        };
        let values = &mut values[..count];
        values.sort_unstable_by(f32::total_cmp);
        let at = |share: f64| {
            let index = (share * (count as f64 - 1.0)).round().max(0.0) as usize;
            values.get(index).copied().unwrap_or(0.0)
        };
        Percentiles { p50: at(0.5), p99: at(0.99) }
    }

    /// Returns percentiles of the whole run, to within 2.5 %.
    pub fn overall(&self) -> Percentiles {
        let samples = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let at = |share: f64| {
            let rank = (share * samples.count as f64).ceil().max(1.0) as u64;
            let mut seen = 0;
            for (index, count) in samples.buckets.iter().enumerate() {
                seen += u64::from(*count);
                if seen >= rank {
                    return bucket_middle_ms(index) as f32;
                }
            }
            0.0
        };
        Percentiles { p50: at(0.5), p99: at(0.99) }
    }
}

fn bucket(ms: f64) -> usize {
    let steps = (ms.max(LEAST_MS) / LEAST_MS).ln() / STEP.ln();
    (steps as usize).min(BUCKETS - 1)
}

fn bucket_middle_ms(index: usize) -> f64 {
    LEAST_MS * STEP.powf(index as f64 + 0.5)
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
    /// Ticks drawn.
    pub ticks: u64,
    /// Ticks drawn that no one took before the next.
    pub ticks_skipped: u64,
    /// Images that a runtime acknowledged.
    pub images_sent: u64,
    /// Images given up past their deadline.
    pub images_late: u64,
    /// Megabytes of images acknowledged. [MB]
    pub sent_mb: f64,
    /// What the localization delivered.
    pub source: SourceCounters,
    /// Peak resident memory of this process. [MB]
    pub peak_rss_mb: f64,
    /// Which renderer drew.
    pub renderer: String,
    /// Why it was this one.
    pub renderer_reason: String,
}

impl Stats {
    /// Returns the report over the whole run; `images` are those of all vehicles.
    pub fn report(
        &self,
        images: &[&ImageCounters],
        source: SourceCounters,
        renderer: &RendererInfo,
    ) -> Report {
        let total = |counter: fn(&ImageCounters) -> &AtomicU64| -> u64 {
            images.iter().map(|images| counter(images).load(Ordering::Relaxed)).sum()
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
            ticks: self.ticks.load(Ordering::Relaxed),
            ticks_skipped: self.ticks_skipped.load(Ordering::Relaxed),
            images_sent: total(|images| &images.sent),
            images_late: total(|images| &images.late),
            sent_mb: total(|images| &images.bytes) as f64 / 1e6,
            source,
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
/// A microsecond. [ms]
const LEAST_MS: f64 = 1e-3;
/// Ratio of neighbouring buckets; half of it is the error of a percentile.
const STEP: f64 = 1.05;
/// 1.05^340 microseconds are 16 s.
const BUCKETS: usize = 340;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_samples() {
        let span = Span::default();
        assert_eq!(span.recent(), Percentiles::default());
        assert_eq!(span.overall(), Percentiles::default());
        for value in 1..=200 {
            span.add_ms(f64::from(value));
        }
        let recent = span.recent();
        assert!((recent.p50 - 100.0).abs() <= 1.0 && (recent.p99 - 198.0).abs() <= 1.0);
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
