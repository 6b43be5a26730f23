//! End of a flight: one enumeration of reasons, one function from events to the outcome, one table of sentences.
//! Runtime, referee, server, page, crash card, grade and leaderboard all use it, so that they report the same end.
//!
//! ```text
//! events of the flight, in any order --> FlightEnd --> the first reason --> outcome, title, sentence
//! ```
//! Rules, as in `docs/guides/course.md`:
//! - The earliest reason by its stamp decides, from any sender. Later events change nothing, for example a collision
//!   after LAND was ordered.
//! - Reasons that need only poses (finish, collision, geofence, time limit, lost pose) count only after take-off
//!   ([`EndReason::needs_take_off`]). Persons, plugin and autopilot can end a flight on the ground, too.
//! - A pose that returns within the arena's `land_after_s` does not end the flight; nor does a warning near the fence.
//!
//! The order in which events arrive does not matter: an outage that delays one side's events does not change that
//! side's final result.

mod reason;
mod sentence;
#[cfg(test)]
mod tests;

pub use reason::{Boundary, Collision, EndReason, FenceBreach, Missing, Obstacle, PluginFault};

use crate::messages::{Event, EventKind, FlightPhase};
use crate::time::{Clock, Server, Stamp};

/// End of one flight, from the events received up to now, on the clock `C`.
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
/// // The land button was pressed before the time was over, but received later.
/// end.handle(at(9.0), &EventKind::Land);
/// assert_eq!(end.decided(), Some((at(9.0), &EndReason::LandButton)));
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct FlightEnd<C: Clock = Server> {
    took_off: Option<Stamp<C>>,
    /// Earliest reason that requires a take-off.
    in_flight: Option<(Stamp<C>, EndReason)>,
    /// Earliest other reason.
    anywhere: Option<(Stamp<C>, EndReason)>,
}

impl<C: Clock> Default for FlightEnd<C> {
    /// Returns the state without any event.
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
    /// Processes one event.
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

    /// Returns the time and reason of the end; `None` while the flight continues.
    pub fn decided(&self) -> Option<(Stamp<C>, &EndReason)> {
        let flies = |at: Stamp<C>| self.took_off.is_some_and(|took_off| at >= took_off);
        let in_flight = self.in_flight.as_ref().filter(|(at, _)| flies(*at));
        let both = in_flight.into_iter().chain(&self.anywhere);
        both.min_by_key(|(at, _)| *at).map(|(at, reason)| (*at, reason))
    }

    /// Returns the reason of the end; `None` while the flight continues.
    pub fn reason(&self) -> Option<&EndReason> {
        self.decided().map(|(_, reason)| reason)
    }
}
