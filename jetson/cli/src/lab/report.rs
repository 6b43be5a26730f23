//! Report of a flight in the simulated lab: measurements of runtime, server and simulator in one
//! JSON object.

use anyhow::{Context, Result};
use nix::sys::signal::Signal;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use vizflyt_protocol::messages::OutcomeKind;

use super::child::Role;

/// Results of one flight, written by `--report`.
#[derive(Clone, Debug, Serialize, PartialEq)]
pub(crate) struct LabReport {
    pub outcome: OutcomeKind,
    /// Reason of the outcome, as a sentence.
    pub reason: String,
    /// Seed of scene and simulator.
    pub seed: u64,
    /// Duration from take-off to the end of the flight. [s]
    pub seconds: f64,
    /// Images delivered to the plugin.
    pub images_delivered: u64,
    /// Images delivered to the plugin per second of flight. [Hz]
    pub image_hz: f64,
    /// Width of the first camera's images. [px]
    pub image_width: u64,
    /// Height of the first camera's images. [px]
    pub image_height: u64,
    /// Age of images: pose stamp to plugin callback, median. [ms]
    pub age_ms_p50: f64,
    /// Age of images: pose stamp to plugin callback, 99th percentile. [ms]
    pub age_ms_p99: f64,
    /// Time to render all cameras of a tick, median. [ms]
    pub render_ms_p50: f64,
    /// Duration of each stage from the pose stamp to the setpoint, by name, as `p50`, `p90`, `p99`, `max`. [ms]
    pub stages: Value,
    /// Age of images, with the same statistics. [ms]
    pub age: Value,
    /// Pose stamp to the setpoint that answers the image. [ms]
    pub total: Value,
    /// Intervals between images at the plugin: `times` and `bins`.
    pub intervals: Value,
    /// Server's clock relative to the runtime's.
    pub clock: Value,
    /// Delivery of the images rendered for the runtime, by vehicle and camera.
    pub images: Value,
    /// Mean speed in flight, from the simulator's truth. [m/s]
    pub mean_speed_mps: f64,
    /// Maximum speed, from the simulator's truth. [m/s]
    pub max_speed_mps: f64,
    /// Minimum distance of the body's surface to the true geometry; absent if the scene has none.
    /// [m]
    pub min_clearance_m: Option<f64>,
    /// Simulated time that was skipped because this machine was suspended or too busy. [s]
    pub seconds_given_up: f64,
    /// Quality of the localization at the end, by vehicle: rate, age, sigma, and for each source
    /// delivered and rejected poses.
    pub pose: Value,
    /// Number of setpoints sent to the autopilot.
    pub setpoints_sent: u64,
    /// Number of MAVLink packets sent and received by the runtime.
    pub mavlink_packets: u64,
    /// Counters of the bridge, if one was used.
    pub bridge: Value,
    /// Results of AprilTag localization, if it was used.
    pub localization: Value,
    /// Peak of the summed resident memory of all processes. [MB]
    pub peak_rss_mb: f64,
    /// Renderer that was used, such as `cpu avx2`.
    pub renderer: String,
    /// Reason for the choice of the renderer.
    pub renderer_reason: String,
    /// Path of the flight log.
    pub log: String,
}

/// Reports of the processes; null if a process did not report.
#[derive(Clone, Debug, Default)]
pub(crate) struct Parts {
    pub runtime: Value,
    pub server: Value,
    /// Report of the simulator: the true values.
    pub simulator: Value,
    /// Report of the bridge, if there was one.
    pub bridge: Value,
    /// Report of AprilTag localization, if there was one.
    pub localization: Value,
    /// Processes that were killed, with the signal.
    pub killed: Vec<(Role, Signal)>,
}

impl Parts {
    fn why_missing(&self, role: Role) -> String {
        let killed = self.killed.iter().find(|(killed, _)| *killed == role);
        let name = role.name();
        match killed {
            // The kernel allocates shared memory when it is first written.
            Some((_, Signal::SIGBUS)) => {
                format!(
                    "the {name} was killed by SIGBUS; probably /dev/shm is full: free some of it"
                )
            }
            Some((_, Signal::SIGKILL)) => {
                format!("the {name} was killed by SIGKILL; probably the memory is full")
            }
            Some((_, signal)) => format!("the {name} was killed by {signal}"),
            None => format!("the {name} ended without a report"),
        }
    }

    /// Joins the parts. A collision in the simulator's truth overrides the referee's decision. A
    /// missing part is an error that names the part.
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

    /// Returns the report as text.
    pub(crate) fn summary(&self) -> String {
        let clearance = match self.min_clearance_m {
            Some(clearance_m) => format!("{clearance_m:.2} m"),
            None if self.seconds == 0.0 => "not known (it did not fly)".to_owned(),
            None => "not known (this scene has no true geometry)".to_owned(),
        };
        let tags = &self.localization;
        let tags = match (tags["located"].as_u64(), tags["error_mm_rms"].as_f64()) {
            (Some(located), Some(error_mm)) => format!(
                "\x20 tags        {located} poses at {:.0} Hz, error {error_mm:.1} mm, {:.1} ms an image\n",
                tags["rate_hz"].as_f64().unwrap_or(0.0),
                tags["image_ms_p50"].as_f64().unwrap_or(0.0),
            ),
            _ => String::new(),
        };
        let stalled = if self.seconds_given_up > NOTICEABLE_S {
            format!(
                "\x20 too busy    the simulation stood still for {:.1} s; close other programs for valid figures\n",
                self.seconds_given_up
            )
        } else {
            String::new()
        };
        let reason =
            if self.reason.is_empty() { String::new() } else { format!(": {}", self.reason) };
        format!(
            "{outcome}{reason}\n\
             \x20 flight      {seconds:.1} s, mean {mean:.2} m/s, maximum {top:.2} m/s, minimum clearance {clearance}\n\
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

/// Minimum skipped time for a warning in the summary. [s]
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
    fn a_true_collision_overrides_the_referee() {
        let mut parts = parts();
        assert_eq!(parts.join(7, 1.0, "").outcome, OutcomeKind::Finished);
        parts.simulator["collided"] = json!(true);
        assert_eq!(parts.join(7, 1.0, "").outcome, OutcomeKind::Collided);
    }

    #[test]
    fn names_a_machine_that_stood_still() {
        let mut parts = parts();
        assert!(!parts.join(7, 1.0, "").summary().contains("stood still"));
        parts.simulator["seconds_given_up"] = json!(0.45);
        let summary = parts.join(7, 1.0, "").summary();
        assert!(summary.contains("the simulation stood still for 0.5 s"), "{summary}");
    }

    #[test]
    fn names_a_missing_part() {
        let report = Parts { server: Value::Null, ..parts() }.join(7, 1.0, "");
        assert_eq!(report.outcome, OutcomeKind::Error);
        assert_eq!(report.reason, "the render server ended without a report");
        let killed = vec![(Role::Runtime, Signal::SIGBUS)];
        let report = Parts { runtime: Value::Null, killed, ..parts() }.join(7, 1.0, "");
        assert!(report.reason.contains("the runtime was killed by SIGBUS"), "{}", report.reason);
        assert!(report.reason.contains("/dev/shm is full"), "{}", report.reason);
    }
}
