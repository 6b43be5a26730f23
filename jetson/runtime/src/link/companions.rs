//! Detects other companions that command this vehicle. Two companions that command one vehicle work against each other:
//! the second is rejected, with the name that the other has announced.
//!
//! A ground station with our system id is not a second companion, but it hides our absence: the autopilot's failsafe
//! counts its heartbeats as ours.
//!
//! Signs of another companion: heartbeats of a companion computer that are not an echo of ours (a number in their
//! unused `custom_mode` differs), and replies of the autopilot to requests that we did not send.

use vizflyt_protocol::mavlink::dialect::{HEARTBEAT_DATA, MavType};
use vizflyt_protocol::time::HostTime;

use super::identity::{COMPONENT_ID, SYSTEM_ID};

/// Prefix of the announced name.
pub(super) const ANNOUNCES: &str = "companion ";
/// Timeout of another companion. [s]
const GONE_AFTER_S: f64 = 5.0;
/// Signs needed: one may be a reply to an earlier run of ours.
const SIGNS: u32 = 3;
/// Heartbeats needed to detect a ground station: a single one may be left over in a bridge.
const BEATS: u32 = 2;
/// Maximum number of other companions stored.
const MAX_OTHERS: usize = 8;
/// MAV_COMP_ID_ONBOARD_COMPUTER to MAV_COMP_ID_ONBOARD_COMPUTER4.
const COMPANIONS: std::ops::RangeInclusive<u8> = 191..=194;

#[derive(Clone, Debug)]
struct Other {
    id: (u8, u8),
    name: Option<String>,
    signs: u32,
    received_at: HostTime,
}

/// Other companions on the vehicle.
#[derive(Clone, Debug)]
pub(super) struct Companions {
    /// Distinguishes our heartbeats from those of another companion with our ids.
    own: u32,
    others: Vec<Other>,
    /// Ground station with our system id: component, number of heartbeats, time of the last one.
    station: Option<(u8, u32, HostTime)>,
}

impl Companions {
    /// Creates an empty list; `own` differs between runtimes.
    pub(super) fn new(own: u32) -> Self {
        Self { own, others: Vec::new(), station: None }
    }

    /// Returns the `custom_mode` of our heartbeats.
    pub(super) fn own(&self) -> u32 {
        self.own
    }

    /// Whether a heartbeat is an echo of ours.
    pub(super) fn is_echo(&self, from: (u8, u8), heartbeat: &HEARTBEAT_DATA) -> bool {
        from == (SYSTEM_ID, COMPONENT_ID) && heartbeat.custom_mode == self.own
    }

    /// Handles a heartbeat that is not from the autopilot.
    pub(super) fn heartbeat(&mut self, now: HostTime, from: (u8, u8), heartbeat: &HEARTBEAT_DATA) {
        let echo = self.is_echo(from, heartbeat);
        let companion = heartbeat.mavtype == MavType::MAV_TYPE_ONBOARD_CONTROLLER
            && COMPANIONS.contains(&from.1);
        if companion && !echo {
            self.sign(now, from);
        } else if from.0 == SYSTEM_ID && !echo {
            let here = |&(_, _, at): &(u8, u32, HostTime)| now.seconds_since(at) < GONE_AFTER_S;
            let beats = self.station.filter(here).map_or(0, |(_, beats, _)| beats);
            self.station = Some((from.1, beats.saturating_add(1), now));
        }
    }

    /// Returns the component of a ground station with our system id, if present.
    pub(super) fn station(&self, now: HostTime) -> Option<u8> {
        let (component, beats, at) = self.station?;
        (beats >= BEATS && now.seconds_since(at) < GONE_AFTER_S).then_some(component)
    }

    /// Handles an unrequested reply of the autopilot that is addressed to `to`.
    pub(super) fn answer(&mut self, now: HostTime, to: (u8, u8)) {
        if COMPANIONS.contains(&to.1) {
            self.sign(now, to);
        }
    }

    /// Handles a text that is neither from the autopilot nor from us.
    pub(super) fn text(&mut self, now: HostTime, from: (u8, u8), text: &str) {
        if let Some(name) = text.strip_prefix(ANNOUNCES)
            && COMPANIONS.contains(&from.1)
        {
            self.sign(now, from);
            if let Some(other) = self.others.iter_mut().find(|other| other.id == from) {
                other.name = Some(name.trim().to_owned());
            }
        }
    }

    fn sign(&mut self, now: HostTime, id: (u8, u8)) {
        self.others.retain(|other| now.seconds_since(other.received_at) < GONE_AFTER_S);
        if let Some(other) = self.others.iter_mut().find(|other| other.id == id) {
            other.signs = other.signs.saturating_add(1);
            other.received_at = now;
        } else if self.others.len() < MAX_OTHERS {
            self.others.push(Other { id, name: None, signs: 1, received_at: now });
        }
    }

    /// Returns a description of another companion, if present.
    pub(super) fn other(&self, now: HostTime) -> Option<String> {
        let here = |other: &&Other| {
            other.signs >= SIGNS && now.seconds_since(other.received_at) < GONE_AFTER_S
        };
        self.others.iter().find(here).map(|other| {
            let (system, component) = other.id;
            let ids = format!("system {system}, component {component}");
            match &other.name {
                Some(name) => format!("\"{name}\" ({ids})"),
                None => format!("another companion ({ids})"),
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn beat(own: u32, mavtype: MavType) -> HEARTBEAT_DATA {
        HEARTBEAT_DATA { custom_mode: own, mavtype, ..Default::default() }
    }

    #[test]
    fn detects_another_companion_but_not_an_echo_or_a_ground_station() {
        let computer = MavType::MAV_TYPE_ONBOARD_CONTROLLER;
        let check = |from: (u8, u8), heartbeat: HEARTBEAT_DATA, expected: Option<&str>| {
            let mut companions = Companions::new(77);
            let mut now = HostTime::from_ns(1_000_000_000);
            for _ in 0..SIGNS {
                assert_eq!(companions.other(now), None);
                now = now.plus_seconds(1.0);
                companions.heartbeat(now, from, &heartbeat);
            }
            assert_eq!(companions.other(now).as_deref(), expected);
            assert_eq!(companions.other(now.plus_seconds(GONE_AFTER_S)), None, "it is gone");
        };
        check((255, 191), beat(77, computer), None);
        check((255, 190), beat(0, MavType::MAV_TYPE_GCS), None);
        check((1, 240), beat(0, computer), None);
        check(
            (255, 191),
            beat(78, computer),
            Some("another companion (system 255, component 191)"),
        );
        check((1, 192), beat(0, computer), Some("another companion (system 1, component 192)"));
    }

    #[test]
    fn detects_a_ground_station_with_our_system_id() {
        let now = HostTime::from_ns(1_000_000_000);
        let station = beat(0, MavType::MAV_TYPE_GCS);
        let mut companions = Companions::new(77);
        companions.heartbeat(now, (254, 190), &station);
        companions.heartbeat(now, (254, 190), &station);
        assert_eq!(companions.station(now), None, "another id");
        companions.heartbeat(now, (255, 190), &station);
        assert_eq!(companions.station(now), None);
        companions.heartbeat(now.plus_seconds(1.0), (255, 190), &station);
        assert_eq!(companions.station(now.plus_seconds(1.0)), Some(190));
        assert_eq!(companions.other(now), None, "it does not fly");
        let later = now.plus_seconds(1.0 + GONE_AFTER_S);
        assert_eq!(companions.station(later), None);
        companions.heartbeat(later, (255, 190), &station);
        assert_eq!(companions.station(later), None, "it counts from the start");
        // Echo of our own heartbeats.
        let mut companions = Companions::new(77);
        for _ in 0..3 {
            companions.heartbeat(now, (255, 191), &beat(77, MavType::MAV_TYPE_ONBOARD_CONTROLLER));
        }
        assert_eq!(companions.station(now), None);
    }

    #[test]
    fn reports_the_name_of_a_companion_that_announced_it() {
        let mut companions = Companions::new(1);
        let now = HostTime::from_ns(1);
        for _ in 0..SIGNS {
            companions.text(now, (255, 191), "companion wasp-jetson");
        }
        let expected = "\"wasp-jetson\" (system 255, component 191)";
        assert_eq!(companions.other(now).as_deref(), Some(expected));
        companions.text(now, (1, 1), "companion of no id");
        assert_eq!(companions.other(now).as_deref(), Some(expected));
    }
}
