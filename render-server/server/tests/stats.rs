//! `/api/stats` over a real socket: what a runtime reports, joined with what the server counted.

mod support;

use quinn::TransportConfig;
use serde_json::Value;
use support::{Client, Emitter, Server, http, write_arena};
use vizflyt_protocol::messages::{Arrivals, Stage, Timing, ToServer};

/// Answers within which what is waited for must come.
const MANY: usize = 2000;

fn stats(server: &Server, query: &str) -> (u16, String) {
    let (status, answer) = http(server.http, &format!("GET /api/stats{query} HTTP/1.1"));
    (status, answer.split_once("\r\n\r\n").unwrap().1.to_owned())
}

fn json(server: &Server) -> Value {
    let (status, body) = stats(server, "");
    assert_eq!(status, 200, "{body}");
    serde_json::from_str(&body).unwrap()
}

/// Whether what was drawn is what was delivered, is under way, and was skipped.
fn balances(account: &Value) -> bool {
    let count = |value: &Value| value.as_u64().unwrap();
    let skipped: u64 = account["skipped"].as_object().unwrap().values().map(count).sum();
    let ended = count(&account["delivered"]) + skipped;
    count(&account["drawn"]) == ended + count(&account["under_way"])
}

#[test]
fn without_a_runtime_there_are_no_times_and_a_stranger_vehicle_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let answer = json(&server);
    assert_eq!(answer["vehicle"], "vizflyt");
    assert!(answer["runtime"].is_null() && answer["timing"].is_null(), "{answer:#}");
    assert!(answer["connection"].is_null());
    assert_eq!(answer["images"][0]["drawn"], 0);
    let (status, body) = stats(&server, "?vehicle=wasp");
    assert_eq!((status, body.as_str()), (404, "no vehicle 'wasp' here, only 'vizflyt'"));
    assert_eq!(stats(&server, "?vehicle=vizflyt").0, 200);
}

// On several threads: the questions block, and the report must travel meanwhile.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_the_runtime_reports_is_joined_with_what_the_server_counted() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let _emitter = Emitter::start(server.vicon, "vizflyt");
    let (mut client, _) = Client::welcomed(&server, TransportConfig::default()).await;
    for _ in 0..20 {
        client.image().await;
    }
    // Of 20 that came the plugin got 17.
    let arrivals =
        Arrivals { arrived: 20, delivered: 17, overrun: 2, stale: 1, ..Arrivals::default() };
    let mut timing = Timing { seconds: 5.0, ..Timing::default() };
    timing.waterfall.stages[Stage::Decode].p90 = 1.5;
    timing.cameras.push(arrivals).unwrap();
    client.say(&ToServer::Timing(timing)).await;
    let is_told = |answer: &Value| !answer["timing"].is_null();
    let answer = (0..MANY).map(|_| json(&server)).find(is_told).expect("the report is taken");
    assert_eq!(answer["timing"]["waterfall"]["stages"]["decode"]["p90"], 1.5);
    assert!(answer["runtime"].as_str().unwrap().contains("127.0.0.1"), "{answer:#}");
    assert!(answer["server"]["render"]["max"].as_f64().unwrap() > 0.0);
    assert!(answer["connection"]["mtu"].as_u64().unwrap() >= 1200);
    assert!(answer["connection"]["packets_sent"].as_u64().unwrap() > 20);
    let account = &answer["images"][0];
    assert_eq!(account["camera"], "front");
    assert_eq!(account["delivered"], 17);
    assert_eq!(
        (&account["skipped"]["overrun"], &account["skipped"]["stale"]),
        (&2.into(), &1.into())
    );
    assert!(account["drawn"].as_u64().unwrap() >= 20);
    assert!(balances(account), "{account:#}");
    client.close().await;
    let report = server.finish();
    assert!(report["stages"]["encode"]["p90"].as_f64().unwrap() > 0.0, "{report:#}");
    let account = &report["images"]["vizflyt"][0];
    assert_eq!(account["delivered"], 17);
    assert!(balances(account), "{account:#}");
}
