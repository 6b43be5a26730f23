//! Reasons and procedure for the end of a flight: reasons of the runtime, holds and landings of the guard, and a pilot
//! who takes over.

use vizflyt_protocol::flight_end::{Boundary, EndReason, FenceBreach, PluginFault};
use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_protocol::messages::{EventKind, FlightPhase, Name, bounded};
use vizflyt_protocol::time::HostTime;

use super::Flight;
use crate::guard::{
    GuardMode, HoldReason, LandReason, RESTART_WITHIN_S, SETPOINT_HOLD_S, SIGHT_HOLD_S,
};

impl Flight {
    /// Sets and reports the reason for the end, unless there already is one.
    pub(super) fn decide(&mut self, now: HostTime, reason: EndReason) {
        if self.end.reason().is_none() {
            let text = reason.to_string();
            let kind = EventKind::Ended(reason);
            self.end.handle(now, &kind);
            self.notice(kind, text);
        }
    }

    /// Ends the flight for a reason of this runtime.
    pub(super) fn end_for(&mut self, now: HostTime, reason: EndReason) {
        let brakes_first = reason.brakes_first();
        self.decide(now, reason);
        self.come_down(now, brakes_first);
    }

    /// Lands, by LAND or after braking; on the ground, ends the flight.
    pub(super) fn come_down(&mut self, now: HostTime, brakes_first: bool) {
        match self.phase {
            FlightPhase::Connecting | FlightPhase::Preparing | FlightPhase::Waiting => {
                self.landed_at = Some(now);
                let why = self.end.reason().map_or(String::new(), ToString::to_string);
                self.enter(now, FlightPhase::Landed, &why);
            }
            FlightPhase::TakingOff | FlightPhase::Flying | FlightPhase::Holding => {
                match &mut self.guard {
                    Some(guard) if brakes_first => return guard.brake_and_land(now),
                    Some(guard) => guard.land(),
                    None => {}
                }
                self.enter(now, FlightPhase::Landing, &self.landing_text());
            }
            FlightPhase::Landing | FlightPhase::Landed => {}
        }
    }

    pub(super) fn landing_text(&self) -> String {
        let how = if self.pilot_flies { "hands off" } else { "landing" };
        self.end.reason().map_or(how.to_owned(), |reason| format!("{how}: {reason}"))
    }

    /// Handles a mode change by another party in any phase: a failsafe of the autopilot, a ground station, or a pilot,
    /// who has priority. A landing continues, no matter who ordered it.
    pub(super) fn taken_over(&mut self, now: HostTime, mode: u32) {
        self.taken = Some(mode);
        self.pilot_flies |= mode != CopterMode::Land as u32;
        let reason = EndReason::TakenOver { mode };
        if self.end.reason().is_some() && self.pilot_flies {
            self.notice(EventKind::Note, format!("hands off: {reason}"));
        }
        self.end_for(now, reason);
    }

    /// Follows the guard's mode: its holds and landings become those of the flight.
    pub(super) fn follow_guard(&mut self, now: HostTime, mode: GuardMode) {
        let former = self.guard_mode.replace(mode);
        match mode {
            GuardMode::Landing(reason) => {
                if let Some(reason) = self.guard_end_reason(now, reason) {
                    self.decide(now, reason);
                }
                if self.phase != FlightPhase::Landing {
                    self.enter(now, FlightPhase::Landing, &self.landing_text());
                }
            }
            GuardMode::Holding(HoldReason::Requested) | GuardMode::Following => {
                if self.phase == FlightPhase::Holding {
                    self.enter(now, FlightPhase::Flying, "the plugin flies again");
                }
            }
            GuardMode::Holding(reason) => {
                if former != Some(mode) {
                    let why = match reason {
                        HoldReason::Requested => "the plugin asks to hold".to_owned(),
                        HoldReason::NoSetpoint => self.why_silent(now).to_string(),
                        HoldReason::Restarting => "the plugin is being started again".to_owned(),
                        HoldReason::PoseStale => {
                            let allowed_s = self.vehicle.map_or(0.0, |vehicle| vehicle.allowance_s);
                            let hold_after_s = self.pose_ages().hold_after_s + allowed_s;
                            format!("the pose is older than {hold_after_s:.2} s")
                        }
                        HoldReason::PoseUnsure => {
                            let off_m = self.vehicle.map_or(0.0, |vehicle| vehicle.off_m());
                            format!("the pose may be off by {off_m:.2} m")
                        }
                        HoldReason::ImagesOld => {
                            format!("the plugin's images are older than {SIGHT_HOLD_S} s")
                        }
                        HoldReason::Ending => {
                            self.end.reason().map_or(String::new(), ToString::to_string)
                        }
                    };
                    self.enter(now, FlightPhase::Holding, &format!("holding: {why}"));
                }
            }
        }
    }

    /// Returns the reason for the guard's landing; `None` if the flight ordered it.
    fn guard_end_reason(&self, now: HostTime, reason: LandReason) -> Option<EndReason> {
        let breach = |beyond_m: f64, boundary| {
            let vehicle = self.vehicle.as_ref();
            EndReason::Geofence(FenceBreach {
                p_world_m: vehicle.map(|vehicle| vehicle.p_world_m).unwrap_or_default(),
                margin_m: -beyond_m,
                boundary,
                speed_mps: vehicle.map_or(0.0, |vehicle| vehicle.v_world_mps.length()),
                overshoot_m: beyond_m,
            })
        };
        Some(match reason {
            LandReason::Requested => EndReason::PluginLanded,
            LandReason::NoPlugin => {
                let why = self.restart_reason.as_deref().unwrap_or("it was to be started again");
                let why = bounded(why);
                EndReason::Plugin(PluginFault::NotBack { within_s: RESTART_WITHIN_S, why })
            }
            LandReason::NoSetpoint(_) => self.why_silent(now),
            LandReason::PoseLost(age_s) => EndReason::PoseLost { age_s },
            LandReason::PoseUnsure(off_m) => EndReason::PoseUnsure { off_m },
            LandReason::ImagesOld(age_s) => EndReason::ImagesOld { age_s },
            LandReason::OutsideFence(outside_m) => breach(outside_m, Boundary::Geofence),
            LandReason::InNoFly(inside_m) => breach(inside_m, Boundary::NoFly(Name::new())),
            LandReason::Ordered => return None,
        })
    }

    /// Returns why the setpoint is missing: the plugin is silent, receives no image, or its replies are rejected.
    fn why_silent(&self, now: HostTime) -> EndReason {
        let answered_s = self.replied_at.map(|at| now.seconds_since(at));
        let is_answering = answered_s.is_some_and(|answered_s| answered_s < SETPOINT_HOLD_S);
        EndReason::Plugin(match self.unanswered {
            // While other images are answered, a new image without a reply does not count as silence.
            Some((image, at)) if !is_answering => {
                PluginFault::NoAnswer { image, silent_s: now.seconds_since(at) }
            }
            None if !is_answering => return EndReason::NoImage,
            _ if let Some(fault) = self.refused => PluginFault::Refused(fault),
            _ => PluginFault::NoSetpoint,
        })
    }
}
