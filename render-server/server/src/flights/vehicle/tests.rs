//! Leases, outcome of a flight, commands and reports of one vehicle.

use std::net::SocketAddr;

use super::*;
use crate::flights::control_lease::MAX_WATCHERS;
use glam::DVec3;
use vizflyt_protocol::flight_end::EndReason;
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::messages::{Limits, Purpose, ReceivedEvents};

pub(crate) fn named(index: usize, name: &str) -> VehicleFlight {
    let arena =
        ArenaInfo::new("test", Volume::aabb(DVec3::ZERO, DVec3::ONE), Limits::new(1.0, 1.0));
    VehicleFlight::new(index, name, arena)
}

fn vehicle() -> VehicleFlight {
    named(0, "vizflyt")
}

fn hello(boot: u64) -> Hello {
    Hello {
        vehicle: bounded("vizflyt"),
        purpose: Purpose::Fly,
        program: bounded("runtime 0.1"),
        boot,
        received_events: ReceivedEvents::default(),
    }
}

fn address() -> SocketAddr {
    "127.0.0.1:9".parse().unwrap()
}

#[test]
fn one_vehicle_has_one_runtime() {
    let vehicle = vehicle();
    let first = vehicle.take_control(&hello(1), address()).unwrap();
    let refusal = vehicle.take_control(&hello(2), address()).unwrap_err();
    assert_eq!(
        refusal,
        "vehicle 'vizflyt' is flown by runtime 0.1 at 127.0.0.1:9; stop that runtime first"
    );
    drop(first);
    assert!(vehicle.runtime().is_none());
    assert!(vehicle.take_control(&hello(3), address()).is_ok());
}

#[tokio::test]
async fn silent_runtime_loses_its_lease_and_the_next_receives_the_flights_events() {
    let vehicle = vehicle();
    vehicle.publish(EventKind::Note, "before the flight");
    let first = vehicle.take_control(&hello(4), address()).unwrap();
    assert_eq!((first.first_event, first.resumed, vehicle.flights()), (1, false, 1));
    vehicle.report(Telemetry { phase: FlightPhase::Flying, ..Telemetry::default() });
    vehicle.publish(EventKind::EmergencyStop, "stop");
    // Simulates that its last message came two seconds ago.
    first.renew(clock::now().plus_seconds(-2.0));
    let second = vehicle.take_control(&hello(5), address()).unwrap();
    first.evicted().await;
    assert_eq!((second.first_event, second.resumed, vehicle.flights()), (1, true, 1));
    drop(first);
    assert_eq!(vehicle.runtime().map(|runtime| runtime.id), Some(second.info.id));
    drop(second);
    // After the landing, the next runtime begins a new flight.
    assert_eq!(vehicle.flight().end.reason(), Some(&EndReason::StopButton));
    vehicle.report(Telemetry { phase: FlightPhase::Landed, ..Telemetry::default() });
    let third = vehicle.take_control(&hello(6), address()).unwrap();
    assert_eq!((third.first_event, third.resumed, vehicle.flights()), (2, false, 2));
    assert!(vehicle.flight().end.decided().is_none() && vehicle.telemetry.borrow().is_none());
}

#[test]
fn the_same_runtime_resumes_its_flight_and_each_event_counts_once() {
    let vehicle = vehicle();
    let first = vehicle.take_control(&hello(7), address()).unwrap();
    assert!(first.receive_event(1) && first.receive_event(2) && !first.receive_event(1));
    drop(first);
    // An outage on the ground, during which the stop button is pressed.
    vehicle.publish(EventKind::EmergencyStop, "stop");
    let second = vehicle.take_control(&hello(7), address()).unwrap();
    assert_eq!((second.first_event, second.resumed, vehicle.flights()), (0, true, 1));
    assert_eq!(second.received_events, ReceivedEvents { boot: 7, seq: 2 });
    assert!(!second.receive_event(2) && second.receive_event(3));
    drop(second);
    // Another run of the runtime: a new flight, and its events are numbered from the start.
    let third = vehicle.take_control(&hello(8), address()).unwrap();
    assert_eq!((third.first_event, third.resumed, vehicle.flights()), (1, false, 2));
    assert_eq!(third.received_events.of(8), 0);
    assert!(third.receive_event(1));
}

#[test]
fn starts_only_a_waiting_vehicle_and_resets_only_on_the_ground() {
    let vehicle = vehicle();
    let phase = |phase| vehicle.report(Telemetry { phase, ..Telemetry::default() });
    assert!(vehicle.start("x").unwrap_err().contains("--wait"));
    assert!(vehicle.land("x").is_err());
    let lease = vehicle.take_control(&hello(1), address()).unwrap();
    phase(FlightPhase::Preparing);
    assert_eq!(
        vehicle.start("x").unwrap_err(),
        "'vizflyt' does not wait for a start: it is preparing"
    );
    phase(FlightPhase::Waiting);
    assert_eq!(vehicle.start("x"), Ok(()));
    phase(FlightPhase::Flying);
    assert_eq!(vehicle.reset("x").unwrap_err(), "'vizflyt' is flying; land it first");
    assert_eq!(vehicle.land("x"), Ok(()));
    assert_eq!(vehicle.flight().end.reason(), Some(&EndReason::LandButton));
    phase(FlightPhase::Landed);
    let flights = vehicle.flights();
    assert_eq!(vehicle.reset("x"), Ok(()));
    assert_eq!(vehicle.flights(), flights + 1);
    assert!(vehicle.flight().took_off.is_none() && vehicle.flight().end.decided().is_none());
    drop(lease);
}

#[test]
fn limits_watchers_and_frees_their_slots() {
    let vehicle = vehicle();
    let mut watchers: Vec<_> = (0..MAX_WATCHERS).map(|_| vehicle.watch().unwrap()).collect();
    let refusal = vehicle.watch().unwrap_err();
    assert!(refusal.starts_with("vehicle 'vizflyt' has 8 watchers already"), "{refusal}");
    assert!(vehicle.take_control(&hello(1), address()).is_ok(), "the runtime's lease is another");
    watchers.pop();
    assert!(vehicle.watch().is_ok());
}

#[test]
fn the_first_end_is_the_outcome_and_a_returning_pose_is_not() {
    let vehicle = vehicle();
    let outcome = || vehicle.flight().end.reason().cloned();
    vehicle.publish(EventKind::Phase(FlightPhase::TakingOff), "up");
    vehicle.publish(EventKind::PoseLost { age_s: 0.2 }, "a hiccup");
    vehicle.publish(EventKind::PoseRegained, "back");
    assert_eq!(outcome(), None);
    vehicle.publish(EventKind::Finished { seconds: 9.0 }, "goal");
    vehicle.publish(EventKind::EmergencyStop, "later");
    vehicle.publish(EventKind::Ended(EndReason::PoseLost { age_s: 0.5 }), "later still");
    assert_eq!(outcome(), Some(EndReason::Finished { seconds: 9.0 }));
}
