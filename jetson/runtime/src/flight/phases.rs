//! Actions of the flight at a tick, by phase.

use vizflyt_protocol::flight_end::{EndReason, Missing};
use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_protocol::messages::{EventKind, FlightPhase, bounded};
use vizflyt_protocol::time::HostTime;

use super::{Flight, LinkView, Orders};
use crate::guard::{Guard, GuardMode, GuardOutput, HoldReason, Lagging, Slowed};

/// Share of the take-off height that counts as reached: near the height ArduCopter slows down, and hands over at 0.9 m
/// of a 1 m take-off.
const REACHED: f64 = 0.9;
/// Maximum measured speed of a vehicle at rest. [m/s]
const AT_REST_MPS: f64 = 0.3;
/// Maximum time from the accepted take-off to the height. ArduCopter climbs at 0.5 m/s or more. [s]
const CLIMB_WITHIN_S: f64 = 20.0;
/// Time disarmed after which the vehicle has landed. Longer than the reordering of packets. [s]
const DISARMED_S: f64 = 0.5;
/// Maximum duration of a landing, after which the flight ends: from 4 m at ArduCopter's 0.3 to 0.5 m/s, plus the
/// detection of the touch-down. [s]
const LAND_WITHIN_S: f64 = 60.0;
/// Without a link, a landing cannot be detected; the flight ends after this time. [s]
const LOST_WHILE_LANDING_S: f64 = 10.0;
/// After an interrupt: maximum time for the confirmation of LAND. [s]
const INTERRUPT_S: f64 = 1.0;
/// Minimum time between two notices of the same kind. [s]
const REMIND_S: f64 = 5.0;

impl Flight {
    /// Lands a vehicle that an earlier runtime has left in the air, and returns whether there is one. Without this, our
    /// heartbeats would prevent the autopilot's failsafe from landing it.
    fn lands_former_flight(&mut self, now: HostTime, link: &LinkView) -> bool {
        let left = link.connected && link.armed && link.mode == CopterMode::Guided as u32;
        if left {
            self.decide(now, EndReason::LeftInAir);
            self.enter(now, FlightPhase::Landing, &self.landing_text());
        }
        left
    }

    pub(super) fn connecting(&mut self, now: HostTime, link: &LinkView) {
        if self.lands_former_flight(now, link) {
            return;
        }
        let missing = if self.arena.is_none() {
            Some(self.server_down.clone().map_or(Missing::Server, Missing::Connection))
        } else if !self.plugin_ready {
            Some(Missing::Plugin)
        } else if !link.connected {
            Some(Missing::Heartbeat)
        } else {
            None
        };
        match missing {
            Some(missing) => self.wait_for(now, missing),
            None => self.enter(
                now,
                FlightPhase::Preparing,
                "server, plugin and autopilot are ready; preparing",
            ),
        }
    }

    pub(super) fn preparing(&mut self, now: HostTime, link: &LinkView) {
        if self.lands_former_flight(now, link) {
            return;
        }
        let overdue_s = self.vehicle.map(|vehicle| vehicle.overdue_s(now));
        let hold_after_s = self.pose_ages().hold_after_s;
        let missing = if link.armed {
            Some(Missing::Disarmed)
        } else if overdue_s.is_none_or(|overdue_s| overdue_s > hold_after_s) {
            Some(Missing::Pose)
        } else if let Some(why) = self.why_not_at_start() {
            Some(Missing::Start(bounded(&why)))
        } else if self.replied_at.is_none() {
            Some(Missing::Answer)
        } else if let Some(why) = self.sight.why_unfit(now) {
            Some(Missing::Images(bounded(&why)))
        } else {
            link.ready_to_arm.as_ref().err().map(|message| Missing::PreArm(bounded(message)))
        };
        match (missing, self.vehicle) {
            (None, Some(_)) if self.waits_for_start => {
                if self.phase != FlightPhase::Waiting {
                    self.enter(now, FlightPhase::Waiting, "ready; waiting for start to be pressed");
                }
            }
            (None, Some(vehicle)) => {
                self.start_z_m = vehicle.p_world_m.z;
                self.enter(now, FlightPhase::TakingOff, "pre-arm checks passed; taking off");
            }
            (missing, _) => {
                let missing = missing.unwrap_or(Missing::Pose);
                if self.phase == FlightPhase::Waiting {
                    // The time limit for the preparation starts again, because the vehicle was ready.
                    self.started_at = now;
                    let why = format!("no longer ready: {missing}");
                    self.enter(now, FlightPhase::Preparing, &why);
                }
                self.wait_for(now, missing);
            }
        }
    }

    /// Returns why the vehicle is not in a valid state at the start; `None` if it is.
    fn why_not_at_start(&self) -> Option<String> {
        let (vehicle, arena) = (self.vehicle.as_ref()?, self.arena.as_ref()?);
        let outside_m =
            arena.start_box.map_or(0.0, |start| start.signed_distance_m(vehicle.p_world_m));
        if outside_m > 0.0 {
            return Some(format!(
                "the vehicle is {outside_m:.1} m outside the start box; carry it there"
            ));
        }
        let speed_mps = vehicle.v_world_mps.length();
        (speed_mps > AT_REST_MPS)
            .then(|| format!("the vehicle moves, at {speed_mps:.1} m/s; it must stand still"))
    }

    pub(super) fn taking_off(&mut self, now: HostTime, link: &LinkView) {
        let (Some(arena), Some(vehicle)) = (&self.arena, &self.vehicle) else { return };
        if link.took_off && self.took_off_at.is_none() {
            self.took_off_at = Some(now);
        }
        if vehicle.overdue_s(now) > arena.pose_ages.land_after_s {
            return self.end_for(now, EndReason::PoseLost { age_s: vehicle.age_s(now) });
        }
        let Some(took_off_at) = self.took_off_at else { return };
        let risen_m = vehicle.p_world_m.z - self.start_z_m;
        if risen_m >= REACHED * arena.takeoff_height_m {
            self.guard =
                Some(Guard::new(arena, vehicle, link.response, now, self.settings.slip_seed));
            self.unanswered = None;
            self.enter(now, FlightPhase::Flying, "the plugin flies");
        } else if now.seconds_since(took_off_at) > CLIMB_WITHIN_S {
            self.end_for(now, EndReason::ClimbFailed { risen_m, within_s: CLIMB_WITHIN_S });
        }
    }

    pub(super) fn flying(&mut self, now: HostTime, link: &LinkView) -> Orders {
        let (asked_s, arena_s) = self.time_limits_s();
        if self.seconds(now) > asked_s.min(arena_s) {
            let reason = if asked_s < arena_s {
                EndReason::TimeAsked { seconds: asked_s }
            } else {
                EndReason::TimeLimit { limit_s: arena_s }
            };
            self.end_for(now, reason);
        }
        if link.connected && !link.armed {
            self.end_for(now, EndReason::Disarmed);
        }
        let flies = self.phase_flies();
        let (Some(guard), Some(vehicle), true) = (&mut self.guard, &self.vehicle, flies) else {
            return Orders { goal: self.goal(), setpoint: None, replies_to: None };
        };
        guard.see(self.sight.answered_at());
        let (output, mode) = guard.tick(now, vehicle);
        let (fence_stops, slowed) = (guard.fence_stops(), guard.slowed());
        let lagging = guard.lagging();
        self.follow_guard(now, mode);
        if fence_stops {
            self.notice_fence(now);
        }
        if let Some(slowed) = slowed {
            self.notice_slowed(now, slowed);
        }
        if self.lagging != lagging {
            self.lagging = lagging;
            self.notice_lagging(lagging);
        }
        let setpoint = match output {
            GuardOutput::Guided(setpoint) => Some(setpoint),
            GuardOutput::Land => None,
        };
        // In other modes the setpoint is the guard's own.
        let is_reply =
            matches!(mode, GuardMode::Following | GuardMode::Holding(HoldReason::Requested));
        let replies_to = self.accepted_seq.filter(|_| is_reply && setpoint.is_some());
        Orders { goal: self.goal(), setpoint, replies_to }
    }

    pub(super) fn landing(&mut self, now: HostTime, link: &LinkView) {
        if link.armed || !link.connected {
            self.disarmed_at = None;
        } else {
            self.disarmed_at.get_or_insert(now);
        }
        let landed = self.disarmed_at.is_some_and(|at| now.seconds_since(at) >= DISARMED_S);
        let in_land = link.mode == CopterMode::Land as u32;
        let released = self
            .interrupted_at
            .filter(|_| self.has_guardian)
            .is_some_and(|at| (link.connected && in_land) || now.seconds_since(at) > INTERRUPT_S);
        // A pilot who lands has no time limit.
        let landing_s = if self.pilot_flies { 0.0 } else { now.seconds_since(self.phase_at) };
        let silent = !link.connected && now.seconds_since(self.connected_at) > LOST_WHILE_LANDING_S;
        if landed {
            self.landed_at = self.disarmed_at;
            self.enter(now, FlightPhase::Landed, "on the ground, disarmed");
        } else if released {
            self.enter(now, FlightPhase::Landed, "ending; the autopilot completes the landing");
        } else if landing_s > LAND_WITHIN_S {
            self.enter(now, FlightPhase::Landed, "still armed a minute after landing began");
        } else if silent {
            self.enter(now, FlightPhase::Landed, "the autopilot stays silent; its failsafe lands");
        }
    }

    /// Reports that the fence stops the vehicle; again only after [`REMIND_S`] without a stop.
    fn notice_fence(&mut self, now: HostTime) {
        let former = self.fence_stopped_at.replace(now);
        if former.is_none_or(|at| now.seconds_since(at) > REMIND_S) {
            let text = "the plugin asks to leave the geofence; the vehicle stops before it";
            self.notice(EventKind::Note, text.to_owned());
        }
    }

    /// Reports that old images slow the vehicle down; again only after [`REMIND_S`] without slowing.
    fn notice_slowed(&mut self, now: HostTime, Slowed { age_s, share }: Slowed) {
        let former = self.slowed_at.replace(now);
        if former.is_none_or(|at| now.seconds_since(at) > REMIND_S) {
            let text = format!(
                "the plugin's images are {:.0} ms old: flown at {:.0} % of the speed limit until they are fresher",
                age_s * 1e3,
                share * 1e2
            );
            self.notice(EventKind::Note, text);
        }
    }

    /// Reports that the vehicle responds late, or no longer responds late.
    fn notice_lagging(&mut self, lagging: Option<Lagging>) {
        let Some(Lagging { response, measured, share }) = lagging else {
            let text = "the vehicle answers in time: flown at the full speed limit";
            return self.notice(EventKind::Note, text.to_owned());
        };
        let knows = if measured { "answers" } else { "may answer (not measured yet)" };
        let text = format!(
            "the vehicle {knows} {:.1} s late: flown at {:.0} % of the speed limit; ArduCopter answers sooner with \
             PSC_JERK_NE and PSC_JERK_D (before 4.7: PSC_JERK_XY, PSC_JERK_Z) of 20, as `vizflyt doctor vehicle --apply` sets",
            response.lag_s,
            share * 1e2
        );
        self.notice(EventKind::Note, text);
    }

    /// Reports the missing condition every [`REMIND_S`], and gives up at the time limit.
    fn wait_for(&mut self, now: HostTime, missing: Missing) {
        let limit_s = self.settings.ready_within_s;
        if limit_s > 0.0 && now.seconds_since(self.started_at) > limit_s {
            return self.end_for(now, EndReason::NotReady { within_s: limit_s, missing });
        }
        let due = self.reminded_at.unwrap_or(self.phase_at).plus_seconds(REMIND_S);
        if now >= due {
            self.reminded_at = Some(now);
            self.notice(EventKind::Note, format!("waiting: {missing}"));
        }
    }

    /// Returns the time limits of the settings and of the arena; infinite without one. [s]
    fn time_limits_s(&self) -> (f64, f64) {
        let arena_s = self.arena.as_ref().map_or(0.0, |arena| arena.time_limit_s);
        let limit_s = |given_s: f64| if given_s > 0.0 { given_s } else { f64::INFINITY };
        (limit_s(self.settings.time_limit_s), limit_s(arena_s))
    }
}
