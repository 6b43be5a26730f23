//! What the control loop tells others: server, plugin, log, console.

use std::io::Write;

use serde_json::json;
use vizflyt_protocol::mavlink::{GuidedMotion, GuidedSetpoint};
use vizflyt_protocol::messages::{
    Arrivals, Event, EventKind, MAX_CAMERAS, Telemetry, ToPlugin, YawTarget, bounded,
};
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::host_now;

use super::Loop;
use crate::console::Status;
use crate::lockstep::for_plugin;
use crate::log::Channel;

/// The status line is renewed every so many ticks, a multiple of those of the reports: 2 Hz.
const STATUS_TICKS: u64 = 25;

impl Loop {
    pub(super) fn tell_notices(&mut self, now: HostTime) {
        while let Some(notice) = self.flight.poll_notice() {
            let stamp = self.control.shared.clock.to_server(now);
            let text = bounded(&notice.text);
            let event = Event { stamp, kind: notice.kind, text };
            tracing::info!(target: "flight", "{}", notice.text);
            self.publish_event(now, &event);
            self.control.to_server.tell(event);
        }
    }

    /// Log, plugin and standard output hear of every event but the plugin's own lines.
    pub(super) fn publish_event(&mut self, now: HostTime, event: &Event) {
        self.control.log.event(now, event);
        if self.control.json {
            print_line(&json!({"event": event}).to_string());
        } else {
            self.control.screen.event(&event.text);
        }
        if let Some(side) = &self.plugin
            && side.started
            && side.ipc.plugin_attached()
        {
            let message = ToPlugin::Event(for_plugin(event, &side.arena));
            self.control.log.to_plugin(host_now(), &message);
            if let Err(error) = side.ipc.send(&message) {
                tracing::debug!("plugin: {error}");
            }
        }
    }

    pub(super) fn report(&mut self, now: HostTime) {
        let replaced = self.control.shared.mailbox.replaced();
        let telemetry = Telemetry {
            phase: self.flight.phase(),
            vehicle: *self.link.state(),
            images: self.times.last_second(now, self.published, replaced),
            v_setpoint_mps: self.v_setpoint_mps,
            setpoints_sent: self.setpoints_sent,
            mavlink_packets: self.link.packets(),
        };
        self.control.log.write(Channel::Telemetry, now, &telemetry);
        if self.ticks.is_multiple_of(STATUS_TICKS) {
            let status = Status::of(&telemetry);
            if self.control.json {
                print_line(&json!({"status": status}).to_string());
            } else {
                self.control.screen.status(&status);
            }
        }
        self.control.to_server.report(telemetry);
    }

    pub(super) fn report_timing(&mut self, now: HostTime) {
        if let Some(trouble) = self.control.log.poll_trouble() {
            let text = bounded(&format!("flight log: {trouble}"));
            let stamp = self.control.shared.clock.to_server(now);
            let event = Event { stamp, kind: EventKind::Note, text };
            self.publish_event(now, &event);
            self.control.to_server.tell(event);
        }
        let clock = self.control.shared.clock.state(now);
        let timing = self.times.timing(now, clock, &self.arrived());
        self.control.log.write(Channel::Timing, now, &timing);
        self.control.to_server.report_timing(timing);
    }

    /// Returns what became of images before they reached shared memory, by camera.
    pub(super) fn arrived(&self) -> Vec<Arrivals> {
        let cameras = self.plugin.as_ref().map_or(0, |side| side.arena.cameras.len());
        self.control.shared.mailbox.arrivals()[..cameras.min(MAX_CAMERAS)].to_vec()
    }

    pub(super) fn log_sent(&mut self, now: HostTime, setpoint: &GuidedSetpoint) {
        let GuidedMotion::Velocity(v_mps) = setpoint.motion else { return };
        self.v_setpoint_mps = v_mps;
        let (yaw_rad, yaw_rate_radps) = match setpoint.yaw {
            YawTarget::Angle(yaw_rad) => (Some(yaw_rad), None),
            YawTarget::Rate(rate_radps) => (None, Some(rate_radps)),
            YawTarget::Keep => (None, None),
        };
        self.control.log.write(
            Channel::Sent,
            now,
            &json!({
                "v_world_mps": v_mps.to_array(), "yaw_rad": yaw_rad,
                "yaw_rate_radps": yaw_rate_radps
            }),
        );
    }
}

/// Prints a line for a program that may have stopped listening.
pub fn print_line(line: &str) {
    let mut out = std::io::stdout().lock();
    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
}
