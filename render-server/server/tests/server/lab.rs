//! A lab day through a running server: checks that change with runtimes and poses, the queue, the order of take-off,
//! the separation, and a restart.

use std::net::SocketAddr;
use std::time::Duration;

use crate::support::{Client, Emitter, Server, http, send_json, write_arena};
use proptest::prelude::*;
use quinn::TransportConfig;
use serde_json::{Value, json};
use vizflyt_protocol::messages::{
    ClockState, Event, EventKind, FlightPhase, Guarded, Telemetry, Timing, ToRuntime, ToServer,
    VehicleState,
};

const TWO: &str = "[[vehicles]]\nname = 'wasp'\n[[vehicles]]\nname = 'bee'\n";

fn start(folder: &std::path::Path, more: &str) -> Server {
    let day = format!("--lab-day={}", folder.join("day/lab-day.json").display());
    Server::start(&write_arena(folder, more), &[&day])
}

fn day(at: SocketAddr) -> Value {
    let (status, answer) = http(at, "GET /api/lab HTTP/1.1");
    assert_eq!(status, 200, "{answer}");
    serde_json::from_str(answer.split_once("\r\n\r\n").unwrap().1).unwrap()
}

fn check(day: &Value, vehicle: &str, check: &str) -> Value {
    let checks = day["checks"].as_array().unwrap();
    checks.iter().find(|c| c["vehicle"] == vehicle && c["check"] == check).unwrap().clone()
}

fn order(at: SocketAddr, request: &str, body: &Value) -> (u16, String) {
    send_json(at, request, None, &body.to_string())
}

/// Requests a check until it is in this state; returns it.
async fn until_state(at: SocketAddr, vehicle: &str, name: &str, state: &str) -> Value {
    let mut last = Value::Null;
    for _ in 0..600 {
        last = check(&day(at), vehicle, name);
        if last["state"] == state {
            return last;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("{name} does not become {state}: {last}");
}

async fn report(client: &mut Client, phase: FlightPhase, armed: bool) {
    let vehicle =
        VehicleState { armed, battery_v: 16.2, battery_fraction: 0.9, ..VehicleState::default() };
    client.send(&ToServer::Telemetry(Telemetry { phase, vehicle, ..Telemetry::default() })).await;
}

fn stop(message: ToRuntime) -> Option<(u64, Event)> {
    match message {
        ToRuntime::Event { seq, event } => {
            (event.kind == EventKind::EmergencyStop).then_some((seq, event))
        }
        _ => None,
    }
}

#[tokio::test]
async fn checks_change_with_measurements() {
    let folder = tempfile::tempdir().unwrap();
    let server = start(folder.path(), "");
    let at = server.http;
    let emitter = Emitter::along(server.vicon, "vizflyt", |_| 0.0);
    let found = until_state(at, "vizflyt", "localization", "ok").await;
    assert!(found["evidence"].as_str().unwrap().contains("rms at rest"), "{found}");
    assert_eq!(check(&day(at), "vizflyt", "network")["state"], "not_done", "no runtime flies it");

    let (mut client, arena) = Client::welcomed(&server, TransportConfig::default()).await;
    report(&mut client, FlightPhase::Waiting, false).await;
    client.send(&ToServer::Guarded(Guarded::of(&arena, Some(1)))).await;
    let clock = Some(ClockState { error_bound_ms: 0.3, ..ClockState::default() });
    client.send(&ToServer::Timing(Timing { clock, ..Timing::default() })).await;
    until_state(at, "vizflyt", "clocks", "ok").await;
    let battery = until_state(at, "vizflyt", "battery", "ok").await;
    assert_eq!(battery["evidence"], "16.20 V, 90 % left");
    let fence = until_state(at, "vizflyt", "fence", "failed").await;
    assert!(fence["todo"].as_str().unwrap().contains("are not known"), "{fence}");
    // The findings of `vizflyt doctor vehicle`.
    let mut evidence = json!({
        "vehicle": "vizflyt", "by": "vizflyt doctor vehicle",
        "finding": {"ok": true, "evidence": "0 dangerous", "todo": ""},
        "fence": [{"name": "FENCE_ALT_MAX", "has": 3.5, "right": 3.5}]
    });
    assert_eq!(order(at, "POST /api/lab/evidence", &evidence).0, 200);
    until_state(at, "vizflyt", "fence", "ok").await;
    evidence["fence"][0]["has"] = json!(30.0);
    assert_eq!(order(at, "POST /api/lab/evidence", &evidence).0, 200);
    let fence = until_state(at, "vizflyt", "fence", "failed").await;
    assert!(fence["todo"].as_str().unwrap().contains("FENCE_ALT_MAX must be 3.50"), "{fence}");
    assert_eq!(check(&day(at), "vizflyt", "parameters")["state"], "ok");

    // STOP on the ground: press, acknowledgement, report.
    let press = move || send_json(at, "POST /api/vehicles/vizflyt/estop", None, "");
    assert_eq!(tokio::task::spawn_blocking(press).await.unwrap().0, 202);
    let (seq, _) = client.until(stop).await;
    client.send(&ToServer::EventsReceived(seq)).await;
    report(&mut client, FlightPhase::Landed, false).await;
    let stopped = until_state(at, "vizflyt", "stop", "ok").await;
    let evidence = stopped["evidence"].as_str().unwrap();
    assert!(
        evidence.contains("received by the runtime after") && evidence.contains("disarmed after"),
        "{evidence}"
    );

    emitter.pause(true);
    // First the pose is late, then it is missing.
    let mut found = until_state(at, "vizflyt", "localization", "failed").await;
    while !found["evidence"].as_str().unwrap().starts_with("no pose for") {
        tokio::time::sleep(Duration::from_millis(50)).await;
        found = until_state(at, "vizflyt", "localization", "failed").await;
    }
    assert!(found["todo"].as_str().unwrap().contains("is the localization on"), "{found}");
    emitter.pause(false);
    until_state(at, "vizflyt", "localization", "ok").await;
}

#[tokio::test]
async fn vehicles_take_off_in_order_and_keep_apart() {
    let folder = tempfile::tempdir().unwrap();
    let server = start(folder.path(), TWO);
    let at = server.http;
    let _wasp = Emitter::along(server.vicon, "wasp", |_| 0.0);
    let _bee = Emitter::along(server.vicon, "bee", |_| 0.7);
    let formation = |separation_m: Option<f64>| {
        let order = json!({"vehicles": ["wasp", "bee"], "until": "up"});
        json!({"order": order, "separation_m": separation_m})
    };
    let (status, why) = order(
        at,
        "PUT /api/lab/formation",
        &json!({"order": {"vehicles": ["fly"], "until": "up"}, "separation_m": null}),
    );
    assert_eq!((status, &*why), (409, "there is no vehicle 'fly'; there are wasp, bee"));
    assert_eq!(order(at, "PUT /api/lab/formation", &formation(None)).0, 200);

    let (mut wasp, _) = Client::welcomed_to(&server, "wasp", TransportConfig::default()).await;
    let (mut bee, _) = Client::welcomed_to(&server, "bee", TransportConfig::default()).await;
    report(&mut wasp, FlightPhase::Waiting, false).await;
    report(&mut bee, FlightPhase::Waiting, false).await;
    let phase = |vehicle: usize| day(at)["vehicles"][vehicle]["phase"].clone();
    let until_phase = async |vehicle: usize, expected: &str| {
        while phase(vehicle) != expected {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    until_phase(0, "waiting").await;
    until_phase(1, "waiting").await;
    let start = |name: &str| send_json(at, &format!("POST /api/vehicles/{name}/start"), None, "");
    let (status, why) = start("bee");
    assert_eq!(status, 409);
    assert!(why.starts_with("'wasp' goes before 'bee' (wasp, bee) and is not up yet"), "{why}");
    assert_eq!(start("wasp").0, 202);
    report(&mut wasp, FlightPhase::Flying, true).await;
    until_phase(0, "flying").await;
    assert_eq!(start("bee").0, 202);
    report(&mut bee, FlightPhase::Flying, true).await;
    until_phase(1, "flying").await;
    let distances = day(at)["distances"].clone();
    assert!((distances[0]["apart_m"].as_f64().unwrap() - 0.7).abs() < 0.02, "{distances}");

    // Distance of 0.7 m: less than 1.2 m, more than half of it.
    assert_eq!(order(at, "PUT /api/lab/formation", &formation(Some(1.2))).0, 200);
    let (_, event) = bee.until(stop).await;
    assert_eq!(
        event.text.as_str(),
        "wasp and bee, which took off later, are 0.70 m apart, less than 1.2 m: bee lands"
    );
    // The wasp receives no STOP before the one for all vehicles.
    let (status, text) = send_json(at, "POST /api/estop", None, "");
    assert_eq!((status, &*text), (202, "the runtimes land wasp, bee"));
    let (_, event) = wasp.until(stop).await;
    assert_eq!(event.text.as_str(), "emergency stop pressed on the page: land");
}

#[test]
fn a_restart_loses_nothing_and_the_report_is_complete() {
    let folder = tempfile::tempdir().unwrap();
    let server = start(folder.path(), TWO);
    let at = server.http;
    let sign = |body: Value| order(at, "POST /api/lab/sign", &body);
    assert_eq!(sign(json!({"check": "net", "name": "Ada"})).0, 200);
    assert_eq!(sign(json!({"check": "pack", "vehicle": "bee", "name": "Ada"})).0, 200);
    for wrong in [
        json!({"check": "net", "name": "  "}),
        json!({"check": "net", "vehicle": "bee", "name": "Ada"}),
        json!({"check": "pack", "name": "Ada"}),
        json!({"check": "network", "vehicle": "bee", "name": "Ada"}),
        json!({"check": "pack", "vehicle": "fly", "name": "Ada"}),
    ] {
        assert_eq!(sign(wrong.clone()).0, 409, "{wrong}");
    }
    for team in ["ants", "cats"] {
        assert_eq!(
            order(at, "POST /api/lab/queue", &json!({"team": team, "vehicle": "bee"})).0,
            200
        );
    }
    let turn =
        |turn: &str| order(at, "POST /api/lab/turn", &json!({"vehicle": "bee", "turn": turn}));
    assert_eq!(turn("next"), (200, "ants is called".to_owned()));
    assert_eq!(turn("pass_over"), (200, "ants goes to the end of the queue".to_owned()));
    assert_eq!(turn("next"), (200, "cats is called".to_owned()));
    let before = day(at);
    // Simulates a power cut: every answered change is on the disk.
    server.kill();

    let server = start(folder.path(), TWO);
    let after = day(server.http);
    for field in ["queue", "began_unix_ms", "story"] {
        assert_eq!(after[field], before[field], "{field}");
    }
    assert_eq!(check(&after, "", "net"), check(&before, "", "net"));
    assert_eq!(check(&after, "bee", "pack")["by"], "Ada");
    let (status, answer) = http(server.http, "GET /api/lab/report.pdf HTTP/1.1");
    assert_eq!(status, 200);
    assert!(answer.contains("application/pdf") && answer.contains("%PDF-"), "{}", &answer[..200]);
    for expected in ["looked at by Ada", "cats on bee", "net closed"] {
        assert!(answer.contains(expected), "{expected} is not in the report");
    }
    assert_eq!(send_json(server.http, "POST /api/lab/begin", None, "").0, 200);
    let anew = day(server.http);
    assert_eq!(
        (anew["queue"].as_array().unwrap().len(), check(&anew, "", "net")["state"].clone()),
        (0, json!("not_done"))
    );
}

/// Any JSON request gets an answer, and the server keeps running.
#[test]
fn any_json_request_gets_an_answer() {
    let folder = tempfile::tempdir().unwrap();
    let server = start(folder.path(), TWO);
    let at = server.http;
    let orders = [
        "POST /api/lab/sign",
        "POST /api/lab/axes",
        "POST /api/lab/evidence",
        "POST /api/lab/queue",
        "POST /api/lab/turn",
        "PUT /api/lab/formation",
    ];
    let word = prop_oneof![
        Just(json!(null)),
        Just(json!("wasp")),
        Just(json!("next")),
        Just(json!({"vehicles": ["bee", "bee"], "until": "landed"})),
        any::<f64>().prop_map(|n| json!(n)),
        ".{0,60}".prop_map(|s| json!(s)),
    ];
    let keys = prop::sample::select(vec![
        "vehicle",
        "check",
        "name",
        "team",
        "turn",
        "order",
        "separation_m",
        "begin",
    ]);
    let body = prop::collection::btree_map(keys, word, 0..4);
    let mut runner = proptest::test_runner::TestRunner::new(ProptestConfig {
        cases: 60,
        failure_persistence: None,
        ..ProptestConfig::default()
    });
    runner
        .run(&(prop::sample::select(orders.to_vec()), body), |(request, body)| {
            let (status, answer) = order(at, request, &json!(body));
            prop_assert!(
                [200, 400, 409].contains(&status),
                "{} {:?}: {} {}",
                request,
                body,
                status,
                answer
            );
            Ok(())
        })
        .unwrap();
    assert!(day(at)["checks"].as_array().unwrap().len() > 10);
}
