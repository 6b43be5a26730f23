//! Two examples of each message to the page: one with all optional parts, one with as few as possible.

use glam::{DQuat, DVec2, DVec3};
use serde::Serialize;
use serde_json::Value;
use vizflyt_arena::config::imaging::DepthConfig;
use vizflyt_arena::config::{CameraConfig, ImagingConfig};
use vizflyt_arena::pose::SourceQuality;
use vizflyt_protocol::flight_end::{Boundary, Collision, FenceBreach, Obstacle};
use vizflyt_protocol::geometry::LensConfig;
use vizflyt_protocol::messages::{Arrivals, ClockState, EventKind, Timing, bounded};

use super::*;
use crate::flights::crash_card;
use crate::poses::drivers::TagsSeen;
use crate::stream::connection::Connection;
use crate::stream::delivery::{CameraDelivery, Delivery};
use crate::web::{api, stats};

/// Returns the examples of every message, by its name in the page's scripts.
pub(super) fn all() -> Vec<(&'static str, Vec<Value>)> {
    vec![
        ("Arena", arenas()),
        ("Cameras", vec![json(&Message::Cameras { cameras: camera_examples() })]),
        ("Track", vec![json(&Message::Track { vehicle: "vizflyt", points: &[[0.0; 4]] })]),
        ("Events", vec![json(&Message::Events { events: event_examples() })]),
        ("State", vec![json(&full_state()), json(&sparse_state())]),
        ("Session", api::login::examples()),
        ("VehicleLine", api::vehicles::examples()),
        ("SensorLine", api::sensors::examples().0),
        ("ReadingLine", api::sensors::examples().1),
        ("SceneChoice", api::scenes::examples()),
        ("Environment", api::environment::examples()),
        ("Pairing", api::pairing::examples()),
        ("LabDay", api::lab::examples()),
        ("Leaderboard", api::leaderboard::examples()),
        ("CrashCard", crash_card::examples()),
        ("Stats", stats_examples()),
    ]
}

fn json(message: &impl Serialize) -> Value {
    serde_json::to_value(message).unwrap()
}

fn arenas() -> Vec<Value> {
    let fences = [
        Volume::Cuboid { center_m: DVec3::ZERO, half_m: DVec3::ONE, rotation: DQuat::IDENTITY },
        Volume::Sphere { center_m: DVec3::ZERO, radius_m: 2.0 },
        Volume::Capsule { a_m: DVec3::ZERO, b_m: DVec3::Z, radius_m: 2.0 },
        Volume::HalfSpace { normal: DVec3::Z, offset_m: 0.0 },
    ];
    let stage = |polygon_m, thickness_m| StageConfig {
        name: "gate".to_owned(),
        center_m: DVec3::ONE,
        normal: DVec3::X,
        width_m: 1.0,
        height_m: 1.0,
        polygon_m,
        thickness_m,
        clearance_m: thickness_m,
    };
    let stages = [stage(vec![DVec2::ONE], 0.1), stage(Vec::new(), 0.0)];
    let obstacles = Obstacles::scan([0.0; 2].into(), [1.0; 2].into(), 0.5, |_| true);
    let arena = |(fence, goal_m)| {
        Message::Arena(Box::new(Arena {
            boot: "1".to_owned(),
            name: "race",
            vehicle: "vizflyt",
            vehicles: vec!["vizflyt"],
            fence,
            goal_m,
            goal_radius_m: 0.5,
            body_radius_m: 0.12,
            max_speed_mps: 3.0,
            time_limit_s: 60.0,
            cameras: camera_examples(),
            map_min_m: [0.0; 2],
            map_max_m: [1.0; 2],
            obstacles: &obstacles,
            stages: &stages,
            twin_parts: 3,
        }))
    };
    let goals = [Some([0.0; 3]), None, None, None];
    fences.iter().zip(goals).map(|example| json(&arena(example))).collect()
}

fn camera_examples() -> Vec<CameraLine> {
    let fov = CameraConfig {
        name: "front".to_owned(),
        width_px: 320,
        height_px: 240,
        horizontal_fov_deg: Some(90.0),
        fx_px: None,
        fy_px: None,
        cx_px: None,
        cy_px: None,
        distortion: None,
        position_m: DVec3::X,
        tilt_deg: 0.0,
        yaw_deg: 0.0,
        roll_deg: 0.0,
        near_m: 0.1,
        rate_hz: None,
        priority: 0,
        depth: true,
        imaging: None,
    };
    let calibrated = |lens| CameraConfig {
        horizontal_fov_deg: None,
        fx_px: Some(200.0),
        fy_px: Some(200.0),
        cx_px: Some(160.0),
        cy_px: Some(120.0),
        distortion: lens,
        rate_hz: Some(30.0),
        priority: 1,
        ..fov.clone()
    };
    let brown = LensConfig::BrownConrady { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0 };
    let kannala = LensConfig::KannalaBrandt { k1: 0.0, k2: 0.0, k3: 0.0, k4: 0.0 };
    let named = |imaging| CameraConfig { imaging: Some(imaging), ..fov.clone() };
    let depth = Some(DepthConfig { model: "d435".to_owned(), ..DepthConfig::default() });
    let sensor = Some("imx219".to_owned());
    let sensors = [
        named(ImagingConfig {
            sensor: sensor.clone(),
            depth: depth.clone(),
            ..ImagingConfig::default()
        }),
        named(ImagingConfig { sensor, ..ImagingConfig::default() }),
        named(ImagingConfig { depth, ..ImagingConfig::default() }),
    ];
    [fov.clone(), calibrated(None), calibrated(Some(brown)), calibrated(Some(kannala))]
        .iter()
        .chain(&sensors)
        .map(|config| CameraLine { keys: camera_keys(config), intrinsics: config.intrinsics() })
        .collect()
}

fn event_examples() -> Vec<Line> {
    let (p_world_m, speed_mps) = (DVec3::ZERO, 1.0);
    let touch =
        |with| EventKind::Collision(Collision { p_world_m, clearance_m: -0.1, with, speed_mps });
    let breach = |boundary| {
        let (margin_m, overshoot_m) = (-0.1, 0.2);
        EventKind::Geofence(FenceBreach { p_world_m, margin_m, boundary, speed_mps, overshoot_m })
    };
    let kinds = [
        touch(Obstacle::Scene),
        touch(Obstacle::Object(bounded("door"))),
        touch(Obstacle::Vehicle(bounded("other"))),
        breach(Boundary::Ceiling),
        breach(Boundary::NoFly(bounded("box"))),
        EventKind::Stage { index: 0, name: "gate".try_into().unwrap() },
        EventKind::Finished { seconds: 9.0 },
        EventKind::TimeLimit { limit_s: 60.0 },
        EventKind::PoseLost { age_s: 0.6 },
        EventKind::Ended(EndReason::PluginLanded),
        EventKind::Ended(EndReason::PoseLost { age_s: 0.6 }),
        EventKind::Ended(EndReason::TimeAsked { seconds: 6.0 }),
        EventKind::Phase(FlightPhase::Flying),
        EventKind::Note,
    ];
    let line = |kind: EventKind| Line {
        index: 0,
        origin: "server",
        tone: kind.end_reason().as_ref().map(tone),
        event: event(kind),
        at_s: 1.0,
    };
    kinds.map(line).into()
}

fn event(kind: EventKind) -> Event {
    Event { stamp: ServerTime::from_ns(1), kind, text: "a sentence".try_into().unwrap() }
}

fn full_state() -> Message<'static> {
    let Message::State(sparse) = sparse_state() else { unreachable!() };
    let quality = PoseQuality {
        age_ms: Some(1.0),
        sources: vec![SourceQuality::default()],
        ..PoseQuality::default()
    };
    let tags = TagsSeen {
        tags: 1,
        cameras: 1,
        rms_px: 0.1,
        image_ms: 5.0,
        view_port: None,
        view: Some(([127, 0, 0, 1], 8090).into()),
    };
    let pose = || PoseLine {
        p_world_m: [0.0; 3],
        yaw_rad: 0.0,
        rotation: [0.0, 0.0, 0.0, 1.0],
        v_world_mps: [0.0; 3],
        age_s: 0.0,
    };
    let other = |pose, flight_s| OtherLine {
        name: "bee".to_owned(),
        phase: FlightPhase::Flying,
        pose,
        flight_s,
    };
    Message::State(Box::new(State {
        pose: Some(pose()),
        runtime: Some(RuntimeLine {
            address: "127.0.0.1:1".to_owned(),
            program: "vizflyt".to_owned(),
        }),
        report: Some(Telemetry::default()),
        source: SourceCounters { tags: Some(tags), ..sparse.source },
        quality,
        flight_s: Some(1.0),
        outcome: Some(OutcomeLine {
            outcome: OutcomeKind::Collided,
            title: "Collision",
            text: "a sentence".to_owned(),
            tone: "bad",
            at_s: 1.0,
        }),
        crash: Some(1),
        objects: vec![ObjectLine {
            name: "hand".to_owned(),
            id: 1,
            p_world_m: [0.0; 3],
            q_xyzw: [0.0; 4],
            min_m: [0.0; 3],
            max_m: [0.0; 3],
        }],
        others: vec![other(Some(pose()), Some(1.0)), other(None, None)],
        ..*sparse
    }))
}

fn sparse_state() -> Message<'static> {
    Message::State(Box::new(State {
        pose: None,
        runtime: None,
        report: None,
        render: StageTimes::default(),
        encode: StageTimes::default(),
        send: StageTimes::default(),
        renderer: RendererInfo { name: "cpu".to_owned(), reason: "asked for".to_owned() },
        render_hz: 0.0,
        stream_hz: 0.0,
        stream_mbit_s: 0.0,
        images_late: 0,
        source: SourceCounters::default(),
        source_hz: 0.0,
        quality: PoseQuality::default(),
        flight_s: None,
        landed: false,
        outcome: None,
        crash: None,
        objects: Vec::new(),
        others: Vec::new(),
    }))
}

fn stats_examples() -> Vec<Value> {
    let sparse = stats::VehicleStats {
        vehicle: "vizflyt".to_owned(),
        runtime: None,
        server: stats::ServerStages::default(),
        timing: None,
        images: Vec::new(),
        connection: None,
        pose: PoseQuality::default(),
    };
    let timing = Timing {
        clock: Some(ClockState::default()),
        cameras: [Arrivals::default()].into_iter().collect(),
        ..Timing::default()
    };
    let full = stats::VehicleStats {
        runtime: Some("vizflyt at 127.0.0.1:1".to_owned()),
        timing: Some(timing.clone()),
        images: vec![CameraDelivery { camera: "front".to_owned(), account: Delivery::default() }],
        connection: Some(Connection::default()),
        pose: PoseQuality {
            age_ms: Some(1.0),
            sources: vec![SourceQuality::default()],
            ..PoseQuality::default()
        },
        ..sparse.clone()
    };
    let unsynchronised =
        stats::VehicleStats { timing: Some(Timing { clock: None, ..timing }), ..sparse.clone() };
    vec![json(&full), json(&sparse), json(&unsynchronised)]
}
