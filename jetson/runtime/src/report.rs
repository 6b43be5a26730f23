//! Report of a flight as one JSON object.

use std::fs;

use serde::{Deserialize, Serialize};
use vizflyt_protocol::flight_end::EndReason;
use vizflyt_protocol::messages::{
    Arrivals, ClockState, Intervals, OutcomeKind, StageTimes, Stages,
};

use crate::stats::ImageTimes;

/// Report of a flight. Field names contain their units.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FlightReport {
    /// Outcome of the flight.
    pub outcome: OutcomeKind,
    /// Reason of the end as one sentence.
    pub reason: String,
    /// Duration from take-off to the end. [s]
    pub seconds: f64,
    /// Images that reached the plugin.
    pub images_delivered: u64,
    /// Images that reached the plugin per second. [Hz]
    pub image_hz: f64,
    /// Width of the first camera's images. [px]
    pub image_width: u32,
    /// Height of the first camera's images. [px]
    pub image_height: u32,
    /// Pose stamp to plugin callback, median. [ms]
    pub age_ms_p50: f64,
    /// Pose stamp to plugin callback, 99th percentile. [ms]
    pub age_ms_p99: f64,
    /// Time inside the plugin's `on_image`, median. [ms]
    pub plugin_ms_p50: f64,
    /// Duration of each stage, from the pose stamp to the setpoint. [ms]
    pub stages: Stages<StageTimes>,
    /// Pose stamp to plugin callback. [ms]
    pub age: StageTimes,
    /// Pose stamp to the setpoint with the reply. [ms]
    pub total: StageTimes,
    /// Intervals between consecutive images at the plugin.
    pub intervals: Intervals,
    /// State of the server's clock at the end; absent without a clock exchange.
    pub clock: Option<ClockState>,
    /// Counts of received images by outcome, for each camera.
    pub cameras: Vec<Arrivals>,
    /// Replies that took longer than the plugin's deadline.
    pub plugin_overruns: u64,
    /// Restarts of the plugin.
    pub plugin_restarts: u32,
    /// Setpoints sent to the autopilot.
    pub setpoints_sent: u64,
    /// MAVLink packets sent and received.
    pub mavlink_packets: u64,
    /// Peak memory of this process. [MB]
    pub peak_rss_mb: f64,
    /// Path of the flight log, if one was written.
    pub log: Option<String>,
}

/// Counters for the report.
#[derive(Clone, Debug, Default)]
pub struct Counters {
    /// Duration from take-off to the end. [s]
    pub seconds: f64,
    /// Width and height of the first camera's images. [px]
    pub image_size_px: (u32, u32),
    /// Setpoints sent to the autopilot.
    pub setpoints_sent: u64,
    /// MAVLink packets sent and received.
    pub mavlink_packets: u64,
    /// Replies that took longer than the plugin's deadline.
    pub plugin_overruns: u64,
    /// Restarts of the plugin.
    pub plugin_restarts: u32,
    /// State of the server's clock.
    pub clock: Option<ClockState>,
    /// Counts of received images by outcome, for each camera.
    pub cameras: Vec<Arrivals>,
}

impl FlightReport {
    pub fn new(end: &EndReason, times: &ImageTimes, counters: &Counters) -> Self {
        let (waterfall, intervals) = times.flight();
        Self {
            outcome: end.outcome(),
            reason: end.to_string(),
            seconds: counters.seconds,
            images_delivered: times.delivered(),
            image_hz: times.rate_hz(),
            image_width: counters.image_size_px.0,
            image_height: counters.image_size_px.1,
            age_ms_p50: times.ages().quantile_ms(0.5),
            age_ms_p99: times.ages().quantile_ms(0.99),
            plugin_ms_p50: times.plugin().quantile_ms(0.5),
            stages: waterfall.stages,
            age: waterfall.age,
            total: waterfall.total,
            intervals,
            clock: counters.clock,
            cameras: counters.cameras.clone(),
            plugin_overruns: counters.plugin_overruns,
            plugin_restarts: counters.plugin_restarts,
            setpoints_sent: counters.setpoints_sent,
            mavlink_packets: counters.mavlink_packets,
            peak_rss_mb: peak_rss_mb().unwrap_or(0.0),
            log: None,
        }
    }
}

/// Returns the peak memory of this process (`VmHWM`); `None` if the system does not report it. [MB]
pub fn peak_rss_mb() -> Option<f64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib * 1024.0 / 1e6)
}

#[cfg(test)]
mod tests {
    use vizflyt_protocol::flight_end::PluginFault;

    use super::*;

    #[test]
    fn reports_peak_memory() {
        let mb = peak_rss_mb().unwrap();
        assert!(mb > 0.5 && mb < 100_000.0, "{mb}");
    }

    #[test]
    fn serializes_the_documented_field_names() {
        let end = EndReason::Plugin(PluginFault::NoSetpoint);
        let report = FlightReport::new(&end, &ImageTimes::default(), &Counters::default());
        let json = serde_json::to_value(&report).unwrap();
        assert_eq!(json["outcome"], "plugin_failed");
        for key in ["age_ms_p99", "image_hz", "setpoints_sent", "mavlink_packets", "peak_rss_mb"] {
            assert!(json[key].is_number(), "{key}");
        }
        assert!(json["stages"]["handover"]["p99"].is_number());
    }
}
