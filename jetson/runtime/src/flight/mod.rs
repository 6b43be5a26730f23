//! Flight from first contact to disarming: a sans-IO state machine that connects guard, link and plugin.
//! [`control`](crate::control) drives it at 50 to 200 Hz.
//!
//! ```text
//! Connecting ──▶ Preparing ──▶ TakingOff ──▶ Flying ◀──▶ Holding
//!  server,        origin,       GUIDED, arm,    │  guard     │
//!  autopilot,     pre-arm,      take-off        └─────┬──────┘
//!  plugin         pose, image      │                  ▼
//!                                  └────────────▶ Landing ──▶ Landed
//! ```
//! If a person must start the flight ([`Flight::wait_for_start`]), it stays `Waiting` between preparing and taking off
//! while everything is ready. [`vizflyt_protocol::flight_end`] decides the end of the flight and its outcome. A landing
//! is final.
//!
//! `inputs` handles inputs, `phases` has a function for each phase, `sight` tracks the age of the plugin's images,
//! `ending` decides why and how the flight ends.

mod ending;
mod inputs;
mod phases;
mod sight;
#[cfg(test)]
pub(crate) mod tests;

use std::borrow::Cow;
use std::collections::VecDeque;

use vizflyt_protocol::flight_end::{EndReason, FlightEnd};
use vizflyt_protocol::mavlink::GuidedSetpoint;
use vizflyt_protocol::messages::{
    ArenaInfo, EventKind, FlightPhase, InvalidSetpoint, Limits, PoseAges, Text,
};
use vizflyt_protocol::time::{Host, HostTime};

use crate::guard::{Guard, GuardMode, HoldReason, Lagging, LandReason, Response, VehicleMotion};
use crate::link::{Goal, Link};

use sight::Sight;
pub use sight::{MAX_IMAGE_AGE_S, MIN_IMAGE_RATE_HZ, Views};

/// Settings of a flight.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightSettings {
    /// Maximum time until the vehicle is in the air; 0: no timeout. [s]
    pub ready_within_s: f64,
    /// Maximum time from take-off to landing, in addition to the arena's limit; 0: only the arena's limit. [s]
    pub time_limit_s: f64,
    /// Limits of this vehicle; the stricter of these and the arena's limits applies.
    pub limits: Limits,
    /// Secret seed, different for each flight, of the drift added to positions when the course hides the pose.
    pub slip_seed: u64,
    /// Names of the cameras that the plugin needs: each must be fresh. Empty: one fresh camera is enough.
    pub cameras: Vec<String>,
}

impl FlightSettings {
    /// Limits the arena's limits to those of this vehicle.
    pub fn tighten(&self, arena: &mut ArenaInfo) {
        arena.limits = arena.limits.stricter(&self.limits);
    }
}

/// State of the link at a tick.
#[derive(Clone, Debug)]
pub struct LinkView {
    /// Whether heartbeats arrive.
    pub connected: bool,
    /// Whether the motors may turn.
    pub armed: bool,
    /// ArduCopter's mode number.
    pub mode: u32,
    /// Last mode chosen by a pilot, a ground station or a failsafe after our mode was confirmed.
    pub taken: Option<u32>,
    /// Whether the take-off was accepted.
    pub took_off: bool,
    /// Condition that arming waits for.
    pub ready_to_arm: Result<(), Cow<'static, str>>,
    /// Response of the vehicle to velocities, according to its parameters.
    pub response: Option<Response>,
}

impl LinkView {
    /// Returns the state of `link` at `now`.
    pub fn of(link: &Link, now: HostTime) -> Self {
        let state = link.state();
        Self {
            connected: link.is_connected(),
            armed: state.armed,
            mode: state.mode,
            taken: link.taken_mode(),
            took_off: link.took_off(),
            ready_to_arm: link.ready_to_arm(now),
            response: link.response(),
        }
    }
}

/// Orders of the flight at a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Orders {
    /// State that the link must reach.
    pub goal: Goal,
    /// Setpoint to send to the autopilot.
    pub setpoint: Option<GuidedSetpoint>,
    /// Number of the image that the plugin answered with this setpoint; unchanged while the reply is in force.
    pub replies_to: Option<u64>,
}

/// Report to the server, the plugin, the log and the console.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightNotice {
    pub kind: EventKind,
    /// Text of one sentence.
    pub text: String,
}

/// One flight; see the module.
#[derive(Debug)]
pub struct Flight {
    settings: FlightSettings,
    phase: FlightPhase,
    phase_at: HostTime,
    started_at: HostTime,
    arena: Option<Box<ArenaInfo>>,
    /// Error of the last attempt to connect to the server.
    server_down: Option<Text>,
    vehicle: Option<VehicleMotion>,
    start_z_m: f64,
    took_off_at: Option<HostTime>,
    plugin_ready: bool,
    replied_at: Option<HostTime>,
    /// Number of the last image with a reply that the guard accepted.
    accepted_seq: Option<u64>,
    sight: Sight,
    /// Oldest image without a reply of the plugin: number, and time of its delivery.
    unanswered: Option<(u64, HostTime)>,
    guard: Option<Guard>,
    guard_mode: Option<GuardMode>,
    end: FlightEnd<Host>,
    /// Last mode chosen by a pilot, a ground station or a failsafe.
    taken: Option<u32>,
    /// Whether a pilot flies; then nothing more is sent.
    pilot_flies: bool,
    interrupted_at: Option<HostTime>,
    /// Whether a guardian completes the landing if this runtime ends.
    has_guardian: bool,
    disarmed_at: Option<HostTime>,
    connected_at: HostTime,
    /// Whether a person must press start before the take-off.
    waits_for_start: bool,
    reminded_at: Option<HostTime>,
    /// Reason for rejecting setpoints, while all are rejected.
    refused: Option<InvalidSetpoint>,
    landed_at: Option<HostTime>,
    /// Reason for the plugin's last restart.
    restart_reason: Option<String>,
    /// Time at which the fence last limited the plugin's setpoint.
    fence_stopped_at: Option<HostTime>,
    /// Time at which old images last limited it.
    slowed_at: Option<HostTime>,
    /// Last reported response of a vehicle that responds late.
    lagging: Option<Lagging>,
    notices: VecDeque<FlightNotice>,
}

impl Flight {
    /// Creates a flight that begins at `now`.
    pub fn new(settings: FlightSettings, now: HostTime) -> Self {
        Self {
            settings,
            phase: FlightPhase::Connecting,
            phase_at: now,
            started_at: now,
            arena: None,
            server_down: None,
            vehicle: None,
            start_z_m: 0.0,
            took_off_at: None,
            plugin_ready: false,
            replied_at: None,
            accepted_seq: None,
            sight: Sight::default(),
            unanswered: None,
            guard: None,
            guard_mode: None,
            end: FlightEnd::default(),
            taken: None,
            pilot_flies: false,
            interrupted_at: None,
            has_guardian: true,
            disarmed_at: None,
            connected_at: now,
            waits_for_start: false,
            reminded_at: None,
            refused: None,
            landed_at: None,
            restart_reason: None,
            fence_stopped_at: None,
            slowed_at: None,
            lagging: None,
            notices: VecDeque::new(),
        }
    }

    /// Keeps the vehicle on the ground until a person presses start.
    pub fn wait_for_start(&mut self) {
        self.waits_for_start = true;
    }

    /// Returns the phase of flight.
    pub fn phase(&self) -> FlightPhase {
        self.phase
    }

    /// Returns the reason for the end, after the flight is over.
    pub fn outcome(&self) -> Option<&EndReason> {
        if self.phase == FlightPhase::Landed { self.end.reason() } else { None }
    }

    /// Returns the newest motion of the vehicle.
    pub fn vehicle(&self) -> Option<&VehicleMotion> {
        self.vehicle.as_ref()
    }

    /// Returns the time from take-off to `now` or to the end of the landing; 0 before. [s]
    pub fn seconds(&self, now: HostTime) -> f64 {
        let end = self.landed_at.unwrap_or(now);
        self.took_off_at.map_or(0.0, |at| end.seconds_since(at))
    }

    /// Returns the oldest image without a reply, the time of its delivery, and whether the vehicle lands, if the guard
    /// holds or lands because of the plugin's silence.
    pub fn silence(&self) -> Option<(u64, HostTime, bool)> {
        let (image, since) = self.unanswered?;
        match self.guard_mode? {
            GuardMode::Holding(HoldReason::NoSetpoint) => Some((image, since, false)),
            GuardMode::Landing(LandReason::NoSetpoint(_)) => Some((image, since, true)),
            _ => None,
        }
    }

    /// Returns the next notice.
    pub fn poll_notice(&mut self) -> Option<FlightNotice> {
        self.notices.pop_front()
    }

    /// Runs everything due at `now`; call it at 50 to 200 Hz, see [`crate::steering`].
    pub fn tick(&mut self, now: HostTime, link: &LinkView) -> Orders {
        if link.connected {
            self.connected_at = now;
        }
        if let Some(mode) = link.taken.filter(|_| link.taken != self.taken) {
            self.taken_over(now, mode);
        }
        match self.phase {
            FlightPhase::Connecting => self.connecting(now, link),
            FlightPhase::Preparing | FlightPhase::Waiting => self.preparing(now, link),
            FlightPhase::TakingOff => self.taking_off(now, link),
            FlightPhase::Flying | FlightPhase::Holding => return self.flying(now, link),
            FlightPhase::Landing => self.landing(now, link),
            FlightPhase::Landed => {}
        }
        Orders { goal: self.goal(), setpoint: None, replies_to: None }
    }

    fn goal(&self) -> Goal {
        match self.phase {
            _ if self.pilot_flies => Goal::Prepare,
            FlightPhase::Connecting | FlightPhase::Preparing | FlightPhase::Waiting => {
                Goal::Prepare
            }
            FlightPhase::TakingOff => {
                Goal::TakeOff(self.arena.as_ref().map_or(0.0, |a| a.takeoff_height_m as f32))
            }
            FlightPhase::Flying | FlightPhase::Holding => Goal::Fly,
            FlightPhase::Landing | FlightPhase::Landed => Goal::Land,
        }
    }

    /// Whether the vehicle is on the ground before take-off.
    pub fn is_on_ground(&self) -> bool {
        matches!(
            self.phase,
            FlightPhase::Connecting | FlightPhase::Preparing | FlightPhase::Waiting
        )
    }

    /// Whether the flight can continue without a plugin for a while.
    pub fn can_wait_for_plugin(&self) -> bool {
        self.end.reason().is_none() && (self.is_on_ground() || self.is_airborne())
    }

    fn phase_flies(&self) -> bool {
        matches!(self.phase, FlightPhase::Flying | FlightPhase::Holding)
    }

    fn is_airborne(&self) -> bool {
        self.phase_flies() || self.phase == FlightPhase::TakingOff
    }

    /// Returns the maximum pose ages of the arena.
    fn pose_ages(&self) -> PoseAges {
        self.arena.as_ref().map(|arena| arena.pose_ages).unwrap_or_default()
    }

    fn enter(&mut self, now: HostTime, phase: FlightPhase, why: &str) {
        self.phase = phase;
        self.phase_at = now;
        self.reminded_at = None;
        self.end.handle(now, &EventKind::Phase(phase));
        self.notice(EventKind::Phase(phase), why.to_owned());
    }

    fn notice(&mut self, kind: EventKind, text: String) {
        self.notices.push_back(FlightNotice { kind, text });
    }
}
