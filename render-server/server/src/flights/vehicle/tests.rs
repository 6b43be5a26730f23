//! The lease, the flight's outcome, orders and reports of one vehicle.

use std::net::SocketAddr;

use super::*;
use crate::stream::subscriptions::MOST_WATCHERS;
use glam::DVec3;
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::messages::{HeardEvents, Hello, Limits, PoseAges, Purpose};

pub(crate) fn named(index: usize, name: &str) -> Vehicle {
    let arena = ArenaInfo {
        name: bounded("test"),
        geofence: Volume::aabb(DVec3::ZERO, DVec3::ONE),
        no_fly: [].into_iter().collect(),
        floor_z_m: 0.0,
        limits: Limits::new(1.0, 1.0),
        body_radius_m: 0.1,
        takeoff_height_m: 1.0,
        goal_m: None,
        goal_radius_m: 1.0,
        time_limit_s: 0.0,
        ground_truth: true,
        pose_ages: PoseAges::default(),
        setpoints: vizflyt_protocol::messages::SetpointKinds::USUAL,
        cameras: [].into_iter().collect(),
    };
    let cameras = Cameras::new(Vec::new());
    Vehicle::new(index, name, arena, cameras)
}

fn vehicle() -> Arc<Vehicle> {
    Arc::new(named(0, "vizflyt"))
}

fn hello(boot: u64) -> Hello {
    Hello {
        vehicle: bounded("vizflyt"),
        purpose: Purpose::Fly,
        program: bounded("runtime 0.1"),
        boot,
        heard_events: HeardEvents::default(),
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
async fn a_silent_runtime_loses_its_seat_and_the_newcomer_hears_the_flights_events() {
    let vehicle = vehicle();
    vehicle.tell(EventKind::Note, "before the flight");
    let first = vehicle.take_control(&hello(4), address()).unwrap();
    assert_eq!((first.first_event, first.resumed, vehicle.flights()), (1, false, 1));
    vehicle.report(Telemetry { phase: FlightPhase::Flying, ..Telemetry::default() });
    vehicle.tell(EventKind::EmergencyStop, "stop");
    // As if it had last been heard two seconds ago.
    first.heard(clock::now().plus_seconds(-2.0));
    let second = vehicle.take_control(&hello(5), address()).unwrap();
    first.evicted().await;
    assert_eq!((second.first_event, second.resumed, vehicle.flights()), (1, true, 1));
    drop(first);
    assert_eq!(vehicle.runtime().map(|runtime| runtime.id), Some(second.info.id));
    drop(second);
    // After the landing the next runtime begins a new flight.
    assert!(vehicle.flight().outcome.is_some_and(|event| event.text == "stop"));
    vehicle.report(Telemetry { phase: FlightPhase::Landed, ..Telemetry::default() });
    let third = vehicle.take_control(&hello(6), address()).unwrap();
    assert_eq!((third.first_event, third.resumed, vehicle.flights()), (2, false, 2));
    assert!(vehicle.flight().outcome.is_none() && vehicle.telemetry.borrow().is_none());
}

#[test]
fn the_same_runtime_goes_on_with_its_flight_and_tells_each_event_once() {
    let vehicle = vehicle();
    let first = vehicle.take_control(&hello(7), address()).unwrap();
    assert!(first.hear(1) && first.hear(2) && !first.hear(1));
    drop(first);
    // An outage on the ground; the stop button is pressed meanwhile.
    vehicle.tell(EventKind::EmergencyStop, "stop");
    let second = vehicle.take_control(&hello(7), address()).unwrap();
    assert_eq!((second.first_event, second.resumed, vehicle.flights()), (0, true, 1));
    assert_eq!(second.heard_events, HeardEvents { boot: 7, seq: 2 });
    assert!(!second.hear(2) && second.hear(3));
    drop(second);
    // Another run of the runtime: a new flight, and its events count anew.
    let third = vehicle.take_control(&hello(8), address()).unwrap();
    assert_eq!((third.first_event, third.resumed, vehicle.flights()), (1, false, 2));
    assert_eq!(third.heard_events.of(8), 0);
    assert!(third.hear(1));
}

#[test]
fn only_a_vehicle_that_waits_is_started_and_only_one_on_the_ground_reset() {
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
    assert!(vehicle.flight().outcome.is_some_and(|event| event.kind == EventKind::Land));
    phase(FlightPhase::Landed);
    let flights = vehicle.flights();
    assert_eq!(vehicle.reset("x"), Ok(()));
    assert_eq!(vehicle.flights(), flights + 1);
    assert!(vehicle.flight().took_off.is_none() && vehicle.flight().outcome.is_none());
    drop(lease);
}

#[test]
fn watchers_are_bounded_and_leave_room_behind() {
    let vehicle = vehicle();
    let mut watchers: Vec<_> = (0..MOST_WATCHERS).map(|_| vehicle.watch().unwrap()).collect();
    let refusal = vehicle.watch().unwrap_err();
    assert!(refusal.starts_with("vehicle 'vizflyt' has 8 watchers already"), "{refusal}");
    assert!(vehicle.take_control(&hello(1), address()).is_ok(), "the runtime's lease is another");
    watchers.pop();
    assert!(vehicle.watch().is_ok());
}

#[test]
fn the_first_decisive_event_is_the_outcome_and_a_lost_pose_only_if_it_stays_lost() {
    let vehicle = vehicle();
    let outcome = || vehicle.flight().outcome.map(|event| event.text.as_str().to_owned());
    let lost = EventKind::PoseLost { age_s: 0.2 };
    vehicle.tell(lost.clone(), "on the ground");
    assert_eq!(outcome(), None);
    vehicle.report(Telemetry { phase: FlightPhase::Flying, ..Telemetry::default() });
    vehicle.tell(lost.clone(), "a hiccup");
    assert_eq!(outcome().as_deref(), Some("a hiccup"));
    vehicle.tell(EventKind::PoseRegained, "back");
    assert_eq!(outcome(), None);
    vehicle.tell(lost.clone(), "lost");
    vehicle.tell(EventKind::Finished { seconds: 9.0 }, "goal");
    vehicle.tell(EventKind::EmergencyStop, "later");
    vehicle.tell(lost, "later still");
    assert_eq!(outcome().as_deref(), Some("goal"));
}

#[test]
fn how_long_images_take_to_be_seen_is_what_the_runtime_reports() {
    let vehicle = vehicle();
    vehicle.report_timing(Timing::default());
    assert_eq!(vehicle.seen_after_s(), None, "no image yet");
    let mut timing = Timing::default();
    timing.waterfall.images = 9;
    timing.waterfall.age.p50 = 25.0;
    timing.waterfall.stages.pose.p50 = 5.0;
    vehicle.report_timing(timing);
    assert!((vehicle.seen_after_s().unwrap() - 0.02).abs() < 1e-9);
}

#[test]
fn of_imu_readings_that_wait_the_newest_are_kept() {
    let vehicle = vehicle();
    let reading = |ns| ImuReading {
        stamp: ServerTime::from_ns(ns),
        accel_mps2: DVec3::Z,
        gyro_radps: DVec3::ZERO,
    };
    for ns in 0..100 {
        vehicle.feel(&[reading(2 * ns), reading(2 * ns + 1)]);
    }
    let waiting: Vec<_> = std::iter::from_fn(|| vehicle.next_feeling()).collect();
    assert_eq!((waiting.len(), waiting[0].stamp.as_ns()), (IMU_WAITING, 200 - 64));
}
