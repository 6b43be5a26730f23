//! One flight has one end: for all occurrences and delays of events, runtime, server, page, crash
//! card, leaderboard and grade report the same end.

use glam::{DQuat, DVec3};
use proptest::prelude::*;
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::verdict::judge;
use vizflyt_protocol::flight_end::{
    Boundary, Collision, EndReason, FenceBreach, Obstacle, PluginFault,
};
use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_protocol::messages::{Event, EventKind, Limits, OutcomeKind, Setpoint, bounded};
use vizflyt_protocol::time::{HostTime, ServerTime};
use vizflyt_runtime::flight::{Flight, FlightSettings, LinkView, Views};
use vizflyt_runtime::guard::{Response, VehicleMotion};
use vizflyt_runtime::link::{Goal, LinkEvent};
use vizflyt_server::flights::events::Origin;
use vizflyt_server::flights::vehicle::VehicleFlight;

/// Lead of the server's clock over the runtime's. [ns]
const AHEAD_NS: u64 = 5_000_000_000;
const TICK_NS: u64 = 20_000_000;

/// An occurrence in flight, on the side that observes it first.
#[derive(Clone, Debug)]
enum Occurrence {
    Server(Box<EventKind>),
    PluginFails,
    PluginLands,
    PluginHangs,
    PilotTakesOver,
    AutopilotRestarts,
    AutopilotRefuses,
    Interrupt,
    PosesStop,
}

fn arena() -> ArenaConfig {
    ArenaConfig::parse(
        r#"
        name = "room"
        scene = "scene.ply"
        body_radius_m = 0.12
        takeoff_height_m = 1.0
        time_limit_s = 9.0
        spawn = { position_m = [1, 2, 0] }
        geofence = { min_m = [0, 0, -0.5], max_m = [11, 4.5, 3.65] }
        limits = { max_speed_mps = 3.0, max_acceleration_mps2 = 6.0 }
        [[cameras]]
        name = "front"
        width_px = 320
        height_px = 240
        horizontal_fov_deg = 90.0
        position_m = [0.06, 0, 0.02]
        "#,
    )
    .unwrap()
}

fn touch() -> EventKind {
    let (p_world_m, clearance_m, speed_mps) = (DVec3::ONE, -0.01, 1.5);
    let with = Obstacle::Object(bounded("door"));
    EventKind::Collision(Collision { p_world_m, clearance_m, with, speed_mps })
}

/// End of a flight, as each side reports it.
#[derive(Debug)]
struct ReportedEnds {
    runtime: EndReason,
    server: Option<EndReason>,
    /// End on leaderboard and crash card.
    verdict: (OutcomeKind, String),
    grade: EndReason,
}

impl ReportedEnds {
    #[track_caller]
    fn check(&self, expected: &EndReason) {
        assert_eq!(&self.runtime, expected, "{self:?}");
        assert_eq!(self.server.as_ref(), Some(expected), "{self:?}");
        assert_eq!(self.verdict, (expected.outcome(), expected.to_string()), "{self:?}");
        assert_eq!(&self.grade, expected, "{self:?}");
    }
}

/// Flies until the vehicle has landed and both sides have received all events. `delays_ms`: delay
/// of events to the runtime and to the server.
fn fly(occurrences: &[(u64, Occurrence)], delays_ms: (u64, u64)) -> ReportedEnds {
    let arena = arena();
    let info = arena.info();
    let vehicle = VehicleFlight::new(0, "vizflyt", info.clone());
    let at = |ns: u64| HostTime::from_ns(ns);
    let stamp = |ns: u64| ServerTime::from_ns(ns + AHEAD_NS);
    let settings = FlightSettings {
        ready_within_s: 20.0,
        time_limit_s: 0.0,
        limits: Limits::NONE,
        slip_seed: 7,
        cameras: Vec::new(),
    };
    let mut flight = Flight::new(settings, at(0));
    flight.handle_arena(at(0), Box::new(info));
    flight.plugin_ready();
    let mut link = LinkView {
        connected: true,
        armed: false,
        mode: 0,
        taken: None,
        took_off: false,
        ready_to_arm: Ok(()),
        response: Some(Response::smooth(0.2, 80.0)),
    };
    let (mut p_m, mut answer, mut poses) = (DVec3::new(1.0, 2.0, 0.0), Some(Setpoint::Hold), true);
    // Each occurrence is a few nanoseconds off the runtime's ticks, and differs from the others.
    let mut waiting: Vec<(u64, Occurrence)> = occurrences
        .iter()
        .zip(1..)
        .map(|((ms, occurrence), k)| (ms * 1_000_000 + k, occurrence.clone()))
        .collect();
    waiting.sort_by_key(|(ns, _)| *ns);
    let mut waiting = std::collections::VecDeque::from(waiting);
    let (mut to_runtime, mut to_server) = (Vec::new(), Vec::new());
    let mut all = Vec::new();
    for tick in 1..2000 {
        let now = tick * TICK_NS;
        while waiting.front().is_some_and(|(ns, _)| *ns <= now) {
            let Some((ns, occurrence)) = waiting.pop_front() else { break };
            match occurrence {
                Occurrence::Server(kind) => {
                    let event = Event { stamp: stamp(ns), kind: *kind, text: bounded("") };
                    vehicle.log(Origin::Server, event.clone());
                    all.push(event.clone());
                    to_runtime.push((ns + delays_ms.0 * 1_000_000, event));
                }
                Occurrence::PluginFails => {
                    let fault = PluginFault::ended("exit status 3");
                    flight.plugin_failed(at(now), fault);
                }
                Occurrence::PluginLands => answer = Some(Setpoint::Land),
                Occurrence::PluginHangs => answer = None,
                Occurrence::PilotTakesOver if link.armed => {
                    link.mode = CopterMode::Loiter as u32;
                    link.taken = Some(link.mode);
                }
                Occurrence::PilotTakesOver => {}
                Occurrence::AutopilotRestarts => {
                    flight.handle_link(at(now), LinkEvent::Rebooted);
                }
                Occurrence::AutopilotRefuses => {
                    flight.handle_link(at(now), LinkEvent::Refused("denied".into()));
                }
                Occurrence::Interrupt => flight.interrupt(at(now)),
                Occurrence::PosesStop => poses = false,
            }
        }
        let due = |(ns, _): &mut (u64, Event)| *ns <= now;
        for (_, event) in to_runtime.extract_if(.., due) {
            let seen = at(event.stamp.as_ns() - AHEAD_NS);
            flight.handle_event(at(now), &event, seen);
        }
        if poses {
            let rotation = DQuat::IDENTITY;
            let (stamp, v_world_mps) = (at(now), DVec3::ZERO);
            let motion = VehicleMotion {
                stamp,
                p_world_m: p_m,
                v_world_mps,
                rotation,
                sigma_m: 0.0,
                allowance_s: 0.0,
            };
            flight.handle_pose(motion);
        }
        let mut views = Views::default();
        views[0] = Some(at(now));
        flight.published(at(now), tick, views);
        if let Some(setpoint) = answer.clone() {
            flight.replied(at(now), tick, Some(setpoint));
        }
        let orders = flight.tick(at(now), &link);
        match orders.goal {
            Goal::TakeOff(_) => {
                (link.mode, link.armed, link.took_off) = (CopterMode::Guided as u32, true, true);
                p_m.z += 0.02;
            }
            Goal::Land if p_m.z > 0.0 => {
                link.mode = CopterMode::Land as u32;
                p_m.z -= 0.02;
            }
            // A pilot may land the vehicle as well.
            Goal::Prepare if link.armed && p_m.z > 0.0 => p_m.z -= 0.02,
            Goal::Land | Goal::Prepare => link.armed = false,
            Goal::Fly => {}
        }
        while let Some(notice) = flight.poll_notice() {
            let event = Event { stamp: stamp(now), kind: notice.kind, text: bounded("") };
            all.push(event.clone());
            to_server.push((now + delays_ms.1 * 1_000_000, event));
        }
        for (_, event) in to_server.extract_if(.., due) {
            vehicle.log(Origin::Page, event);
        }
        let all_received = waiting.is_empty() && to_runtime.is_empty() && to_server.is_empty();
        if all_received && flight.outcome().is_some() {
            break;
        }
    }
    all.sort_by_key(|event| event.stamp);
    let verdict = vehicle.verdict(&arena);
    ReportedEnds {
        runtime: flight.outcome().expect("it has landed").clone(),
        server: vehicle.flight().end.reason().cloned(),
        verdict: (verdict.outcome, verdict.reason),
        grade: judge(&arena, &all, &[]).end,
    }
}

fn occurrence() -> impl Strategy<Value = Occurrence> {
    let breach = FenceBreach {
        p_world_m: DVec3::ONE,
        margin_m: -0.1,
        boundary: Boundary::Ceiling,
        speed_mps: 2.0,
        overshoot_m: 0.3,
    };
    let server = prop::sample::select(vec![
        touch(),
        EventKind::Geofence(breach),
        EventKind::Finished { seconds: 5.0 },
        EventKind::TimeLimit { limit_s: 9.0 },
        EventKind::Ended(EndReason::PoseLost { age_s: 0.5 }),
        EventKind::PoseLost { age_s: 0.2 },
        EventKind::PoseRegained,
        EventKind::EmergencyStop,
        EventKind::Land,
        EventKind::Note,
    ]);
    prop_oneof![
        3 => server.prop_map(|kind| Occurrence::Server(Box::new(kind))),
        2 => prop::sample::select(vec![
            Occurrence::PluginFails,
            Occurrence::PluginLands,
            Occurrence::PluginHangs,
            Occurrence::PilotTakesOver,
            Occurrence::AutopilotRestarts,
            Occurrence::AutopilotRefuses,
            Occurrence::Interrupt,
            Occurrence::PosesStop,
        ]),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]

    #[test]
    fn all_sides_report_the_same_end_of_any_flight(
        occurrences in prop::collection::vec((2500..11_000_u64, occurrence()), 0..6),
        delays_ms in (0..400_u64, 0..400_u64),
    ) {
        let reported = fly(&occurrences, delays_ms);
        reported.check(&reported.runtime);
    }
}

#[test]
fn all_sides_report_a_landing_for_a_touch_after_land_was_pressed() {
    for delays_ms in [(0, 0), (300, 10), (10, 300)] {
        let landed = [(4000, EventKind::Land), (4600, touch())];
        let reported =
            fly(&landed.map(|(ms, kind)| (ms, Occurrence::Server(Box::new(kind)))), delays_ms);
        reported.check(&EndReason::LandButton);
        // If LAND is pressed after the touch, the flight ends with a collision.
        let touched = [(4001, EventKind::Land), (4000, touch())];
        let reported =
            fly(&touched.map(|(ms, kind)| (ms, Occurrence::Server(Box::new(kind)))), delays_ms);
        assert_eq!(reported.runtime.outcome(), OutcomeKind::Collided);
        reported.check(&reported.runtime);
    }
}

#[test]
fn no_side_reports_a_time_limit_after_a_landing_for_a_lost_pose() {
    let late = Occurrence::Server(Box::new(EventKind::TimeLimit { limit_s: 9.0 }));
    let reported = fly(&[(4000, Occurrence::PosesStop), (20_000, late)], (20, 20));
    assert!(matches!(reported.runtime, EndReason::PoseLost { .. }), "{reported:?}");
    assert!(reported.runtime.is_failure() && reported.runtime.title() == "Pose lost");
    reported.check(&reported.runtime);
}
