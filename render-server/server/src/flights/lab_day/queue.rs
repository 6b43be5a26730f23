//! Queue of teams for each vehicle, in the order of booking. Pure.

use serde::{Deserialize, Serialize};

/// Bookings of a day, in the order in which they are called.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Queue {
    next_id: u64,
    bookings: Vec<Booking>,
}

/// Booking of a team.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Booking {
    pub id: u64,
    pub team: String,
    pub vehicle: String,
    pub state: BookingState,
    /// Time of the booking. [ms since 1970]
    pub booked_unix_ms: u64,
    /// Time of the last call. [ms since 1970]
    pub called_unix_ms: Option<u64>,
    /// Time of the end. [ms since 1970]
    pub ended_unix_ms: Option<u64>,
    /// Number of calls for which the team did not appear.
    pub passed_over: u32,
}

/// State of a booking.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BookingState {
    Waiting,
    /// Called to fly.
    Called,
    /// Turn ended.
    Done,
    /// Withdrawn by the team or the instructor.
    Withdrawn,
}

impl BookingState {
    /// Returns whether it is waiting or called.
    fn is_open(self) -> bool {
        matches!(self, Self::Waiting | Self::Called)
    }
}

impl Queue {
    /// Returns all bookings, the open ones in the order in which they are called.
    pub fn bookings(&self) -> &[Booking] {
        &self.bookings
    }

    /// Returns the called booking of a vehicle.
    pub fn called(&self, vehicle: &str) -> Option<&Booking> {
        self.bookings.iter().find(|b| b.vehicle == vehicle && b.state == BookingState::Called)
    }

    /// Returns the place of a waiting booking in its vehicle's queue, from 1.
    pub fn place(&self, id: u64) -> Option<usize> {
        let booking =
            self.bookings.iter().find(|b| b.id == id && b.state == BookingState::Waiting)?;
        let waiting = self
            .bookings
            .iter()
            .filter(|b| b.vehicle == booking.vehicle && b.state == BookingState::Waiting);
        waiting.take_while(|b| b.id != id).count().checked_add(1)
    }

    /// Books for a team; returns the booking's number.
    ///
    /// # Errors
    /// An invalid name, a team that is already in a queue, or a full queue.
    pub fn book(&mut self, team: &str, vehicle: &str, now_unix_ms: u64) -> Result<u64, String> {
        let team = team.trim();
        let length = team.chars().count();
        if !(1..=MAX_NAME).contains(&length) || team.chars().any(char::is_control) {
            return Err(format!("a team's name has 1 to {MAX_NAME} letters, this one {length}"));
        }
        let open = || self.bookings.iter().filter(|b| b.state.is_open());
        if let Some(known) = open().find(|b| b.team == team) {
            return Err(format!("{team} is in the queue of {} already", known.vehicle));
        }
        if open().count() >= MAX_OPEN {
            return Err(format!(
                "the queue is full with {MAX_OPEN} teams; book when some have flown"
            ));
        }
        if self.bookings.len() >= MAX_BOOKINGS
            && let Some(oldest) = self.bookings.iter().position(|b| !b.state.is_open())
        {
            self.bookings.remove(oldest);
        }
        self.next_id += 1;
        self.bookings.push(Booking {
            id: self.next_id,
            team: team.to_owned(),
            vehicle: vehicle.to_owned(),
            state: BookingState::Waiting,
            booked_unix_ms: now_unix_ms,
            called_unix_ms: None,
            ended_unix_ms: None,
            passed_over: 0,
        });
        Ok(self.next_id)
    }

    /// Calls the next team of a vehicle; returns its name.
    ///
    /// # Errors
    /// A team is called already, or no team waits.
    pub fn call_next(&mut self, vehicle: &str, now_unix_ms: u64) -> Result<&str, String> {
        if let Some(called) = self.called(vehicle) {
            return Err(format!(
                "{} is called on {vehicle}; end its turn or pass it over first",
                called.team
            ));
        }
        let next = self
            .bookings
            .iter_mut()
            .find(|b| b.vehicle == vehicle && b.state == BookingState::Waiting);
        let next = next.ok_or_else(|| format!("no team waits for {vehicle}"))?;
        (next.state, next.called_unix_ms) = (BookingState::Called, Some(now_unix_ms));
        Ok(&next.team)
    }

    /// Moves the called team of a vehicle to the end of the queue, because it did not appear. Returns its name.
    ///
    /// # Errors
    /// No team is called.
    pub fn pass_over(&mut self, vehicle: &str) -> Result<String, String> {
        let at = self.called_at(vehicle)?;
        let mut booking = self.bookings.remove(at);
        booking.state = BookingState::Waiting;
        booking.passed_over = booking.passed_over.saturating_add(1);
        let team = booking.team.clone();
        self.bookings.push(booking);
        Ok(team)
    }

    /// Ends the turn of a vehicle's called team; returns its name.
    ///
    /// # Errors
    /// No team is called.
    pub fn end(&mut self, vehicle: &str, now_unix_ms: u64) -> Result<String, String> {
        let at = self.called_at(vehicle)?;
        let booking = &mut self.bookings[at];
        (booking.state, booking.ended_unix_ms) = (BookingState::Done, Some(now_unix_ms));
        Ok(booking.team.clone())
    }

    /// Withdraws a waiting booking; returns its team.
    ///
    /// # Errors
    /// The booking does not exist, or is not waiting.
    pub fn withdraw(&mut self, id: u64, now_unix_ms: u64) -> Result<String, String> {
        let found =
            self.bookings.iter_mut().find(|b| b.id == id && b.state == BookingState::Waiting);
        let booking = found.ok_or_else(|| format!("no booking {id} waits"))?;
        (booking.state, booking.ended_unix_ms) = (BookingState::Withdrawn, Some(now_unix_ms));
        Ok(booking.team.clone())
    }

    /// Returns whether a parsed queue is one that the methods above can produce.
    pub(super) fn is_sound(&self) -> bool {
        let open = self.bookings.iter().filter(|b| b.state.is_open()).count();
        let is_known = |b: &Booking| (1..=self.next_id).contains(&b.id) && !b.team.is_empty();
        let mut ids: Vec<_> = self.bookings.iter().map(|b| b.id).collect();
        ids.sort_unstable();
        ids.dedup();
        let mut called: Vec<_> = self
            .bookings
            .iter()
            .filter(|b| b.state == BookingState::Called)
            .map(|b| &b.vehicle)
            .collect();
        let all_called = called.len();
        called.sort_unstable();
        called.dedup();
        self.bookings.len() <= MAX_BOOKINGS
            && open <= MAX_OPEN
            && ids.len() == self.bookings.len()
            && called.len() == all_called
            && self.next_id < u64::MAX
            && self.bookings.iter().all(is_known)
    }

    fn called_at(&self, vehicle: &str) -> Result<usize, String> {
        let found = self
            .bookings
            .iter()
            .position(|b| b.vehicle == vehicle && b.state == BookingState::Called);
        found.ok_or_else(|| format!("no team is called on {vehicle}"))
    }
}

/// Maximum length of a team's name. [characters]
const MAX_NAME: usize = 40;
/// Maximum of open bookings.
const MAX_OPEN: usize = 64;
/// Maximum of stored bookings, including ended ones.
const MAX_BOOKINGS: usize = 512;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn calls_teams_in_turn_and_moves_a_no_show_to_the_end() {
        let mut queue = Queue::default();
        let ants = queue.book("ants", "wasp", 1).unwrap();
        let bees = queue.book(" bees ", "wasp", 2).unwrap();
        let other = queue.book("cats", "fly", 3).unwrap();
        assert_eq!([ants, bees, other].map(|id| queue.place(id)), [Some(1), Some(2), Some(1)]);
        assert_eq!(queue.call_next("wasp", 10), Ok("ants"));
        let refusal = queue.call_next("wasp", 11).unwrap_err();
        assert_eq!(refusal, "ants is called on wasp; end its turn or pass it over first");
        assert_eq!([ants, bees].map(|id| queue.place(id)), [None, Some(1)]);
        assert_eq!(queue.pass_over("wasp"), Ok("ants".to_owned()));
        assert_eq!([bees, ants].map(|id| queue.place(id)), [Some(1), Some(2)]);
        assert_eq!(queue.call_next("wasp", 12), Ok("bees"));
        assert_eq!(queue.end("wasp", 20), Ok("bees".to_owned()));
        assert_eq!(queue.withdraw(ants, 21), Ok("ants".to_owned()));
        assert_eq!(queue.call_next("wasp", 22), Err("no team waits for wasp".to_owned()));
        assert_eq!(queue.end("wasp", 22), Err("no team is called on wasp".to_owned()));
        let ants = queue.bookings().iter().find(|b| b.id == ants).unwrap();
        assert_eq!(
            (ants.passed_over, ants.called_unix_ms, ants.ended_unix_ms),
            (1, Some(10), Some(21))
        );
    }

    #[test]
    fn a_team_has_one_booking_and_a_valid_name() {
        let mut queue = Queue::default();
        queue.book("ants", "wasp", 1).unwrap();
        assert_eq!(
            queue.book("ants", "fly", 2).unwrap_err(),
            "ants is in the queue of wasp already"
        );
        for name in ["", "  ", "a\nb", &"x".repeat(41)] {
            assert!(queue.book(name, "wasp", 3).is_err(), "{name:?}");
        }
        queue.call_next("wasp", 4).unwrap();
        queue.end("wasp", 5).unwrap();
        assert!(queue.book("ants", "wasp", 6).is_ok(), "it may fly again");
    }

    #[test]
    fn a_queue_is_bounded() {
        let mut queue = Queue::default();
        for n in 0..MAX_OPEN {
            queue.book(&n.to_string(), "wasp", 0).unwrap();
        }
        assert!(queue.book("more", "wasp", 0).unwrap_err().starts_with("the queue is full"));
        for n in 0..2 * MAX_BOOKINGS as u64 {
            queue.call_next("wasp", n).unwrap();
            queue.end("wasp", n).unwrap();
            queue.book(&format!("team {n}"), "wasp", n).unwrap();
        }
        assert!(queue.is_sound() && queue.bookings().len() <= MAX_BOOKINGS);
    }

    proptest! {
        #[test]
        fn any_commands_leave_a_consistent_queue(orders in prop::collection::vec((0..6_u8, 0..4_u8, 0..2_u8), 0..80)) {
            let mut queue = Queue::default();
            for (at, (order, team, vehicle)) in orders.into_iter().enumerate() {
                let (team, vehicle) = (["a", "b", "c", "d"][usize::from(team)], ["v", "w"][usize::from(vehicle)]);
                let at = at as u64;
                let open = queue.bookings().iter().filter(|b| b.state.is_open()).count();
                let done = match order {
                    0 | 1 => queue.book(team, vehicle, at).is_ok().then_some(1),
                    2 => queue.call_next(vehicle, at).is_ok().then_some(0),
                    3 => queue.pass_over(vehicle).is_ok().then_some(0),
                    4 => queue.end(vehicle, at).is_ok().then_some(-1),
                    _ => queue.withdraw(at / 2, at).is_ok().then_some(-1),
                };
                let now = queue.bookings().iter().filter(|b| b.state.is_open()).count();
                // No booking is lost or added.
                prop_assert_eq!(now as i64 - open as i64, done.unwrap_or(0));
                prop_assert!(queue.is_sound());
            }
        }
    }
}
