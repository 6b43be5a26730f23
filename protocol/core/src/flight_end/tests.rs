//! Tests of each rule with its own flight, of the order of arrival, and of the table in the guide.

extern crate std;

use std::string::{String, ToString};
use std::vec::Vec;
use std::{format, vec};

use glam::DVec3;
use proptest::prelude::*;

use super::*;
use crate::messages::{InvalidSetpoint, OutcomeKind, bounded};
use crate::time::ServerTime;

fn at(s: f64) -> ServerTime {
    ServerTime::ZERO.plus_seconds(s)
}

fn collision() -> Collision {
    Collision {
        p_world_m: DVec3::new(1.0, 2.0, 0.5),
        clearance_m: -0.01,
        with: Obstacle::Scene,
        speed_mps: 2.04,
    }
}

fn breach(margin_m: f64, boundary: Boundary) -> FenceBreach {
    FenceBreach { p_world_m: DVec3::ONE, margin_m, boundary, speed_mps: 3.0, overshoot_m: 0.25 }
}

/// Returns one of each reason.
fn each() -> Vec<EndReason> {
    use EndReason::*;
    vec![
        Finished { seconds: 12.34 },
        Collision(collision()),
        Geofence(breach(-0.1, Boundary::Geofence)),
        TimeLimit { limit_s: 90.0 },
        PoseLost { age_s: 0.52 },
        StopButton,
        LandButton,
        Interrupted,
        TimeAsked { seconds: 5.0 },
        PluginLanded,
        Plugin(PluginFault::ended("exit status 3")),
        NoImage,
        NotReady { within_s: 60.0, missing: Missing::Pose },
        ClimbFailed { risen_m: 0.2, within_s: 20.0 },
        AutopilotRefused(bounded("arming was denied")),
        AutopilotSilent { silent_s: 3.0 },
        AutopilotRestarted,
        Disarmed,
        TakenOver { mode: 5 },
        LeftInAir,
        ServerRefused(bounded("another runtime flies it")),
        ArenaRefused(bounded("limits.max_speed_mps is NaN")),
        ArenaChanged { name: bounded("room") },
        NeverTookOff,
        RecordEnds,
        ImagesOld { age_s: 2.9 },
        PoseUnsure { off_m: 0.27 },
        GuardianFailed,
    ]
}

/// Returns the end of a flight that takes off after one second and then has `events`, in that order.
fn end_of(events: &[(f64, EventKind)]) -> FlightEnd {
    let mut end = FlightEnd::default();
    end.handle(at(1.0), &EventKind::Phase(FlightPhase::TakingOff));
    for (s, kind) in events {
        end.handle(at(*s), kind);
    }
    end
}

#[track_caller]
fn check(events: &[(f64, EventKind)], expected: Option<OutcomeKind>) {
    assert_eq!(end_of(events).reason().map(EndReason::outcome), expected, "{events:?}");
}

#[test]
fn the_earliest_reason_decides() {
    use EventKind::{Collision as Hit, Ended, Finished, Land, Phase};
    let hit = || Hit(collision());
    let finished = Finished { seconds: 9.0 };
    check(&[], None);
    check(&[(5.0, Phase(FlightPhase::Landing))], None);
    check(&[(5.0, hit()), (5.1, Ended(EndReason::PluginLanded))], Some(OutcomeKind::Collided));
    // Contact during the descent, for each sender of the order to land.
    for order in [Land, EventKind::EmergencyStop, Ended(EndReason::PluginLanded)] {
        check(&[(5.0, order), (7.0, hit())], Some(OutcomeKind::Landed));
    }
    check(&[(5.0, finished), (6.0, hit())], Some(OutcomeKind::Finished));
    let lost = EventKind::PoseLost { age_s: 0.2 };
    check(&[(5.0, lost.clone()), (5.1, EventKind::PoseRegained)], None);
    let ended = Ended(EndReason::PoseLost { age_s: 0.5 });
    let late = EventKind::TimeLimit { limit_s: 20.0 };
    check(&[(5.0, lost), (5.3, ended), (21.0, late)], Some(OutcomeKind::Error));
}

#[test]
fn poses_end_a_flight_only_after_take_off() {
    for reason in each() {
        let mut end = FlightEnd::default();
        end.handle(at(0.5), &EventKind::Ended(reason.clone()));
        let counts = !reason.needs_take_off();
        assert_eq!(end.reason().is_some(), counts, "{reason:?}");
        // A later take-off does not make it count either.
        end.handle(at(1.0), &EventKind::Phase(FlightPhase::TakingOff));
        assert_eq!(end.reason().is_some(), counts, "{reason:?}");
        end.handle(at(2.0), &EventKind::TimeLimit { limit_s: 1.0 });
        assert!(end.reason().is_some());
    }
}

#[test]
fn accepts_a_take_off_event_that_arrives_late() {
    let mut end = FlightEnd::default();
    end.handle(at(5.0), &EventKind::Collision(collision()));
    assert_eq!(end.decided(), None);
    end.handle(at(1.0), &EventKind::Phase(FlightPhase::TakingOff));
    assert_eq!(end.decided(), Some((at(5.0), &EndReason::Collision(collision()))));
}

#[test]
fn each_reason_has_its_own_sentence() {
    let check = |reason: EndReason, expected: &str| assert_eq!(reason.to_string(), expected);
    let hit = |with| EndReason::Collision(Collision { with, ..collision() });
    let place = "at (1.00, 2.00, 0.50) m, at 2.0 m/s";
    check(hit(Obstacle::Scene), &format!("collision with an obstacle {place}"));
    check(hit(Obstacle::Floor), &format!("collision with the floor {place}"));
    check(hit(Obstacle::Object(bounded("door"))), &format!("collision with 'door' {place}"));
    let unseen = format!("collision with space that the capture has not seen {place}");
    check(hit(Obstacle::Unseen), &unseen);
    check(hit(Obstacle::Vehicle(bounded("bee"))), &format!("collision with vehicle 'bee' {place}"));
    let left = |margin_m, boundary| EndReason::Geofence(breach(margin_m, boundary));
    check(left(-0.1, Boundary::Ceiling), "beyond the ceiling by 0.10 m");
    check(left(-0.1, Boundary::NoFly(bounded(""))), "beyond a no-fly box by 0.10 m");
    check(
        left(0.4, Boundary::NoFly(bounded("shelf"))),
        "cannot stop before the no-fly box shelf: 0.40 m left, and at 3.0 m/s it would go 0.25 m beyond",
    );
    let plugin = EndReason::Plugin;
    check(plugin(PluginFault::ended("killed by SIGSEGV")), "killed by SIGSEGV");
    check(
        plugin(PluginFault::Refused(InvalidSetpoint::NotFinite)),
        "the plugin's setpoints are refused: a number in it is not finite",
    );
    check(
        plugin(PluginFault::NoAnswer { image: 7, silent_s: 2.0 }),
        "the plugin has not answered image 7 for 2.0 s",
    );
    check(
        EndReason::TakenOver { mode: 5 },
        "the autopilot was switched to Loiter, not by this runtime",
    );
    let missing = Missing::PreArm(bounded("battery low"));
    check(
        EndReason::NotReady { within_s: 20.0, missing },
        "not in the air after 20 s: battery low",
    );
    let sentences: Vec<String> = each().iter().map(ToString::to_string).collect();
    for (k, sentence) in sentences.iter().enumerate() {
        assert!(!sentence.is_empty() && !sentences[..k].contains(sentence), "{sentence}");
    }
}

#[test]
fn truncates_event_text_to_the_maximum() {
    let event = Event::ending(at(1.0), EventKind::Collision(collision()));
    assert!(event.text.starts_with("collision with an obstacle at"), "{}", event.text);
    let why = PluginFault::NotBack { within_s: 10.0, why: bounded(&"ä".repeat(96)) };
    let event = Event::ending(at(1.0), EventKind::Ended(EndReason::Plugin(why)));
    assert!(event.text.len() > 188 && event.text.ends_with('ä'), "{}", event.text);
}

#[test]
fn the_guide_lists_every_reason() {
    const GUIDE: &str = include_str!("../../../../docs/guides/course.md");
    for reason in each() {
        let json = serde_json::to_value(&reason).unwrap();
        let name = match &json {
            serde_json::Value::Object(fields) => fields.keys().next().cloned(),
            name => name.as_str().map(ToString::to_string),
        };
        let row = format!("| `{}` |", name.unwrap());
        let row = GUIDE.lines().find(|line| line.starts_with(&row)).expect(&row);
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        let [_, _, _, outcome, counts, vehicle, card, _] = cells[..] else { panic!("{row}") };
        assert_eq!(outcome, format!("`{}`", reason.outcome()), "{row}");
        assert_eq!(counts, if reason.needs_take_off() { "in flight" } else { "always" }, "{row}");
        assert_eq!(card == "yes", reason.is_failure(), "{row}");
        let lands = if reason.brakes_first() { "brakes, then lands" } else { "lands" };
        assert!(vehicle == lands || vehicle == "-", "{row}");
    }
}

#[test]
fn reasons_survive_serialization() {
    for reason in each() {
        let kind = EventKind::Ended(reason);
        let mut buffer = [0; 512];
        let bytes = postcard::to_slice(&kind, &mut buffer).unwrap();
        assert_eq!(postcard::from_bytes::<EventKind>(bytes), Ok(kind.clone()));
        // Cut at any length, it is an error.
        for len in 0..bytes.len() {
            assert!(postcard::from_bytes::<EventKind>(&bytes[..len]).is_err());
        }
        let json = serde_json::to_string(&kind).unwrap();
        assert_eq!(serde_json::from_str::<EventKind>(&json).unwrap(), kind);
    }
}

proptest! {
    /// The same events in another order have the same end.
    #[test]
    fn the_order_of_arrival_does_not_matter(
        (events, received) in prop::collection::vec(0..each().len() + 3, 1..12).prop_flat_map(|kinds| {
            let kind = |kind: usize| match kind {
                0 => EventKind::Phase(FlightPhase::Flying),
                1 => EventKind::PoseLost { age_s: 0.2 },
                2 => EventKind::Note,
                kind => EventKind::Ended(each()[kind - 3].clone()),
            };
            // After take-off: on the ground the referee reports nothing relevant.
            let stamp = |(k, event)| (2.0 + k as f64, event);
            let events: Vec<_> = kinds.into_iter().map(kind).enumerate().map(stamp).collect();
            (Just(events.clone()), Just(events).prop_shuffle())
        }),
        take_off_received in 0..12_usize,
    ) {
        let mut end = FlightEnd::default();
        for (k, (s, kind)) in received.iter().enumerate() {
            if k == take_off_received.min(received.len() - 1) {
                end.handle(at(1.0), &EventKind::Phase(FlightPhase::TakingOff));
            }
            end.handle(at(*s), kind);
        }
        let expected = end_of(&events);
        prop_assert_eq!(end.decided(), expected.decided());
        let first = events.iter().find_map(|(_, kind)| kind.end_reason());
        prop_assert_eq!(end.reason(), first.as_ref());
    }
}
