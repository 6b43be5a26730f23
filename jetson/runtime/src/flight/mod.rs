//! The flight from first contact to disarming: a sans-IO state machine that ties guard, link and
//! plugin together. [`control`](crate::control) drives it at 50 to 200 Hz.
//!
//! ```text
//! Connecting ──▶ Preparing ──▶ TakingOff ──▶ Flying ◀──▶ Holding
//!  server,        origin,       GUIDED, arm,    │  guard     │
//!  autopilot,     pre-arm,      take-off        └─────┬──────┘
//!  plugin         pose, image      │                  ▼
//!                                  └────────────▶ Landing ──▶ Landed
//! ```
//! Where a person is to start it ([`Flight::wait_for_start`]), the flight stays `Waiting` between
//! preparing and taking off, for as long as everything is ready.
//! What ends the flight, and what its outcome is, [`vizflyt_protocol::flight_end`] decides; landing is
//! never taken back.
//!
//! `inputs` handles what happens, `phases` has a function per phase, `sight` knows how old is what the plugin sees,
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

/// Settings of a person.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightSettings {
    /// Give up if not in the air after this long; 0 waits for ever. [s]
    pub ready_within_s: f64,
    /// Land this long after take-off, whatever the arena allows; 0 leaves it to the arena. [s]
    pub time_limit_s: f64,
    /// This vehicle's own limits; of them and the arena's, the stricter wins.
    pub limits: Limits,
    /// Another in each flight, and secret: where places slip that a plugin gives without knowing the pose.
    pub slip_seed: u64,
    /// The cameras that the plugin flies by, by name: each must be fresh. Empty: one fresh camera is enough.
    pub cameras: Vec<String>,
}

impl FlightSettings {
    /// Tightens an arena's limits to this vehicle's own.
    pub fn tighten(&self, arena: &mut ArenaInfo) {
        arena.limits = arena.limits.stricter(&self.limits);
    }
}

/// The link's state at a tick.
#[derive(Clone, Debug)]
pub struct LinkView {
    /// Heartbeats arrive.
    pub connected: bool,
    /// Motors may turn.
    pub armed: bool,
    /// ArduCopter's mode number.
    pub mode: u32,
    /// The mode that somebody else has chosen last, after ours was confirmed.
    pub taken: Option<u32>,
    /// The take-off was accepted.
    pub took_off: bool,
    /// What arming still waits for.
    pub ready_to_arm: Result<(), Cow<'static, str>>,
    /// How the vehicle answers velocities, by its parameters.
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

/// What the flight orders at a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Orders {
    /// The state that the link is to reach.
    pub goal: Goal,
    /// The setpoint to send to the autopilot.
    pub setpoint: Option<GuidedSetpoint>,
    /// The image whose reply this setpoint carries; the same as long as the reply is in force.
    pub replies_to: Option<u64>,
}

/// Something to report to the server, the plugin, the log and the person.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightNotice {
    /// What happened.
    pub kind: EventKind,
    /// One sentence.
    pub text: String,
}

/// One flight. See the module.
#[derive(Debug)]
pub struct Flight {
    settings: FlightSettings,
    phase: FlightPhase,
    phase_at: HostTime,
    started_at: HostTime,
    arena: Option<Box<ArenaInfo>>,
    /// Why the last attempt to connect to the server failed.
    server_down: Option<Text>,
    vehicle: Option<VehicleMotion>,
    start_z_m: f64,
    took_off_at: Option<HostTime>,
    plugin_ready: bool,
    replied_at: Option<HostTime>,
    /// The image whose reply the guard accepted last.
    accepted_seq: Option<u64>,
    sight: Sight,
    /// Oldest image that the plugin has not replied to: its number, and when it got it.
    unanswered: Option<(u64, HostTime)>,
    guard: Option<Guard>,
    guard_mode: Option<GuardMode>,
    end: FlightEnd<Host>,
    /// The mode that somebody else has chosen last.
    taken: Option<u32>,
    /// A pilot flies: nothing is sent any more.
    pilot_flies: bool,
    interrupted_at: Option<HostTime>,
    disarmed_at: Option<HostTime>,
    connected_at: HostTime,
    /// A person must press start before it takes off.
    waits_for_start: bool,
    reminded_at: Option<HostTime>,
    /// Why all setpoints are being refused.
    refused: Option<InvalidSetpoint>,
    landed_at: Option<HostTime>,
    /// Why the plugin was last started again.
    restart_reason: Option<String>,
    /// When the fence last limited the plugin's setpoint.
    fence_stopped_at: Option<HostTime>,
    /// When old images last did.
    slowed_at: Option<HostTime>,
    /// What has been said of a vehicle that answers late.
    lagging: Option<Lagging>,
    notices: VecDeque<FlightNotice>,
}

impl Flight {
    /// Makes a flight that begins at `now`.
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

    /// Returns why the flight ended, once it is over.
    pub fn outcome(&self) -> Option<&EndReason> {
        if self.phase == FlightPhase::Landed { self.end.reason() } else { None }
    }

    /// Returns the newest motion of the vehicle.
    pub fn vehicle(&self) -> Option<&VehicleMotion> {
        self.vehicle.as_ref()
    }

    /// Returns seconds from take-off to `now` or the end of the landing; 0 before. [s]
    pub fn seconds(&self, now: HostTime) -> f64 {
        let end = self.landed_at.unwrap_or(now);
        self.took_off_at.map_or(0.0, |at| end.seconds_since(at))
    }

    /// Returns the oldest image that the plugin has not answered, and when it got it, where the guard holds or lands for
    /// its silence; and whether it lands.
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

    /// Does what is due at `now`; 50 to 200 Hz, see [`crate::steering`].
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

    /// Whether the vehicle stands on the ground, before take-off.
    pub fn is_on_ground(&self) -> bool {
        matches!(
            self.phase,
            FlightPhase::Connecting | FlightPhase::Preparing | FlightPhase::Waiting
        )
    }

    /// Whether the flight can go on without a plugin for a while.
    pub fn can_wait_for_plugin(&self) -> bool {
        self.end.reason().is_none() && (self.is_on_ground() || self.is_airborne())
    }

    fn phase_flies(&self) -> bool {
        matches!(self.phase, FlightPhase::Flying | FlightPhase::Holding)
    }

    fn is_airborne(&self) -> bool {
        self.phase_flies() || self.phase == FlightPhase::TakingOff
    }

    /// Ages of a pose that the arena allows.
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
