//! The report at the end of a flight: figures in one JSON object.

use std::fs;

use serde::{Deserialize, Serialize};
use vizflyt_protocol::flight_end::EndReason;
use vizflyt_protocol::messages::{
    Arrivals, ClockState, Intervals, OutcomeKind, StageTimes, Stages,
};

use crate::stats::ImageTimes;

/// The report. Field names carry their units.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FlightReport {
    /// How the flight ended.
    pub outcome: OutcomeKind,
    /// Why, in one sentence.
    pub reason: String,
    /// From take-off to the end. [s]
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
    /// What each stage adds to the age. [ms]
    pub stages: Stages<StageTimes>,
    /// Pose stamp to plugin callback. [ms]
    pub age: StageTimes,
    /// Pose stamp to the setpoint that carries the answer. [ms]
    pub total: StageTimes,
    /// Times between an image at the plugin and the next.
    pub intervals: Intervals,
    /// The server's clock at the end; absent if it was never known.
    pub clock: Option<ClockState>,
    /// What became of the images that came, by camera.
    pub cameras: Vec<Arrivals>,
    /// Answers that took longer than the plugin's deadline.
    pub plugin_overruns: u64,
    /// How often the plugin was started again.
    pub plugin_restarts: u32,
    /// Setpoints sent to the autopilot.
    pub setpoints_sent: u64,
    /// MAVLink packets sent and received.
    pub mavlink_packets: u64,
    /// Most memory this process has held. [MB]
    pub peak_rss_mb: f64,
    /// The flight log, if one was written.
    pub log: Option<String>,
}

/// Counters that the report adds to the end.
#[derive(Clone, Debug, Default)]
pub struct Counters {
    /// From take-off to the end. [s]
    pub seconds: f64,
    /// Width and height of the first camera's images. [px]
    pub image_size_px: (u32, u32),
    /// Setpoints sent to the autopilot.
    pub setpoints_sent: u64,
    /// MAVLink packets sent and received.
    pub mavlink_packets: u64,
    /// Answers that took longer than the plugin's deadline.
    pub plugin_overruns: u64,
    /// How often the plugin was started again.
    pub plugin_restarts: u32,
    /// The server's clock.
    pub clock: Option<ClockState>,
    /// What became of the images that came, by camera.
    pub cameras: Vec<Arrivals>,
}

impl FlightReport {
    /// Makes the report.
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

/// Returns the most memory this process has held (`VmHWM`); `None` where the system does not
/// report it. [MB]
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
    fn names_are_those_agreed_on() {
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
