//! Model of a plugin for the runtime, after `jetson/runtime/examples/misbehave.rs`: it flies well for twenty images,
//! then causes its fault. The reports of a supervisor (exits, signals, memory, processes) are given here as texts;
//! `supervisor/tests.rs` and `misbehave` use real processes.

use std::collections::VecDeque;

use glam::DVec3;
use vizflyt_protocol::messages::{
    Axes, EventKind, FlightPhase, FromPlugin, Setpoint, ToPlugin, YawTarget, bounded,
};
use vizflyt_protocol::time::HostTime;

/// Behaviour of a plugin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Deed {
    /// Requests this velocity from the first image on. [m/s, world]
    World(DVec3),
    Panic,
    Spin,
    Sleep,
    Leak,
    Fork,
    Exit,
    Segfault,
    Nan,
    Infinite,
    Outside,
    Flood,
    Types,
    Print,
    Land,
}

/// Reaction to an image.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant)] // Why: few per flight, in a test.
enum Act {
    /// Reply after a delay. [s]
    Reply(f64, Setpoint),
    /// `on_image` does not return.
    Hang,
    /// Reports a failure before the process ends.
    Fail(&'static str),
    /// The process ends after a delay, with the supervisor's message. [s]
    End(f64, &'static str),
    /// Replies without end.
    Flood,
    /// Bytes that are not a message.
    Garbage,
}

/// Input of the runtime.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant)] // Why: few per flight, in a test.
pub(crate) enum Output {
    /// The process has opened its end of the shared memory.
    Attached,
    /// A message, or its decoding error.
    Message(Result<FromPlugin, String>),
    /// The process has ended, with the supervisor's message.
    Exited(&'static str),
}

/// A plugin and its restarted processes.
pub(crate) struct Plugin {
    deeds: VecDeque<Deed>,
    /// Images seen while flying.
    images: u64,
    flies: bool,
    /// Output that has not reached the runtime yet.
    outputs: VecDeque<(HostTime, Output)>,
    /// End of the running `on_image`.
    busy_until: HostTime,
    /// Newest image that `on_image` has not seen.
    waiting: Option<u64>,
    /// The process has ended or hangs.
    is_gone: bool,
    /// Instant of the first deed.
    pub(crate) deed_at: Option<HostTime>,
}

/// End time of a process that is not ready to see images.
const NOT_READY: HostTime = HostTime::from_ns(u64::MAX);
/// Number of images before the fault.
const GOOD_IMAGES: u64 = 20;
/// Number of images until 200 MB are leaked, 20 MB each.
const LEAKS: u64 = 10;
/// Duration of `on_image`. [s]
const ON_IMAGE_S: f64 = 0.005;
/// Time from the start of a process to its attachment, and from there until it is ready: as a Python plugin. [s]
const STARTS_S: f64 = 0.5;
/// Time from the last message of a failed process to its end. [s]
const LAST_WORDS_S: f64 = 0.02;
/// Time from the end of a process until the runtime detects it. [s]
const NOTICED_S: f64 = 0.003;
/// Number of replies in a flood, and their interval. [ns]
const FLOOD: i64 = 10_000;
const FLOOD_NS: i64 = 100_000;
/// Velocity before the fault. [m/s, heading]
const FORWARD_MPS: f64 = 0.5;

impl Plugin {
    /// Starts a plugin with these faults, one for each start of its process.
    pub(crate) fn start(now: HostTime, deeds: &[Deed]) -> Self {
        let mut plugin = Self {
            deeds: deeds.iter().copied().collect(),
            images: 0,
            flies: false,
            outputs: VecDeque::new(),
            busy_until: now,
            waiting: None,
            is_gone: false,
            deed_at: None,
        };
        plugin.start_process(now);
        plugin
    }

    /// Restarts its process.
    pub(crate) fn start_process(&mut self, now: HostTime) {
        (self.images, self.flies, self.waiting, self.is_gone) = (0, false, None, false);
        self.busy_until = NOT_READY;
        self.outputs.clear();
        self.outputs.push_back((now.plus_seconds(STARTS_S), Output::Attached));
    }

    /// Returns the next time at which the plugin has work.
    pub(crate) fn due(&self) -> Option<HostTime> {
        let image = self.waiting.map(|_| self.busy_until).filter(|_| !self.is_gone);
        self.outputs.front().map(|(at, _)| *at).into_iter().chain(image).min()
    }

    /// Handles a message of the runtime.
    pub(crate) fn handle_message(&mut self, now: HostTime, message: &ToPlugin) {
        match message {
            ToPlugin::Start(_) => {
                self.busy_until = now.plus_seconds(STARTS_S);
                let ready = FromPlugin::Ready { name: bounded("model") };
                self.outputs.push_back((self.busy_until, Output::Message(Ok(ready))));
            }
            ToPlugin::Event(event) => {
                if let EventKind::Phase(phase) = event.kind {
                    self.flies = matches!(phase, FlightPhase::Flying | FlightPhase::Holding);
                }
            }
            ToPlugin::Stop => {}
        }
    }

    /// Handles an image; a busy plugin keeps only the newest.
    pub(crate) fn handle_image(&mut self, seq: u64) {
        self.waiting = Some(seq);
    }

    /// Returns the next output.
    pub(crate) fn poll(&mut self, now: HostTime) -> Option<Output> {
        if !self.is_gone
            && now >= self.busy_until
            && let Some(seq) = self.waiting.take()
        {
            self.on_image(now, seq);
        }
        self.outputs.pop_front_if(|(at, _)| *at <= now).map(|(_, output)| output)
    }

    fn on_image(&mut self, now: HostTime, seq: u64) {
        let reply = |at: HostTime, setpoint| FromPlugin::Reply {
            seq,
            entered: now,
            returned: at,
            setpoint: Some(setpoint),
        };
        let mut put = |at: HostTime, output| self.outputs.push_back((at, output));
        self.images += u64::from(self.flies);
        let deed = self.deeds.front().copied().expect("it has something to do");
        let is_good = self.images <= GOOD_IMAGES && !matches!(deed, Deed::World(_));
        if !is_good {
            self.deed_at.get_or_insert(now);
        }
        let act =
            if is_good { forward() } else { deed.act(self.images - GOOD_IMAGES.min(self.images)) };
        match act {
            Act::Reply(after_s, setpoint) => {
                self.busy_until = now.plus_seconds(after_s);
                put(self.busy_until, Output::Message(Ok(reply(self.busy_until, setpoint))));
            }
            Act::Hang => self.is_gone = true,
            Act::Fail(reason) => {
                let failed = FromPlugin::Failed { reason: bounded(reason) };
                put(now, Output::Message(Ok(failed)));
                put(
                    now.plus_seconds(LAST_WORDS_S),
                    Output::Exited("the plugin ended by itself (exit status 101)"),
                );
                self.is_gone = true;
            }
            Act::End(after_s, sentence) => {
                put(now.plus_seconds(after_s), Output::Exited(sentence));
                self.is_gone = true;
            }
            Act::Flood => {
                for count in 0..FLOOD {
                    let at = now.plus_ns(count * FLOOD_NS);
                    put(at, Output::Message(Ok(reply(at, Setpoint::Hold))));
                }
                self.is_gone = true;
            }
            Act::Garbage => put(now, Output::Message(Err("it is cut short".to_owned()))),
        }
        if self.is_gone && self.deeds.len() > 1 {
            self.deeds.pop_front();
        }
    }
}

/// Returns the reply of a plugin that flies well.
fn forward() -> Act {
    let v_mps = DVec3::X * FORWARD_MPS;
    Act::Reply(ON_IMAGE_S, Setpoint::Velocity { v_mps, axes: Axes::Heading, yaw: YawTarget::Keep })
}

impl Deed {
    /// Returns the reaction to an image, counted from 1 since the fault began.
    fn act(self, image: u64) -> Act {
        let reply = |setpoint| Act::Reply(ON_IMAGE_S, setpoint);
        let velocity = |v_mps| reply(Setpoint::velocity(v_mps, YawTarget::Keep));
        match self {
            Self::World(v_mps) => velocity(v_mps),
            Self::Panic => Act::Fail("panicked at misbehave.rs:92: index 3 out of range"),
            Self::Spin | Self::Print => Act::Hang,
            Self::Sleep => match forward() {
                Act::Reply(_, setpoint) => Act::Reply(3.0, setpoint),
                act => act,
            },
            Self::Leak if image <= LEAKS => forward(),
            Self::Leak => Act::End(
                NOTICED_S,
                "the plugin used more than its 200 MB of memory and was ended; look for what grows with each image",
            ),
            Self::Fork => Act::End(
                0.1,
                "the plugin started more than its 40 processes and threads and was ended; look for what starts them",
            ),
            Self::Exit => Act::End(NOTICED_S, "the plugin ended by itself (exit status 0)"),
            Self::Segfault => Act::End(
                NOTICED_S,
                "the plugin was killed by SIGSEGV: it touched memory that is not its own",
            ),
            Self::Nan => velocity(DVec3::NAN),
            Self::Infinite => velocity(DVec3::INFINITY),
            Self::Outside => {
                reply(Setpoint::Position { p_world_m: DVec3::splat(1000.0), yaw: YawTarget::Keep })
            }
            Self::Flood => Act::Flood,
            Self::Types => Act::Garbage,
            Self::Land => reply(Setpoint::Land),
        }
    }
}
