//! A plugin as far as its runtime sees it: a model of `jetson/runtime/examples/misbehave.rs`, which flies well for
//! twenty images and then does its deed. What a supervisor finds out (exits, signals, memory, processes) comes here
//! as its sentence; `supervisor/tests.rs` and `misbehave` have the real processes.

use std::collections::VecDeque;

use glam::DVec3;
use vizflyt_protocol::messages::{
    Axes, EventKind, FlightPhase, FromPlugin, Setpoint, ToPlugin, YawTarget, bounded,
};
use vizflyt_protocol::time::HostTime;

/// What a plugin does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Deed {
    /// Asks for this velocity from the first image on. [m/s, world]
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

/// What comes of an image.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant)] // Why: a handful a flight, in a test.
enum Act {
    /// The reply, after so long. [s]
    Reply(f64, Setpoint),
    /// `on_image` does not return.
    Hang,
    /// A failure is reported before the process ends.
    Fail(&'static str),
    /// The process ends after so long, by the supervisor's sentence. [s]
    End(f64, &'static str),
    /// Replies without end.
    Flood,
    /// Bytes that are no message.
    Garbage,
}

/// What the runtime gets.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant)] // Why: a handful a flight, in a test.
pub(crate) enum Output {
    /// The process has opened its end of the shared memory.
    Attached,
    /// A message, or why it cannot be decoded.
    Message(Result<FromPlugin, String>),
    /// The process has ended; the supervisor's sentence.
    Exited(&'static str),
}

/// A plugin, one process after another.
pub(crate) struct Plugin {
    deeds: VecDeque<Deed>,
    /// Images seen while flying.
    images: u64,
    flies: bool,
    /// What is on its way to the runtime.
    outputs: VecDeque<(HostTime, Output)>,
    /// `on_image` runs until then.
    busy_until: HostTime,
    /// Newest image that `on_image` has not seen.
    waiting: Option<u64>,
    /// The process has ended, or never returns.
    is_gone: bool,
    /// Instant of the first deed.
    pub(crate) deed_at: Option<HostTime>,
}

/// A process that is not ready sees no images.
const NOT_READY: HostTime = HostTime::from_ns(u64::MAX);
/// Images flown well before the deed.
const GOOD_IMAGES: u64 = 20;
/// Images in which 200 MB are lost, 20 MB each.
const LEAKS: u64 = 10;
/// Time that `on_image` takes. [s]
const ON_IMAGE_S: f64 = 0.005;
/// From the start of a process until it attaches, and from there until it waits for images: as a plugin in Python. [s]
const STARTS_S: f64 = 0.5;
/// From the last message of a process that has failed to its end. [s]
const LAST_WORDS_S: f64 = 0.02;
/// From the end of a process until the runtime has noticed. [s]
const NOTICED_S: f64 = 0.003;
/// Replies of a flood, and the time between two of them. [ns]
const FLOOD: i64 = 10_000;
const FLOOD_NS: i64 = 100_000;
/// What the sensible part of a flight asks for. [m/s, heading]
const FORWARD_MPS: f64 = 0.5;

impl Plugin {
    /// Starts one that will do these deeds, one after another if it is started again.
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

    /// Starts its process again.
    pub(crate) fn start_process(&mut self, now: HostTime) {
        (self.images, self.flies, self.waiting, self.is_gone) = (0, false, None, false);
        self.busy_until = NOT_READY;
        self.outputs.clear();
        self.outputs.push_back((now.plus_seconds(STARTS_S), Output::Attached));
    }

    /// Returns when it does something.
    pub(crate) fn due(&self) -> Option<HostTime> {
        let image = self.waiting.map(|_| self.busy_until).filter(|_| !self.is_gone);
        self.outputs.front().map(|(at, _)| *at).into_iter().chain(image).min()
    }

    /// Takes a message of the runtime.
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

    /// Takes an image; only the newest is kept for a plugin that is busy.
    pub(crate) fn handle_image(&mut self, seq: u64) {
        self.waiting = Some(seq);
    }

    /// Returns what has come of it.
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
    /// Returns what comes of the image with this number, from 1, since the deed began.
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
