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
//! Why longer than most: one state machine, read best in one place.

#[cfg(test)]
pub(crate) mod tests;

use std::borrow::Cow;
use std::collections::VecDeque;

use vizflyt_protocol::flight_end::{
    Boundary, EndReason, FenceBreach, FlightEnd, Missing, PluginFault,
};
use vizflyt_protocol::mavlink::{CopterMode, GuidedSetpoint};
use vizflyt_protocol::messages::{
    ArenaInfo, Event, EventKind, FlightPhase, InvalidSetpoint, Limits, Name, PoseAges, Setpoint,
    bounded,
};
use vizflyt_protocol::time::{Host, HostTime};

use crate::guard::{
    Fix, Guard, HoldReason, LandReason, Passed, RESTART_WITHIN_S, SETPOINT_HOLD_S, Stance,
};
use crate::link::{Goal, LOST_AFTER_S, Link, LinkEvent};

/// What a person may set.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlightSettings {
    /// Give up if not in the air after this long; 0 waits for ever. [s]
    pub ready_within_s: f64,
    /// Land this long after take-off, whatever the arena allows; 0 leaves it to the arena. [s]
    pub time_limit_s: f64,
    /// This vehicle's own limits; of them and the arena's, the stricter wins.
    pub limits: Limits,
}

impl FlightSettings {
    /// Tightens an arena's limits to this vehicle's own.
    pub fn tighten(&self, arena: &mut ArenaInfo) {
        arena.limits = arena.limits.stricter(&self.limits);
    }
}

/// What happens around the flight.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant)] // Why: handed on by value at once, never stored.
pub enum Input {
    /// The server said what we fly in.
    Arena(Box<ArenaInfo>),
    /// The vehicle was localized.
    Pose(Fix),
    /// The server tells of something; when it was, by our clock.
    Server(Event, HostTime),
    /// The autopilot's side.
    Link(LinkEvent),
    /// The plugin waits for images.
    PluginReady,
    /// An image was handed to the plugin.
    ImagePublished {
        /// Its number.
        seq: u64,
    },
    /// The plugin answered an image.
    Answered {
        /// Its number.
        seq: u64,
        /// What it asks for.
        setpoint: Option<Setpoint>,
    },
    /// The server will not have us, and trying again will not help; why, in a sentence.
    ServerRefused(String),
    /// The plugin is no more.
    PluginFailed(PluginFault),
    /// The plugin is being started again; why, in a sentence. The vehicle holds until it answers.
    PluginRestarts(String),
    /// A person ends the flight.
    Interrupt,
}

/// What the link knows at a tick.
#[derive(Clone, Debug)]
pub struct LinkView {
    /// Heartbeats come.
    pub connected: bool,
    /// Motors may turn.
    pub armed: bool,
    /// ArduCopter's mode number.
    pub mode: u32,
    /// The take-off was accepted.
    pub took_off: bool,
    /// What arming still waits for.
    pub ready_to_arm: Result<(), Cow<'static, str>>,
}

impl LinkView {
    /// Returns what `link` knows at `now`.
    pub fn of(link: &Link, now: HostTime) -> Self {
        let state = link.state();
        Self {
            connected: link.is_connected(),
            armed: state.armed,
            mode: state.mode,
            took_off: link.took_off(),
            ready_to_arm: link.ready_to_arm(now),
        }
    }
}

/// What is to be done now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Orders {
    /// What the link shall bring about.
    pub goal: Goal,
    /// What to send to the autopilot.
    pub setpoint: Option<GuidedSetpoint>,
    /// The image whose answer this setpoint carries; the same as long as the answer is in force.
    pub answers: Option<u64>,
}

/// Something to tell the server, the plugin, the log and the person.
#[derive(Clone, Debug, PartialEq)]
pub struct Notice {
    /// What.
    pub kind: EventKind,
    /// One sentence.
    pub text: String,
}

/// Share of the take-off height that counts as reached: ArduCopter hands over at 90 cm of a metre
/// as it eases into the height.
const REACHED: f64 = 0.9;
/// From the accepted take-off to the height. ArduCopter climbs at 0.5 m/s or more. [s]
const CLIMB_WITHIN_S: f64 = 20.0;
/// Disarmed for this long: landed. Longer than packets take to overtake each other. [s]
const DISARMED_S: f64 = 0.5;
/// A landing that takes longer than this ends the flight all the same. From 4 m at ArduCopter's
/// 0.3 to 0.5 m/s, plus the wait for touch-down. [s]
const LAND_WITHIN_S: f64 = 60.0;
/// Without a link, whether the vehicle has landed cannot be known; wait this long. [s]
const LOST_WHILE_LANDING_S: f64 = 10.0;
/// After an interrupt: time for LAND to be confirmed. [s]
const INTERRUPT_S: f64 = 1.0;
/// How often to say what is being waited for. [s]
const REMIND_S: f64 = 5.0;

/// One flight. See the module.
#[derive(Debug)]
pub struct Flight {
    settings: FlightSettings,
    phase: FlightPhase,
    phase_at: HostTime,
    started_at: HostTime,
    arena: Option<Box<ArenaInfo>>,
    fix: Option<Fix>,
    start_z_m: f64,
    took_off_at: Option<HostTime>,
    plugin_ready: bool,
    answered_at: Option<HostTime>,
    /// The image whose answer the guard took last.
    taken: Option<u64>,
    /// Oldest image that the plugin has not answered: its number, and when it got it.
    unanswered: Option<(u64, HostTime)>,
    guard: Option<Guard>,
    stance: Option<Stance>,
    end: FlightEnd<Host>,
    /// A pilot flies: nothing is sent any more.
    hands_off: bool,
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
    /// When the fence last kept the vehicle from what the plugin asked for.
    fence_stopped_at: Option<HostTime>,
    notices: VecDeque<Notice>,
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
            fix: None,
            start_z_m: 0.0,
            took_off_at: None,
            plugin_ready: false,
            answered_at: None,
            taken: None,
            unanswered: None,
            guard: None,
            stance: None,
            end: FlightEnd::default(),
            hands_off: false,
            interrupted_at: None,
            disarmed_at: None,
            connected_at: now,
            waits_for_start: false,
            reminded_at: None,
            refused: None,
            landed_at: None,
            restart_reason: None,
            fence_stopped_at: None,
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

    /// Returns the newest fix.
    pub fn fix(&self) -> Option<&Fix> {
        self.fix.as_ref()
    }

    /// Returns seconds from take-off to `now` or the end of the landing; 0 before. [s]
    pub fn seconds(&self, now: HostTime) -> f64 {
        let end = self.landed_at.unwrap_or(now);
        self.took_off_at.map_or(0.0, |at| end.seconds_since(at))
    }

    /// Returns the next thing to tell.
    pub fn poll_notice(&mut self) -> Option<Notice> {
        self.notices.pop_front()
    }

    /// Takes note of something that happened.
    pub fn handle(&mut self, now: HostTime, input: Input) {
        match input {
            Input::Arena(arena) => self.handle_arena(now, arena),
            Input::Pose(fix) => {
                if fix.is_valid() {
                    self.fix = Some(fix);
                }
            }
            Input::Server(event, at) => self.handle_server(now, at.min(now), &event),
            Input::Link(event) => self.handle_link(now, event),
            Input::ServerRefused(why) => self.end_for(now, EndReason::ServerRefused(bounded(&why))),
            Input::PluginReady => self.plugin_ready = true,
            Input::ImagePublished { seq } => {
                self.unanswered.get_or_insert((seq, now));
            }
            Input::Answered { seq, setpoint } => self.handle_answer(now, seq, setpoint),
            Input::PluginFailed(fault) => self.end_for(now, EndReason::Plugin(fault)),
            Input::PluginRestarts(why) => self.handle_restart(now, why),
            Input::Interrupt => {
                self.interrupted_at.get_or_insert(now);
                self.end_for(now, EndReason::Interrupted);
            }
        }
    }

    /// Does what is due at `now`; 50 to 200 Hz, see [`crate::steering`].
    pub fn tick(&mut self, now: HostTime, link: &LinkView) -> Orders {
        if link.connected {
            self.connected_at = now;
        }
        match self.phase {
            FlightPhase::Connecting => self.connecting(now, link),
            FlightPhase::Preparing | FlightPhase::Waiting => self.preparing(now, link),
            FlightPhase::TakingOff => self.taking_off(now, link),
            FlightPhase::Flying | FlightPhase::Holding => return self.flying(now, link),
            FlightPhase::Landing => self.landing(now, link),
            FlightPhase::Landed => {}
        }
        Orders { goal: self.goal(), setpoint: None, answers: None }
    }

    fn goal(&self) -> Goal {
        match self.phase {
            _ if self.hands_off => Goal::Prepare,
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

    // ---- inputs ----

    fn handle_arena(&mut self, now: HostTime, mut arena: Box<ArenaInfo>) {
        self.settings.tighten(&mut arena);
        if let Err(why) = crate::guard::check_arena(&arena) {
            return self.end_for(now, EndReason::ArenaRefused(bounded(&why)));
        }
        match &self.arena {
            Some(known) if **known != *arena => {
                // The guard must not keep a fence that is no longer the room's.
                self.end_for(now, EndReason::ArenaChanged { name: arena.name.clone() });
            }
            _ => self.arena = Some(arena),
        }
    }

    fn handle_server(&mut self, now: HostTime, at: HostTime, event: &Event) {
        self.end.handle(at, &event.kind);
        match event.kind {
            EventKind::Start if self.phase == FlightPhase::Waiting => {
                self.waits_for_start = false;
            }
            // Not kept for later: what made it unready may be a person in the net.
            EventKind::Start if self.waits_for_start => {
                let why = "start was pressed before the vehicle was ready; press it again then";
                self.notice(EventKind::Note, why.to_owned());
            }
            _ => {
                // What cannot end it on the ground does not.
                if let (Some(reason), Some(_)) = (event.kind.end_reason(), self.end.reason()) {
                    self.come_down(now, reason.brakes_first());
                }
            }
        }
    }

    fn handle_link(&mut self, now: HostTime, event: LinkEvent) {
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

    fn handle_answer(&mut self, now: HostTime, seq: u64, setpoint: Option<Setpoint>) {
        self.answered_at = Some(now);
        if self.unanswered.is_some_and(|(oldest, _)| oldest <= seq) {
            self.unanswered = None;
        }
        let (Some(guard), None) = (&mut self.guard, self.end.reason()) else { return };
        let Some(setpoint) = setpoint else { return guard.answered(now) };
        match guard.ask(now, setpoint) {
            Ok(()) => {
                self.taken = Some(seq);
                self.refused = None;
            }
            // Once per series; the hold and the landing that follow name it again.
            Err(fault) if self.refused.is_none() => {
                self.refused = Some(fault);
                self.notice(EventKind::Note, format!("setpoint refused: {fault}"));
            }
            Err(_) => {}
        }
    }

    fn handle_restart(&mut self, now: HostTime, why: String) {
        if !self.can_wait_for_plugin() {
            return;
        }
        (self.plugin_ready, self.unanswered, self.answered_at) = (false, None, None);
        if let Some(guard) = &mut self.guard {
            guard.wait_for_plugin(now);
        }
        self.notice(EventKind::Note, format!("{why}; the plugin is started again"));
        if matches!(self.phase, FlightPhase::Preparing | FlightPhase::Waiting) {
            self.enter(now, FlightPhase::Connecting, "waiting for the plugin");
        }
        self.restart_reason = Some(why);
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

    // ---- phases ----

    /// Lands a vehicle that a former runtime has left in the air: our heartbeats would keep the
    /// autopilot's own failsafe from doing so.
    fn is_left_over(&mut self, now: HostTime, link: &LinkView) -> bool {
        let left = link.connected && link.armed && link.mode == CopterMode::Guided as u32;
        if left {
            self.decide(now, EndReason::LeftInAir);
            self.enter(now, FlightPhase::Landing, &self.landing_text());
        }
        left
    }

    fn connecting(&mut self, now: HostTime, link: &LinkView) {
        if self.is_left_over(now, link) {
            return;
        }
        let missing = if self.arena.is_none() {
            Some(Missing::Server)
        } else if !self.plugin_ready {
            Some(Missing::Plugin)
        } else if !link.connected {
            Some(Missing::Heartbeat)
        } else {
            None
        };
        match missing {
            Some(missing) => self.wait_for(now, missing),
            None => self.enter(now, FlightPhase::Preparing, "all are here; preparing"),
        }
    }

    fn preparing(&mut self, now: HostTime, link: &LinkView) {
        if self.is_left_over(now, link) {
            return;
        }
        let pose_age_s = self.fix.map(|fix| now.seconds_since(fix.stamp));
        let hold_after_s = self.pose_ages().hold_after_s;
        let missing = if link.armed {
            Some(Missing::Disarmed)
        } else if pose_age_s.is_none_or(|age_s| age_s > hold_after_s) {
            Some(Missing::Pose)
        } else if self.answered_at.is_none() {
            Some(Missing::Answer)
        } else {
            link.ready_to_arm.as_ref().err().map(|words| Missing::PreArm(bounded(words)))
        };
        match (missing, self.fix) {
            (None, Some(_)) if self.waits_for_start => {
                if self.phase != FlightPhase::Waiting {
                    self.enter(now, FlightPhase::Waiting, "ready; waiting for start to be pressed");
                }
            }
            (None, Some(fix)) => {
                self.start_z_m = fix.p_world_m.z;
                self.enter(now, FlightPhase::TakingOff, "pre-arm checks passed; taking off");
            }
            (missing, _) => {
                let missing = missing.unwrap_or(Missing::Pose);
                if self.phase == FlightPhase::Waiting {
                    // The time to get ready counts anew: it was ready.
                    self.started_at = now;
                    let why = format!("no longer ready: {missing}");
                    self.enter(now, FlightPhase::Preparing, &why);
                }
                self.wait_for(now, missing);
            }
        }
    }

    fn taking_off(&mut self, now: HostTime, link: &LinkView) {
        let (Some(arena), Some(fix)) = (&self.arena, &self.fix) else { return };
        if link.took_off && self.took_off_at.is_none() {
            self.took_off_at = Some(now);
        }
        let pose_age_s = now.seconds_since(fix.stamp);
        if pose_age_s > arena.pose_ages.land_after_s {
            return self.end_for(now, EndReason::PoseLost { age_s: pose_age_s });
        }
        let Some(took_off_at) = self.took_off_at else { return };
        let risen_m = fix.p_world_m.z - self.start_z_m;
        if risen_m >= REACHED * arena.takeoff_height_m {
            self.guard = Some(Guard::new(arena, fix, now));
            self.unanswered = None;
            self.enter(now, FlightPhase::Flying, "the plugin flies");
        } else if now.seconds_since(took_off_at) > CLIMB_WITHIN_S {
            self.end_for(now, EndReason::ClimbFailed { risen_m, within_s: CLIMB_WITHIN_S });
        }
    }

    fn flying(&mut self, now: HostTime, link: &LinkView) -> Orders {
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
        } else if link.connected && link.mode != CopterMode::Guided as u32 {
            self.taken_over(now, link.mode);
        }
        let flies = self.phase_flies();
        let (Some(guard), Some(fix), true) = (&mut self.guard, &self.fix, flies) else {
            return Orders { goal: self.goal(), setpoint: None, answers: None };
        };
        let (passed, stance) = guard.tick(now, fix);
        let fence_stops = guard.fence_stops();
        self.take_stance(now, stance);
        if fence_stops {
            self.tell_of_fence(now);
        }
        let setpoint = match passed {
            Passed::Guided(setpoint) => Some(setpoint),
            Passed::Land => None,
        };
        // Any other stance is the guard's own will.
        let is_answer = matches!(stance, Stance::Passing | Stance::Holding(HoldReason::Asked));
        let answers = self.taken.filter(|_| is_answer && setpoint.is_some());
        Orders { goal: self.goal(), setpoint, answers }
    }

    fn landing(&mut self, now: HostTime, link: &LinkView) {
        if link.armed || !link.connected {
            self.disarmed_at = None;
        } else {
            self.disarmed_at.get_or_insert(now);
        }
        let landed = self.disarmed_at.is_some_and(|at| now.seconds_since(at) >= DISARMED_S);
        let in_land = link.mode == CopterMode::Land as u32;
        let released = self
            .interrupted_at
            .is_some_and(|at| (link.connected && in_land) || now.seconds_since(at) > INTERRUPT_S);
        let landing_s = now.seconds_since(self.phase_at);
        let silent = !link.connected && now.seconds_since(self.connected_at) > LOST_WHILE_LANDING_S;
        if landed {
            self.landed_at = self.disarmed_at;
            self.enter(now, FlightPhase::Landed, "on the ground, disarmed");
        } else if released {
            self.enter(now, FlightPhase::Landed, "leaving; the autopilot lands by itself");
        } else if landing_s > LAND_WITHIN_S {
            self.enter(now, FlightPhase::Landed, "still armed a minute after landing began");
        } else if silent {
            self.enter(now, FlightPhase::Landed, "the autopilot stays silent; its failsafe lands");
        }
    }

    // ---- transitions ----

    fn phase_flies(&self) -> bool {
        matches!(self.phase, FlightPhase::Flying | FlightPhase::Holding)
    }

    fn is_airborne(&self) -> bool {
        self.phase_flies() || self.phase == FlightPhase::TakingOff
    }

    /// Returns when a person wants it landed, and when the arena does; infinite without a limit. [s]
    fn time_limits_s(&self) -> (f64, f64) {
        let arena_s = self.arena.as_ref().map_or(0.0, |arena| arena.time_limit_s);
        let limit_s = |given_s: f64| if given_s > 0.0 { given_s } else { f64::INFINITY };
        (limit_s(self.settings.time_limit_s), limit_s(arena_s))
    }

    fn enter(&mut self, now: HostTime, phase: FlightPhase, why: &str) {
        self.phase = phase;
        self.phase_at = now;
        self.reminded_at = None;
        self.end.handle(now, &EventKind::Phase(phase));
        self.notice(EventKind::Phase(phase), why.to_owned());
    }

    fn notice(&mut self, kind: EventKind, text: String) {
        self.notices.push_back(Notice { kind, text });
    }

    /// Says now and then what is being waited for, and gives up in the end.
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

    /// Tells why the flight ends, if nothing has ended it yet.
    fn decide(&mut self, now: HostTime, reason: EndReason) {
        if self.end.reason().is_none() {
            let text = reason.to_string();
            let kind = EventKind::Ended(reason);
            self.end.handle(now, &kind);
            self.notice(kind, text);
        }
    }

    /// Ends the flight, for a reason of our own.
    fn end_for(&mut self, now: HostTime, reason: EndReason) {
        let brakes_first = reason.brakes_first();
        self.decide(now, reason);
        self.come_down(now, brakes_first);
    }

    /// Lands, by LAND or after braking; on the ground the flight is over.
    fn come_down(&mut self, now: HostTime, brakes_first: bool) {
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

    fn landing_text(&self) -> String {
        self.end.reason().map_or("landing".to_owned(), |reason| format!("landing: {reason}"))
    }

    /// Says that the fence stops the vehicle; once, until it has not for a while.
    fn tell_of_fence(&mut self, now: HostTime) {
        let former = self.fence_stopped_at.replace(now);
        if former.is_none_or(|at| now.seconds_since(at) > REMIND_S) {
            let text = "the plugin asks to leave the geofence; the vehicle stops before it";
            self.notice(EventKind::Note, text.to_owned());
        }
    }

    /// Someone else changed the mode: a failsafe of the autopilot, or a pilot.
    fn taken_over(&mut self, now: HostTime, mode: u32) {
        if CopterMode::from_number(mode) != Some(CopterMode::Land) {
            // The pilot's will goes before ours.
            self.hands_off = true;
        }
        self.end_for(now, EndReason::TakenOver { mode });
    }

    /// Follows the guard: its holds and landings are the flight's.
    fn take_stance(&mut self, now: HostTime, stance: Stance) {
        let former = self.stance.replace(stance);
        match stance {
            Stance::Landing(reason) => {
                if let Some(reason) = self.reason_of(now, reason) {
                    self.decide(now, reason);
                }
                if self.phase != FlightPhase::Landing {
                    self.enter(now, FlightPhase::Landing, &self.landing_text());
                }
            }
            Stance::Holding(HoldReason::Asked) | Stance::Passing => {
                if self.phase == FlightPhase::Holding {
                    self.enter(now, FlightPhase::Flying, "the plugin flies again");
                }
            }
            Stance::Holding(reason) => {
                if former != Some(stance) {
                    let why = match reason {
                        HoldReason::Asked => "the plugin asks to hold".to_owned(),
                        HoldReason::NoSetpoint => self.why_silent(now).to_string(),
                        HoldReason::Restarting => "the plugin is being started again".to_owned(),
                        HoldReason::PoseStale => {
                            format!("the pose is older than {} s", self.pose_ages().hold_after_s)
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

    /// Returns why the guard lands; `None` where it was told to.
    fn reason_of(&self, now: HostTime, reason: LandReason) -> Option<EndReason> {
        let breach = |beyond_m: f64, boundary| {
            let fix = self.fix.as_ref();
            EndReason::Geofence(FenceBreach {
                p_world_m: fix.map(|fix| fix.p_world_m).unwrap_or_default(),
                margin_m: -beyond_m,
                boundary,
                speed_mps: fix.map_or(0.0, |fix| fix.v_world_mps.length()),
                overshoot_m: beyond_m,
            })
        };
        Some(match reason {
            LandReason::Asked => EndReason::PluginLanded,
            LandReason::NoPlugin => {
                let why = self.restart_reason.as_deref().unwrap_or("it was to be started again");
                let why = bounded(why);
                EndReason::Plugin(PluginFault::NotBack { within_s: RESTART_WITHIN_S, why })
            }
            LandReason::NoSetpoint(_) => self.why_silent(now),
            LandReason::PoseLost(age_s) => EndReason::PoseLost { age_s },
            LandReason::OutsideFence(outside_m) => breach(outside_m, Boundary::Geofence),
            LandReason::InNoFly(inside_m) => breach(inside_m, Boundary::NoFly(Name::new())),
            LandReason::Ordered => return None,
        })
    }

    /// Ages of a pose that the arena allows.
    fn pose_ages(&self) -> PoseAges {
        self.arena.as_ref().map(|arena| arena.pose_ages).unwrap_or_default()
    }

    /// Whether the plugin is idle because no image comes.
    fn sees_nothing(&self, now: HostTime) -> bool {
        self.unanswered.is_none()
            && self.answered_at.is_none_or(|at| now.seconds_since(at) >= SETPOINT_HOLD_S)
    }

    /// Why no setpoint comes: the plugin, or nothing for it to see.
    fn why_silent(&self, now: HostTime) -> EndReason {
        EndReason::Plugin(match self.unanswered {
            Some((image, at)) => PluginFault::NoAnswer { image, silent_s: now.seconds_since(at) },
            None if self.sees_nothing(now) => return EndReason::NoImage,
            None if let Some(fault) = self.refused => PluginFault::Refused(fault),
            None => PluginFault::NoSetpoint,
        })
    }
}

/// STATUSTEXT of this severity or worse is worth a person's attention.
const SEVERITY_WARNING: u8 = 4;
