//! The runtime's process: the companion, and a model of its driver `control`, which runs on the wall clock.

use vizflyt_arena::ArenaConfig;
use vizflyt_guardian::pulse::{Pulse, may_bypass};
use vizflyt_protocol::flight_end::PluginFault;
use vizflyt_protocol::messages::{Event, FlightPhase, FromPlugin, Limits, OutcomeKind};
use vizflyt_protocol::time::HostTime;
use vizflyt_runtime::companion::Companion;
use vizflyt_runtime::flight::{FlightSettings, Views};
use vizflyt_runtime::link::LinkSettings;
use vizflyt_runtime::replies::RateLimiter;
use vizflyt_runtime::stream::ServerClock;

use super::guardian::ToRuntime;
use super::plugin::{Deed, Output, Plugin};
use super::rig::{Wires, host};

/// Period of checks of the guardian, as in its client. [ns]
const CHECK_NS: i64 = 50_000_000;

/// Settings of a flight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Settings<'a> {
    /// Behaviour of the plugin.
    pub(crate) deeds: &'a [Deed],
    /// Maximum number of restarts of a plugin that fails in flight.
    pub(crate) restarts: u32,
    /// Time limit in the air; 0 uses the arena's. [s]
    pub(crate) time_limit_s: f64,
}

/// A running runtime.
pub(crate) struct Runtime {
    pub(crate) companion: Companion,
    pub(crate) plugin: Plugin,
    limiter: RateLimiter,
    seq: u64,
    /// Events of the runtime and of the server, with their times.
    pub(crate) events: Vec<(HostTime, Event)>,
    restarts_allowed: u32,
    /// Number of restarts of the plugin.
    pub(crate) restarts: u32,
    /// The plugin's process is ending, and another one will start.
    is_leaving: bool,
    /// The process is stopped, as if it hangs; nothing closes.
    pub(crate) is_stopped: bool,
    /// Time at which the connection to a dead server times out.
    pub(crate) server_lost_at: Option<HostTime>,
    pulse: Pulse,
    check_at: HostTime,
    /// The guardian has failed: the runtime kills it and uses its port.
    pub(crate) has_replaced_guardian: bool,
}

impl Runtime {
    /// Starts a runtime that is connected to the server of `arena`.
    pub(crate) fn new(now: HostTime, arena: &ArenaConfig, settings: Settings<'_>) -> Self {
        let Settings { deeds, restarts, time_limit_s } = settings;
        let settings = FlightSettings {
            ready_within_s: 100.0,
            time_limit_s,
            limits: Limits::NONE,
            slip_seed: 1,
            cameras: Vec::new(),
        };
        let mut companion =
            Companion::new(now, settings, LinkSettings::default(), ServerClock::same());
        companion.handle_arena(now, Box::new(arena.info()));
        companion.upload_fence(now);
        Self {
            companion,
            plugin: Plugin::start(now, deeds),
            limiter: RateLimiter::new(now),
            seq: 0,
            events: Vec::new(),
            restarts_allowed: restarts,
            restarts: 0,
            is_leaving: false,
            is_stopped: false,
            server_lost_at: None,
            pulse: Pulse::new(now),
            check_at: now,
            has_replaced_guardian: false,
        }
    }

    /// Returns the flight phase.
    pub(crate) fn phase(&self) -> FlightPhase {
        self.companion.flight().phase()
    }

    /// Returns the outcome of the flight after its end.
    pub(crate) fn outcome(&self) -> Option<OutcomeKind> {
        self.companion.flight().outcome().map(vizflyt_protocol::flight_end::EndReason::outcome)
    }

    /// Returns the next time at which the runtime has work.
    pub(crate) fn due(&self, wires: &Wires) -> Option<HostTime> {
        if self.is_stopped {
            return None;
        }
        let dues = [
            wires.to_runtime.due(),
            wires.poses.due(),
            wires.events.due(),
            wires.images.due(),
            Some(self.companion.poll_timeout()),
            self.plugin.due(),
            self.server_lost_at,
            if self.has_replaced_guardian { wires.from_vehicle.due() } else { Some(self.check_at) },
        ];
        dues.into_iter().flatten().min()
    }

    /// Does all work that is due.
    pub(crate) fn turn(&mut self, now: HostTime, wires: &mut Wires) {
        if self.is_stopped {
            return;
        }
        while let Some(message) = wires.to_runtime.receive(now) {
            match message {
                ToRuntime::Mavlink(bytes) => self.companion.handle_mavlink(now, &bytes),
                ToRuntime::Note(text) => self.companion.note(now, text),
                ToRuntime::Alive => self.pulse.note_alive(now),
                ToRuntime::Closed => self.replace_guardian(now),
            }
        }
        self.check_guardian(now, wires);
        self.companion.drain_imu(|_, reading| wires.imu.send(now, reading));
        while let Some(sample) = wires.poses.receive(now) {
            self.companion.handle_pose(now, &sample, host(sample.stamp));
        }
        while let Some(event) = wires.events.receive(now) {
            self.events.push((now, event.clone()));
            self.companion.handle_event(now, &event);
        }
        if self.server_lost_at.take_if(|at| *at <= now).is_some() {
            self.companion.server_down("server: timed out");
        }
        while let Some(pose) = wires.images.receive(now) {
            self.seq += 1;
            let mut views = Views::default();
            views[0] = Some(pose);
            self.companion.published(now, self.seq, views);
            self.plugin.handle_image(self.seq);
        }
        while let Some(output) = self.plugin.poll(now) {
            self.handle_plugin(now, output);
        }
        if now >= self.companion.poll_timeout() {
            self.companion.handle_timeout(now);
        }
        while let Some(datagram) = self.companion.poll_transmit() {
            if !self.has_replaced_guardian {
                wires.to_guardian.send(now, datagram.to_vec());
            } else if may_bypass(&datagram) {
                wires.to_vehicle.send(now, datagram.to_vec());
            }
        }
        while self.companion.poll_link_event().is_some() {}
        while let Some(event) = self.companion.poll_event() {
            wires.reports.send(now, event.clone());
            self.events.push((now, event));
        }
        while let Some(message) = self.companion.poll_plugin() {
            self.plugin.handle_message(now, &message);
        }
    }

    /// Receives from the autopilot in place of a guardian that has failed, or checks whether it has.
    fn check_guardian(&mut self, now: HostTime, wires: &mut Wires) {
        if self.has_replaced_guardian {
            while let Some(bytes) = wires.from_vehicle.receive(now) {
                self.companion.handle_mavlink(now, &bytes);
            }
        } else if now >= self.check_at {
            self.check_at = now.plus_ns(CHECK_NS);
            if self.pulse.has_failed(now) {
                self.replace_guardian(now);
            }
        }
    }

    fn replace_guardian(&mut self, now: HostTime) {
        self.has_replaced_guardian = true;
        self.companion.guardian_failed(now);
    }

    fn handle_plugin(&mut self, now: HostTime, output: Output) {
        match output {
            Output::Attached => self.companion.greet_plugin(now),
            Output::Message(received) => match self.limiter.take(now, received) {
                _ if self.is_leaving => {}
                Some(FromPlugin::Ready { .. }) => self.companion.plugin_ready(),
                Some(FromPlugin::Reply { seq, setpoint, .. }) => {
                    self.companion.replied(now, seq, setpoint);
                }
                Some(FromPlugin::Failed { reason }) => {
                    self.plugin_failed(now, &format!("the plugin failed: {reason}"));
                }
                Some(FromPlugin::Odometry(_)) | None => {}
            },
            Output::Exited(sentence) => {
                self.plugin_failed(now, sentence);
                if std::mem::take(&mut self.is_leaving) {
                    self.companion.plugin_gone();
                    self.limiter = RateLimiter::new(now);
                    self.plugin.start_process(now);
                }
            }
        }
    }

    /// Restarts the plugin, or gives up, by the policy of `control`.
    fn plugin_failed(&mut self, now: HostTime, sentence: &str) {
        if self.is_leaving {
            return;
        }
        if self.restarts < self.restarts_allowed && self.companion.flight().can_wait_for_plugin() {
            self.restarts += 1;
            self.is_leaving = true;
            self.companion.plugin_restarts(now, sentence.to_owned());
        } else {
            self.companion.plugin_failed(now, PluginFault::ended(sentence));
        }
    }
}
