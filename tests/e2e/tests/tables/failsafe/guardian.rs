//! The guardian's process: its core between the runtime's socket and the autopilot's port.

use vizflyt_guardian::port::Wanted;
use vizflyt_guardian::pulse::ALIVE_EVERY_S;
use vizflyt_guardian::watch::{Out, Watch};
use vizflyt_protocol::time::HostTime;

use super::rig::{Wires, host};

/// Clock period, as in the guardian's main thread. [ns]
const TICK_NS: i64 = 10_000_000;

/// Message from the guardian to the runtime.
#[derive(Clone, Debug)]
pub(crate) enum ToRuntime {
    /// Bytes from the autopilot.
    Mavlink(Vec<u8>),
    /// A message for people.
    Note(&'static str),
    /// The guardian runs.
    Alive,
    /// The guardian's end of the socket has closed.
    Closed,
}

/// A running guardian.
pub(crate) struct Guardian {
    watch: Watch,
    tick_at: HostTime,
    /// Time at which the runtime's end of the socket closes.
    pub(crate) socket_closes_at: Option<HostTime>,
    /// The autopilot has sent a packet, so its address is known.
    has_partner: bool,
    alive_at: HostTime,
    /// The process is stopped, as if it hangs; nothing closes.
    pub(crate) is_stopped: bool,
}

impl Guardian {
    pub(crate) fn new(now: HostTime) -> Self {
        Self {
            watch: Watch::new(now, Wanted::default()),
            tick_at: now,
            socket_closes_at: None,
            has_partner: false,
            alive_at: now,
            is_stopped: false,
        }
    }

    /// Returns whether the guardian ends.
    pub(crate) fn is_over(&self, now: HostTime) -> bool {
        self.watch.is_over(now)
    }

    /// Returns the next time at which the guardian has work.
    pub(crate) fn due(&self, wires: &Wires) -> Option<HostTime> {
        if self.is_stopped {
            return None;
        }
        let dues = [
            Some(self.tick_at),
            self.socket_closes_at,
            wires.to_guardian.due(),
            wires.from_vehicle.due(),
            wires.feed.due(),
        ];
        dues.into_iter().flatten().min()
    }

    /// Does all work that is due.
    pub(crate) fn turn(&mut self, now: HostTime, wires: &mut Wires) {
        if self.is_stopped {
            return;
        }
        while let Some(bytes) = wires.from_vehicle.receive(now) {
            self.has_partner = true;
            wires.to_runtime.send(now, ToRuntime::Mavlink(bytes.clone()));
            self.watch.handle_autopilot(now, &bytes);
        }
        while let Some(packet) = wires.to_guardian.receive(now) {
            let mut port = Port { now, wires, has_partner: self.has_partner };
            self.watch.handle_runtime(now, &packet, &mut port);
            self.watch.handle_timeout(now, &mut port);
        }
        while let Some(sample) = wires.feed.receive(now) {
            let mut port = Port { now, wires, has_partner: self.has_partner };
            self.watch.handle_pose(now, &sample, host(sample.stamp), &mut port);
        }
        let closes = self.socket_closes_at.take_if(|at| *at <= now).is_some();
        if closes {
            self.watch.handle_end();
        }
        if closes || now >= self.tick_at {
            self.tick_at = now.plus_ns(TICK_NS);
            let mut port = Port { now, wires, has_partner: self.has_partner };
            self.watch.handle_timeout(now, &mut port);
            if now >= self.alive_at {
                self.alive_at = now.plus_seconds(ALIVE_EVERY_S);
                wires.to_runtime.send(now, ToRuntime::Alive);
            }
        }
    }
}

/// The UDP port for the autopilot, and the socket of the runtime.
struct Port<'a> {
    now: HostTime,
    wires: &'a mut Wires,
    has_partner: bool,
}

impl Out for Port<'_> {
    fn send(&mut self, packet: &[u8]) {
        if self.has_partner {
            self.wires.to_vehicle.send(self.now, packet.to_vec());
        }
    }

    fn say(&mut self, sentence: &'static str) {
        self.wires.to_runtime.send(self.now, ToRuntime::Note(sentence));
    }
}
