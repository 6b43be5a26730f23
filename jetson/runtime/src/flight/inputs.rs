//! Inputs of the flight: the arena, events of the server and the link, and the plugin's replies.

use vizflyt_protocol::flight_end::{EndReason, PluginFault};
use vizflyt_protocol::messages::{ArenaInfo, Event, EventKind, FlightPhase, Setpoint, bounded};
use vizflyt_protocol::time::HostTime;

use super::{Flight, Views};
use crate::guard::{VehicleMotion, check_arena};
use crate::link::{LOST_AFTER_S, LinkEvent};

/// Maximum severity number of STATUSTEXT messages that are reported to people.
const SEVERITY_WARNING: u8 = 4;

impl Flight {
    /// Handles the description of the arena from the server.
    pub fn handle_arena(&mut self, now: HostTime, mut arena: Box<ArenaInfo>) {
        self.settings.tighten(&mut arena);
        if let Err(why) = check_arena(&arena) {
            return self.end_for(now, EndReason::ArenaRefused(bounded(&why)));
        }
        if let Err(why) = self.sight.use_cameras(&self.settings.cameras, &arena) {
            return self.end_for(now, EndReason::ArenaRefused(bounded(&why)));
        }
        match &self.arena {
            Some(known) if **known != *arena => {
                // The guard must not enforce a fence that is no longer that of the room.
                self.end_for(now, EndReason::ArenaChanged { name: arena.name.clone() });
            }
            _ => self.arena = Some(arena),
        }
    }

    /// Handles the localized motion of the vehicle.
    pub fn handle_pose(&mut self, vehicle: VehicleMotion) {
        if vehicle.is_valid() {
            self.vehicle = Some(vehicle);
        }
    }

    /// Handles an event of the server that happened at `at` on our clock.
    pub fn handle_event(&mut self, now: HostTime, event: &Event, at: HostTime) {
        self.end.handle(at.min(now), &event.kind);
        match event.kind {
            EventKind::Start if self.phase == FlightPhase::Waiting => {
                self.waits_for_start = false;
            }
            // Not stored: the vehicle may be unready because a person is in the net.
            EventKind::Start if self.waits_for_start => {
                let why = "start was pressed before the vehicle was ready; press it again then";
                self.notice(EventKind::Note, why.to_owned());
            }
            _ => {
                // Ignore events that cannot end a flight on the ground.
                if let (Some(reason), Some(_)) = (event.kind.end_reason(), self.end.reason()) {
                    self.come_down(now, reason.brakes_first());
                }
            }
        }
    }

    /// Records that the server is not connected, or that it rejects us temporarily; `why` is a sentence.
    pub fn server_down(&mut self, why: &str) {
        self.server_down = Some(bounded(why));
    }

    /// Ends the flight because the connection to the server failed permanently; `why` is a sentence.
    pub fn refuse(&mut self, now: HostTime, why: &str) {
        self.end_for(now, EndReason::ServerRefused(bounded(why)));
    }

    /// Ends the flight because a person interrupts it.
    pub fn interrupt(&mut self, now: HostTime) {
        self.interrupted_at.get_or_insert(now);
        self.end_for(now, EndReason::Interrupted);
    }

    /// Ends the flight because the guardian has failed.
    pub fn guardian_failed(&mut self, now: HostTime) {
        self.has_guardian = false;
        self.end_for(now, EndReason::GuardianFailed);
    }

    /// Handles an event of the link to the autopilot.
    pub fn handle_link(&mut self, now: HostTime, event: LinkEvent) {
        match event {
            LinkEvent::Refused(why) => {
                self.end_for(now, EndReason::AutopilotRefused(bounded(&why)));
            }
            LinkEvent::Lost if self.is_airborne() => {
                self.end_for(now, EndReason::AutopilotSilent { silent_s: LOST_AFTER_S });
            }
            LinkEvent::Rebooted if self.is_airborne() => {
                self.end_for(now, EndReason::AutopilotRestarted);
            }
            LinkEvent::Text { severity, text } if severity <= SEVERITY_WARNING => {
                self.notice(EventKind::Note, format!("autopilot: {text}"));
            }
            event => {
                if let Some(warning) = event.warning() {
                    self.notice(EventKind::Note, warning);
                }
            }
        }
    }

    /// Records that the plugin waits for images.
    pub fn plugin_ready(&mut self) {
        self.plugin_ready = true;
    }

    /// Records that observation `seq` was sent to the plugin; `views` contains the ages of its images.
    pub fn published(&mut self, now: HostTime, seq: u64, views: Views) {
        self.sight.shown(now, seq, &views);
        self.unanswered.get_or_insert((seq, now));
    }

    /// Ends the flight because the plugin has failed permanently.
    pub fn plugin_failed(&mut self, now: HostTime, fault: PluginFault) {
        self.end_for(now, EndReason::Plugin(fault));
    }

    /// Handles the plugin's reply to observation `seq`: its setpoint, if it sent one.
    pub fn replied(&mut self, now: HostTime, seq: u64, setpoint: Option<Setpoint>) {
        self.replied_at = Some(now);
        self.sight.answered(seq);
        if self.unanswered.is_some_and(|(oldest, _)| oldest <= seq) {
            self.unanswered = None;
        }
        let (Some(guard), None) = (&mut self.guard, self.end.reason()) else { return };
        let Some(setpoint) = setpoint else { return guard.handle_empty_reply(now) };
        match guard.handle_setpoint(now, setpoint) {
            Ok(()) => {
                self.accepted_seq = Some(seq);
                self.refused = None;
            }
            // Once per series; the hold and the landing that follow repeat the reason.
            Err(fault) if self.refused.is_none() => {
                self.refused = Some(fault);
                self.notice(EventKind::Note, format!("setpoint refused: {fault}"));
            }
            Err(_) => {}
        }
    }

    /// Records that the plugin is restarting; `why` is a sentence. The vehicle holds until it replies.
    pub fn plugin_restarts(&mut self, now: HostTime, why: String) {
        if !self.can_wait_for_plugin() {
            return;
        }
        (self.plugin_ready, self.unanswered, self.replied_at) = (false, None, None);
        if let Some(guard) = &mut self.guard {
            guard.wait_for_plugin(now);
        }
        self.notice(EventKind::Note, format!("{why}; the plugin is started again"));
        if matches!(self.phase, FlightPhase::Preparing | FlightPhase::Waiting) {
            self.enter(now, FlightPhase::Connecting, "waiting for the plugin");
        }
        self.restart_reason = Some(why);
    }
}
