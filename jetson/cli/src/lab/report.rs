//! The report of a flight in the simulated lab: what the runtime, the server and the simulator each measured, in one JSON
//! object.

use anyhow::{Context, Result};
use nix::sys::signal::Signal;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use vizflyt_protocol::messages::OutcomeKind;

use super::child::Role;

/// One flight. Written by `--report`.
#[derive(Clone, Debug, Serialize, PartialEq)]
pub(crate) struct LabReport {
    /// How it ended.
    pub outcome: OutcomeKind,
    /// Why, in a sentence.
    pub reason: String,
    /// The seed of scene and simulator.
    pub seed: u64,
    /// Take-off to the end of the flight. [s]
    pub seconds: f64,
    /// Images the plugin was given.
    pub images_delivered: u64,
    /// Images given to the plugin per second of flight. [Hz]
    pub image_hz: f64,
    /// Width of the first camera's images. [px]
    pub image_width: u64,
    /// Height of the first camera's images. [px]
    pub image_height: u64,
    /// Pose stamp to plugin callback, median. [ms]
    pub age_ms_p50: f64,
    /// Pose stamp to plugin callback, 99th percentile. [ms]
    pub age_ms_p99: f64,
    /// Time to render all cameras of a tick, median. [ms]
    pub render_ms_p50: f64,
    /// What each stage adds to the age, by name, as `p50`, `p90`, `p99`, `max`. [ms]
    pub stages: Value,
    /// Pose stamp to plugin callback, in the same way. [ms]
    pub age: Value,
    /// Pose stamp to the setpoint that carries the answer. [ms]
    pub total: Value,
    /// Times between an image at the plugin and the next: `times` and `bins`.
    pub intervals: Value,
    /// The server's clock by the runtime's.
    pub clock: Value,
    /// Delivery of the images rendered for the runtime, by vehicle and camera.
    pub images: Value,
    /// Mean speed in flight, by the simulator's truth. [m/s]
    pub mean_speed_mps: f64,
    /// Greatest speed, by the simulator's truth. [m/s]
    pub max_speed_mps: f64,
    /// Least distance of the body's surface to the true geometry; absent where a scene has none. [m]
    pub min_clearance_m: Option<f64>,
    /// Simulated time that was given up because this machine stood still or was too busy. [s]
    pub seconds_given_up: f64,
    /// How good the localization was in the end, by vehicle: rate, age, sigma, what each source
    /// delivered and what of it was rejected.
    pub pose: Value,
    /// Setpoints sent to the autopilot.
    pub setpoints_sent: u64,
    /// MAVLink packets sent and received by the runtime.
    pub mavlink_packets: u64,
    /// The bridge's counters, where MAVLink passed through one.
    pub bridge: Value,
    /// What AprilTag localization saw, where it was flown on.
    pub localization: Value,
    /// Peak of the summed resident memory of all processes. [MB]
    pub peak_rss_mb: f64,
    /// The renderer that drew, such as `cpu avx2`.
    pub renderer: String,
    /// Why it was this one.
    pub renderer_reason: String,
    /// Where the flight log is.
    pub log: String,
}

/// What the processes reported, as far as they did.
#[derive(Clone, Debug, Default)]
pub(crate) struct Parts {
    /// The runtime's report.
    pub runtime: Value,
    /// The server's report.
    pub server: Value,
    /// The simulator's report: the truth.
    pub simulator: Value,
    /// The bridge's report, if there was one.
    pub bridge: Value,
    /// The report of AprilTag localization, if it was flown on.
    pub localization: Value,
    /// Which signal ended which process.
    pub killed: Vec<(Role, Signal)>,
}

impl Parts {
    fn why_missing(&self, role: Role) -> String {
        let killed = self.killed.iter().find(|(killed, _)| *killed == role);
        let name = role.name();
        match killed {
            // Memory that is shared has no room behind it when it is first touched.
            Some((_, Signal::SIGBUS)) => {
                format!(
                    "the {name} was killed by SIGBUS, as where /dev/shm is full; free some of it"
                )
            }
            Some((_, Signal::SIGKILL)) => {
                format!("the {name} was killed by SIGKILL, as where the memory is full")
            }
            Some((_, signal)) => format!("the {name} was killed by {signal}"),
            None => format!("the {name} ended without a report"),
        }
    }

    /// Joins the parts. A true collision outranks the referee's decision; a missing part is an
    /// error by name.
    pub(crate) fn join(&self, seed: u64, peak_rss_mb: f64, log: &str) -> LabReport {
        let number = |part: &Value, key: &str| part[key].as_f64().unwrap_or(0.0);
        let count = |part: &Value, key: &str| part[key].as_u64().unwrap_or(0);
        let text = |part: &Value, key: &str| part[key].as_str().map(str::to_owned);
        let missing = [
            (Role::Runtime, &self.runtime),
            (Role::Server, &self.server),
            (Role::Simulator, &self.simulator),
        ]
        .into_iter()
        .find(|(_, part)| !part.is_object());
        let (outcome, reason) = match missing {
            _ if self.simulator["collided"] == Value::Bool(true) => (
                OutcomeKind::Collided,
                "the body touched the true geometry of the scene".to_owned(),
            ),
            Some((role, _)) => (OutcomeKind::Error, self.why_missing(role)),
            None => (
                OutcomeKind::deserialize(&self.runtime["outcome"]).unwrap_or(OutcomeKind::Error),
                text(&self.runtime, "reason").unwrap_or_default(),
            ),
        };
        LabReport {
            outcome,
            reason,
            seed,
            seconds: number(&self.runtime, "seconds"),
            images_delivered: count(&self.runtime, "images_delivered"),
            image_hz: number(&self.runtime, "image_hz"),
            image_width: count(&self.runtime, "image_width"),
            image_height: count(&self.runtime, "image_height"),
            age_ms_p50: number(&self.runtime, "age_ms_p50"),
            age_ms_p99: number(&self.runtime, "age_ms_p99"),
            render_ms_p50: number(&self.server, "render_ms_p50"),
            stages: self.runtime["stages"].clone(),
            age: self.runtime["age"].clone(),
            total: self.runtime["total"].clone(),
            intervals: self.runtime["intervals"].clone(),
            clock: self.runtime["clock"].clone(),
            images: self.server["images"].clone(),
            mean_speed_mps: number(&self.simulator, "mean_speed_mps"),
            max_speed_mps: number(&self.simulator, "max_speed_mps"),
            min_clearance_m: self.simulator["min_clearance_m"].as_f64(),
            seconds_given_up: number(&self.simulator, "seconds_given_up"),
            pose: self.server["pose"].clone(),
            setpoints_sent: count(&self.runtime, "setpoints_sent"),
            mavlink_packets: count(&self.runtime, "mavlink_packets"),
            bridge: self.bridge.clone(),
            localization: self.localization.clone(),
            peak_rss_mb,
            renderer: text(&self.server, "renderer").unwrap_or_default(),
            renderer_reason: text(&self.server, "renderer_reason").unwrap_or_default(),
            log: log.to_owned(),
        }
    }
}

impl LabReport {
    /// Writes the report as indented JSON.
    pub(crate) fn write(&self, path: &std::path::Path) -> Result<()> {
        let json = serde_json::to_string_pretty(self)? + "\n";
        std::fs::write(path, json)
            .with_context(|| format!("cannot write the report to {}", path.display()))
    }

    /// Returns the report as a few lines for a person.
    pub(crate) fn summary(&self) -> String {
        let clearance = match self.min_clearance_m {
            Some(clearance_m) => format!("{clearance_m:.2} m"),
            None if self.seconds == 0.0 => "not known (it did not fly)".to_owned(),
            None => "not known (this scene has no true geometry)".to_owned(),
        };
        let tags = &self.localization;
        let tags = match (tags["located"].as_u64(), tags["error_mm_rms"].as_f64()) {
            (Some(located), Some(error_mm)) => format!(
                "\x20 tags        {located} poses at {:.0} Hz, {error_mm:.1} mm from the truth, {:.1} ms an image\n",
                tags["rate_hz"].as_f64().unwrap_or(0.0),
                tags["image_ms_p50"].as_f64().unwrap_or(0.0),
            ),
            _ => String::new(),
        };
        let stalled = if self.seconds_given_up > NOTICEABLE_S {
            format!(
                "\x20 too busy    this machine stood still for {:.1} s; close other programs for figures that count\n",
                self.seconds_given_up
            )
        } else {
            String::new()
        };
        let reason =
            if self.reason.is_empty() { String::new() } else { format!(": {}", self.reason) };
        format!(
            "{outcome}{reason}\n\
             \x20 flight      {seconds:.1} s, mean {mean:.2} m/s, top {top:.2} m/s, least clearance {clearance}\n\
             \x20 images      {delivered} of {width}x{height} RGB-D at {hz:.1} Hz, rendered in {render:.1} ms ({renderer})\n\
             \x20 age         pose to plugin p50 {p50:.1} ms, p99 {p99:.1} ms; to the setpoint {setpoint:.1} ms\n\
             \x20 vehicle     {setpoints} setpoints, {packets} MAVLink packets\n{tags}{stalled}\
             \x20 memory      {memory:.0} MB at most, all processes together\n\
             \x20 log         {log}",
            outcome = self.outcome,
            seconds = self.seconds,
            mean = self.mean_speed_mps,
            top = self.max_speed_mps,
            delivered = self.images_delivered,
            width = self.image_width,
            height = self.image_height,
            hz = self.image_hz,
            render = self.render_ms_p50,
            renderer = self.renderer,
            p50 = self.age_ms_p50,
            p99 = self.age_ms_p99,
            setpoint = self.total["p50"].as_f64().unwrap_or(0.0),
            setpoints = self.setpoints_sent,
            packets = self.mavlink_packets,
            memory = self.peak_rss_mb,
            log = if self.log.is_empty() { "none" } else { &self.log },
        )
    }
}

/// Less is no reason to doubt a flight's figures. [s]
const NOTICEABLE_S: f64 = 0.1;

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn parts() -> Parts {
        Parts {
            runtime: json!({"outcome": "finished", "reason": "", "image_hz": 50.5}),
            server: json!({"renderer": "cpu"}),
            simulator: json!({"collided": false, "min_clearance_m": 0.4}),
            bridge: Value::Null,
            localization: Value::Null,
            killed: Vec::new(),
        }
    }

    #[test]
    fn the_truth_outranks_the_referee() {
        let mut parts = parts();
        assert_eq!(parts.join(7, 1.0, "").outcome, OutcomeKind::Finished);
        parts.simulator["collided"] = json!(true);
        assert_eq!(parts.join(7, 1.0, "").outcome, OutcomeKind::Collided);
    }

    #[test]
    fn a_machine_that_stood_still_is_named() {
        let mut parts = parts();
        assert!(!parts.join(7, 1.0, "").summary().contains("stood still"));
        parts.simulator["seconds_given_up"] = json!(0.45);
        let summary = parts.join(7, 1.0, "").summary();
        assert!(summary.contains("this machine stood still for 0.5 s"), "{summary}");
    }

    #[test]
    fn a_missing_part_is_an_error_by_name() {
        let report = Parts { server: Value::Null, ..parts() }.join(7, 1.0, "");
        assert_eq!(report.outcome, OutcomeKind::Error);
        assert_eq!(report.reason, "the render server ended without a report");
        let killed = vec![(Role::Runtime, Signal::SIGBUS)];
        let report = Parts { runtime: Value::Null, killed, ..parts() }.join(7, 1.0, "");
        assert!(report.reason.contains("the runtime was killed by SIGBUS"), "{}", report.reason);
        assert!(report.reason.contains("/dev/shm is full"), "{}", report.reason);
    }
}
