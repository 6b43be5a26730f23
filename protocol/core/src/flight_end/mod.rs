//! How a flight ended, and why: one enumeration of reasons, one function from what happened to the
//! outcome, one table of sentences. Runtime, referee, server, page, crash card, grade and leaderboard
//! all ask it, so that one flight has one end.
//!
//! ```text
//! events of the flight, in any order --> FlightEnd --> the first reason --> outcome, title, sentence
//! ```
//! The rules, as `docs/guides/course.md` has them:
//! - the earliest reason by its stamp decides, whoever gives it; what comes later, a touch after LAND
//!   was ordered among it, changes nothing;
//! - what follows from poses alone (finish, collision, geofence, time limit, lost pose) counts from the take-off
//!   on ([`EndReason::needs_take_off`]); people, plugin and autopilot end a flight on the ground as well;
//! - a pose that comes back within the arena's `land_after_s` ends nothing; neither does a warning near
//!   the fence.
//!
//! The order in which events arrive does not matter: an outage that delays one side's events does
//! not change what that side reports in the end.

mod reason;
mod sentence;
#[cfg(test)]
mod tests;

pub use reason::{Boundary, Collision, EndReason, FenceBreach, Missing, Obstacle, PluginFault};

use crate::messages::{Event, EventKind, FlightPhase};
use crate::time::{Clock, Server, Stamp};

/// The end of one flight by what has happened in it so far, on the clock `C`.
///
/// ```
/// use vizflyt_protocol::flight_end::{EndReason, FlightEnd};
/// use vizflyt_protocol::messages::{EventKind, FlightPhase};
/// use vizflyt_protocol::time::ServerTime;
///
/// let at = |s: f64| ServerTime::ZERO.plus_seconds(s);
/// let mut end = FlightEnd::default();
/// end.handle(at(1.0), &EventKind::Phase(FlightPhase::TakingOff));
/// end.handle(at(9.5), &EventKind::TimeLimit { limit_s: 8.5 });
/// // Pressed before the time was over, and received later.
/// end.handle(at(9.0), &EventKind::Land);
/// assert_eq!(end.decided(), Some((at(9.0), &EndReason::LandButton)));
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct FlightEnd<C: Clock = Server> {
    took_off: Option<Stamp<C>>,
    /// The first reason that needs a take-off.
    in_flight: Option<(Stamp<C>, EndReason)>,
    /// The first of the others.
    anywhere: Option<(Stamp<C>, EndReason)>,
}

impl<C: Clock> Default for FlightEnd<C> {
    /// Nothing has happened yet.
    fn default() -> Self {
        Self { took_off: None, in_flight: None, anywhere: None }
    }
}

impl FlightEnd {
    /// Returns the end of a flight with these events.
    pub fn of<'a>(events: impl IntoIterator<Item = &'a Event>) -> Self {
        let mut end = Self::default();
        events.into_iter().for_each(|event| end.handle(event.stamp, &event.kind));
        end
    }
}

impl<C: Clock> FlightEnd<C> {
    /// Takes what happened at a moment.
    pub fn handle(&mut self, at: Stamp<C>, kind: &EventKind) {
        if *kind == EventKind::Phase(FlightPhase::TakingOff) {
            self.took_off = Some(at);
        }
        let Some(reason) = kind.end_reason() else { return };
        let took_off = self.took_off.filter(|_| reason.needs_take_off());
        let first = if reason.needs_take_off() { &mut self.in_flight } else { &mut self.anywhere };
        let counts = |at: Stamp<C>| took_off.is_none_or(|took_off| at >= took_off);
        let known = first.as_ref().map(|(known, _)| *known).filter(|&known| counts(known));
        if counts(at) && known.is_none_or(|known| at < known) {
            *first = Some((at, reason));
        }
    }

    /// Returns when the flight was decided, and why; `None` while it is not.
    pub fn decided(&self) -> Option<(Stamp<C>, &EndReason)> {
        let flies = |at: Stamp<C>| self.took_off.is_some_and(|took_off| at >= took_off);
        let in_flight = self.in_flight.as_ref().filter(|(at, _)| flies(*at));
        let both = in_flight.into_iter().chain(&self.anywhere);
        both.min_by_key(|(at, _)| *at).map(|(at, reason)| (*at, reason))
    }

    /// Returns why the flight ended; `None` while it goes on.
    pub fn reason(&self) -> Option<&EndReason> {
        self.decided().map(|(_, reason)| reason)
    }
}
