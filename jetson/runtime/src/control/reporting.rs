//! Reports of the control loop to server, plugin, log and console.

use serde_json::json;
use vizflyt_process::print_line;
use vizflyt_protocol::mavlink::GuidedSetpoint;
use vizflyt_protocol::messages::{Arrivals, Event, Guarded, MAX_CAMERAS, Telemetry};
use vizflyt_protocol::time::HostTime;

use super::ControlLoop;
use crate::console::Status;
use crate::log::{Channel, sent_message};

/// Ticks between updates of the status line, a multiple of [`super::TELEMETRY_TICKS`]: 2 Hz.
const STATUS_TICKS: u64 = 25;

impl ControlLoop {
    /// Logs an event and prints it.
    pub(super) fn show_event(&mut self, now: HostTime, event: &Event) {
        self.control.log.event(now, event);
        if self.control.json {
            print_line(json!({"event": event}));
        } else {
            self.control.screen.event(&event.text);
        }
    }

    pub(super) fn report(&mut self, now: HostTime) {
        let replaced = self.control.shared.mailbox.replaced();
        let telemetry = Telemetry {
            phase: self.companion.flight().phase(),
            vehicle: *self.companion.link().state(),
            images: self.times.last_second(now, self.published, replaced),
            v_setpoint_mps: self.companion.v_setpoint_mps(),
            setpoints_sent: self.companion.setpoints_sent(),
            mavlink_packets: self.companion.link().packets(),
        };
        self.control.log.write(Channel::Telemetry, now, &telemetry);
        if self.ticks.is_multiple_of(STATUS_TICKS) {
            let status = Status::of(&telemetry);
            if self.control.json {
                print_line(json!({"status": status}));
            } else {
                self.control.screen.status(&status);
            }
        }
        self.control.to_server.report(telemetry);
    }

    pub(super) fn report_timing(&mut self, now: HostTime) {
        if let Some(trouble) = self.control.log.poll_trouble() {
            self.companion.note(now, &format!("flight log: {trouble}"));
        }
        let clock = self.control.shared.clock.state(now);
        let timing = self.times.timing(now, clock, &self.arrived());
        self.control.log.write(Channel::Timing, now, &timing);
        self.control.to_server.report_timing(timing);
    }

    /// Reports the limits of the guard and the fence of the autopilot to the server.
    pub(super) fn report_guarded(&self) {
        if let Some(arena) = self.companion.arena() {
            self.control.to_server.report_guarded(Guarded::of(arena, self.polygons));
        }
    }

    /// Returns the number of images that arrived, were dropped or failed before shared memory, by camera.
    pub(super) fn arrived(&self) -> Vec<Arrivals> {
        let cameras = self.companion.arena().map_or(0, |arena| arena.cameras.len());
        self.control.shared.mailbox.arrivals()[..cameras.min(MAX_CAMERAS)].to_vec()
    }

    pub(super) fn log_sent(&self, now: HostTime, setpoint: &GuidedSetpoint) {
        if let Some(message) = sent_message(setpoint) {
            self.control.log.write(Channel::Sent, now, &message);
        }
    }
}
