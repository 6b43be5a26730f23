//! Admission with a limited number of places, for connections to the page and handshakes of runtimes. Pure.
//!
//! An unidentified caller gets a place of its address, and the newest caller is always admitted. At the limit
//! of its address, the one that has waited longest there gives way; if all places are taken, the one that has
//! waited longest at the most crowded address. So an attacker with ten thousand connections displaces its own.
//! A caller that has presented a key moves to the places of its kind, which no other kind can take.

use std::collections::HashMap;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use crate::rate_limit::place;

/// Numbers of places.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Limits {
    /// All unidentified callers.
    pub(crate) strangers: usize,
    /// Unidentified callers at one address (an IPv6 /64).
    pub(crate) by_address: usize,
    /// All teams.
    pub(crate) teams: usize,
    /// One team.
    pub(crate) by_team: usize,
    /// All instructors.
    pub(crate) instructors: usize,
}

/// Identity of a place's holder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Holder {
    /// Unidentified, from this address.
    Stranger(IpAddr),
    /// Presented the key of this vehicle's team.
    Team(String),
    /// Authenticated as an instructor.
    Instructor,
}

/// Id of a place while it is held.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct PlaceId(u64);

/// Taken places. The `T` of each is a signal to its holder to give way.
#[derive(Debug)]
pub(crate) struct Admission<T> {
    limits: Limits,
    next: u64,
    places: HashMap<PlaceId, Place<T>>,
}

#[derive(Debug)]
struct Place<T> {
    holder: Holder,
    /// Waiting for its caller; a holder that is being served does not give way.
    is_waiting: bool,
    since: Instant,
    tell: T,
}

impl<T> Admission<T> {
    /// Creates one with all places free.
    pub(crate) fn new(limits: Limits) -> Self {
        Self { limits, next: 0, places: HashMap::new() }
    }

    /// Admits a caller from `address` as waiting, and returns the holder that gives way. `None` if no holder
    /// can give way.
    pub(crate) fn admit(
        &mut self,
        now: Instant,
        address: IpAddr,
        tell: T,
    ) -> Option<(PlaceId, Option<T>)> {
        let holder = Holder::Stranger(place(address));
        let at_address = self.count(|other| *other == holder);
        let all = self.count(|other| matches!(other, Holder::Stranger(_)));
        let gives_way = if at_address >= self.limits.by_address {
            Some(self.oldest(|other| *other == holder))
        } else if all >= self.limits.strangers {
            let crowd = self.most_crowded_address();
            Some(self.oldest(|other| matches!(other, Holder::Stranger(a) if Some(*a) == crowd)))
        } else {
            None
        };
        if gives_way == Some(None) {
            return None;
        }
        let told = gives_way.flatten().and_then(|id| self.give_way(id));
        let id = PlaceId(self.next);
        self.next += 1;
        self.places.insert(id, Place { holder, is_waiting: true, since: now, tell });
        Some((id, told))
    }

    /// Records the identity of a holder, and returns the holder that gives way to it. It stays unidentified if
    /// all places of its kind are being served.
    pub(crate) fn recognise(&mut self, id: PlaceId, holder: Holder) -> Option<T> {
        if self.places.get(&id)?.holder == holder {
            return None;
        }
        let (kind, most): (fn(&Holder) -> bool, usize) = match &holder {
            Holder::Stranger(_) => return None,
            Holder::Team(_) => (|other| matches!(other, Holder::Team(_)), self.limits.teams),
            Holder::Instructor => (|other| *other == Holder::Instructor, self.limits.instructors),
        };
        // Removed temporarily, so that it does not give way to itself.
        let place = self.places.remove(&id)?;
        let of_team = matches!(holder, Holder::Team(_))
            && self.count(|other| *other == holder) >= self.limits.by_team;
        let (is_full, gives_way) = if of_team {
            (true, self.oldest(|other| *other == holder))
        } else if self.count(kind) >= most {
            (true, self.oldest(kind))
        } else {
            (false, None)
        };
        let told = gives_way.and_then(|id| self.give_way(id));
        let holder = if is_full && told.is_none() { place.holder } else { holder };
        self.places.insert(id, Place { holder, ..place });
        told
    }

    /// Marks the holder of a place as being served, so that it does not give way.
    pub(crate) fn serve(&mut self, id: PlaceId) {
        if let Some(place) = self.places.get_mut(&id) {
            place.is_waiting = false;
        }
    }

    /// Marks the holder of a place as waiting from `now` on.
    pub(crate) fn wait(&mut self, now: Instant, id: PlaceId) {
        if let Some(place) = self.places.get_mut(&id) {
            (place.is_waiting, place.since) = (true, now);
        }
    }

    /// Frees a place.
    pub(crate) fn leave(&mut self, id: PlaceId) {
        self.places.remove(&id);
    }

    /// Removes one waiting unidentified holder, when file descriptors have run out.
    pub(crate) fn make_room(&mut self) -> Option<T> {
        let crowd = self.most_crowded_address();
        let id = self.oldest(|other| matches!(other, Holder::Stranger(a) if Some(*a) == crowd))?;
        self.give_way(id)
    }

    /// Frees the places of all that have waited for `patience` or longer, and returns their signals.
    pub(crate) fn overdue(&mut self, now: Instant, patience: Duration) -> Vec<T> {
        let is_overdue = |_: &PlaceId, place: &mut Place<T>| {
            place.is_waiting && now.saturating_duration_since(place.since) >= patience
        };
        self.places.extract_if(is_overdue).map(|(_, place)| place.tell).collect()
    }

    /// Returns the number of taken places.
    pub(crate) fn len(&self) -> usize {
        self.places.len()
    }

    fn count(&self, is_meant: impl Fn(&Holder) -> bool) -> usize {
        self.places.values().filter(|place| is_meant(&place.holder)).count()
    }

    /// Returns the address with the most waiting unidentified holders.
    fn most_crowded_address(&self) -> Option<IpAddr> {
        let mut crowds: HashMap<IpAddr, usize> = HashMap::new();
        for place in self.places.values().filter(|place| place.is_waiting) {
            if let Holder::Stranger(address) = place.holder {
                *crowds.entry(address).or_default() += 1;
            }
        }
        crowds.into_iter().max_by_key(|&(address, count)| (count, address)).map(|(a, _)| a)
    }

    /// Returns the matching holder that has waited longest; `None` if none of them is waiting.
    fn oldest(&self, is_meant: impl Fn(&Holder) -> bool) -> Option<PlaceId> {
        let meant = self.places.iter().filter(|(_, p)| p.is_waiting && is_meant(&p.holder));
        meant.min_by_key(|(id, place)| (place.since, **id)).map(|(id, _)| *id)
    }

    fn give_way(&mut self, id: PlaceId) -> Option<T> {
        self.places.remove(&id).map(|place| place.tell)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const LIMITS: Limits =
        Limits { strangers: 8, by_address: 4, teams: 4, by_team: 2, instructors: 3 };

    fn ip(last: u8) -> IpAddr {
        [192, 0, 2, last].into()
    }

    fn team(name: &str) -> Holder {
        Holder::Team(name.to_owned())
    }

    struct Door {
        admission: Admission<u32>,
        start: Instant,
        clock_ms: u64,
        count: u32,
    }

    impl Door {
        fn new() -> Self {
            let (admission, start) = (Admission::new(LIMITS), Instant::now());
            Self { admission, start, clock_ms: 0, count: 0 }
        }

        fn now(&mut self) -> Instant {
            self.clock_ms += 1;
            self.start + Duration::from_millis(self.clock_ms)
        }

        /// Admits a caller; returns its place, and the number of the one that gave way.
        fn admit(&mut self, address: IpAddr) -> Option<(PlaceId, Option<u32>)> {
            let now = self.now();
            self.count += 1;
            self.admission.admit(now, address, self.count - 1)
        }
    }

    #[test]
    fn ten_thousand_of_one_address_displace_only_their_own() {
        let mut door = Door::new();
        let (other, _) = door.admit(ip(2)).unwrap();
        for _ in 0..10_000 {
            let (_, out) = door.admit(ip(1)).unwrap();
            assert_ne!(out, Some(0), "another address gives no way");
        }
        assert_eq!(door.admission.len(), 1 + LIMITS.by_address);
        let (_, out) = door.admit(ip(3)).unwrap();
        assert_eq!(out, None, "there is room for another address");
        door.admission.leave(other);
        assert_eq!(door.admission.len(), 1 + LIMITS.by_address);
    }

    #[test]
    fn many_addresses_leave_room_for_one_more() {
        let mut door = Door::new();
        for last in [1, 1, 1, 2, 2, 3, 4, 5] {
            assert_eq!(door.admit(ip(last)).unwrap().1, None);
        }
        assert_eq!(door.admit(ip(6)).unwrap().1, Some(0), "of the most crowded the oldest");
        assert_eq!(door.admission.len(), LIMITS.strangers);
    }

    #[test]
    fn a_served_holder_does_not_give_way() {
        let mut door = Door::new();
        let ids: Vec<_> = (0..4).map(|_| door.admit(ip(1)).unwrap().0).collect();
        door.admission.serve(ids[0]);
        assert_eq!(door.admit(ip(1)).unwrap().1, Some(1));
        for id in &ids {
            door.admission.serve(*id);
        }
        let (last, _) = door.admit(ip(1)).unwrap();
        door.admission.serve(last);
        assert_eq!(door.admit(ip(1)), None, "nobody waits");
        let now = door.now();
        door.admission.wait(now, ids[0]);
        assert_eq!(door.admit(ip(1)).unwrap().1, Some(0));
    }

    #[test]
    fn an_instructor_never_gives_way_to_a_team_or_a_stranger() {
        let mut door = Door::new();
        let (boss, _) = door.admit(ip(1)).unwrap();
        assert_eq!(door.admission.recognise(boss, Holder::Instructor), None);
        for round in 0..1000 {
            let name = ["ant", "bee", "fly"][round % 3];
            let (id, out) = door.admit(ip(1)).unwrap();
            assert_ne!(out, Some(0));
            assert_ne!(door.admission.recognise(id, team(name)), Some(0));
        }
        let teams = door.admission.count(|holder| matches!(holder, Holder::Team(_)));
        assert_eq!(teams, LIMITS.teams);
        assert!(door.admission.count(|holder| *holder == team("ant")) <= LIMITS.by_team);
        assert_eq!(door.admission.count(|holder| *holder == Holder::Instructor), 1);
    }

    #[test]
    fn waiting_too_long_frees_the_place() {
        let mut door = Door::new();
        let (first, _) = door.admit(ip(1)).unwrap();
        door.admission.serve(first);
        door.admit(ip(1));
        let patience = Duration::from_secs(9);
        let late = door.now() + patience;
        assert_eq!(door.admission.overdue(door.start + patience, patience), [0; 0]);
        assert_eq!(door.admission.overdue(late, patience), [1]);
        assert_eq!(door.admission.len(), 1);
    }

    proptest! {
        /// For any calls, no limit is exceeded, and all that gave way are out.
        #[test]
        fn limits_hold(steps in prop::collection::vec((0u8..6, 0u8..5, 0usize..20), 0..400)) {
            let mut door = Door::new();
            let mut inside: Vec<(u32, PlaceId)> = Vec::new();
            let mut gone = Vec::new();
            for (what, address, index) in steps {
                let picked = (!inside.is_empty()).then(|| inside[index % inside.len()].1);
                match (what, picked) {
                    (0 | 1, _) => {
                        let number = door.count;
                        if let Some((id, out)) = door.admit(ip(address)) {
                            inside.push((number, id));
                            gone.extend(out);
                        }
                    }
                    (2, Some(id)) => gone.extend(door.admission.recognise(id, team(["a", "b", "c"][index % 3]))),
                    (3, Some(id)) => gone.extend(door.admission.recognise(id, Holder::Instructor)),
                    (4, Some(id)) => door.admission.serve(id),
                    (_, Some(id)) => {
                        let now = door.now();
                        door.admission.wait(now, id);
                    }
                    (_, None) => {}
                }
                inside.retain(|(number, _)| !gone.contains(number));
                prop_assert_eq!(inside.len(), door.admission.len());
                let count = |kind: fn(&Holder) -> bool| door.admission.count(kind);
                prop_assert!(count(|h| matches!(h, Holder::Stranger(_))) <= LIMITS.strangers);
                prop_assert!(count(|h| matches!(h, Holder::Team(_))) <= LIMITS.teams);
                prop_assert!(count(|h| *h == Holder::Instructor) <= LIMITS.instructors);
                for last in 0..5 {
                    let at = door.admission.count(|h| *h == Holder::Stranger(ip(last)));
                    prop_assert!(at <= LIMITS.by_address);
                }
            }
        }
    }
}
