//! Crash card of a flight into a wall through a running server, without watchers.

use crate::support::{Client, Emitter, Server, Socket, http, write_arena};
use quinn::TransportConfig;
use serde_json::Value;
use vizflyt_protocol::messages::{Event, EventKind, FlightPhase, Telemetry, ToServer, bounded};
use vizflyt_protocol::time::ServerTime;

/// Requests the card until it exists.
async fn card(server: &Server) -> Value {
    for _ in 0..600 {
        let (status, answer) = http(server.http, "GET /api/vehicles/vizflyt/crash HTTP/1.1");
        if status == 200 {
            return serde_json::from_str(answer.split_once("\r\n\r\n").unwrap().1).unwrap();
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    panic!("no card comes");
}

// Two threads: one waits for answers while the other keeps the connection alive.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flight_into_a_wall_creates_a_crash_card() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let (status, answer) = http(server.http, "GET /api/vehicles/vizflyt/crash HTTP/1.1");
    assert!(status == 404 && answer.contains("no flight of 'vizflyt' has failed"), "{answer}");

    let (mut client, _) = Client::welcomed(&server, TransportConfig::default()).await;
    let flying = Telemetry { phase: FlightPhase::Flying, ..Telemetry::default() };
    client.send(&ToServer::Telemetry(flying)).await;
    let kind = EventKind::Phase(FlightPhase::TakingOff);
    let event = Event { stamp: ServerTime::ZERO, kind, text: bounded("") };
    client.send(&ToServer::Event { seq: 1, event }).await;
    // Three seconds at 0.6 m/s, until the body touches the wall at x = 5 m.
    let _emitter = Emitter::along(server.vicon, "vizflyt", |frame| {
        3.0 + f64::from(frame.clamp(100, 750) - 100) * 0.003
    });
    let card = card(&server).await;
    assert_eq!((&card["id"], &card["vehicle"]), (&1.into(), &"vizflyt".into()));
    assert_eq!(card["title"], "Collision");
    assert!(card["verdict"]["end"].get("collision").is_some(), "{}", card["verdict"]);
    assert_eq!(card["verdict"]["outcome"], "collided");
    // The cause depends on how evenly a loaded machine sends the poses.
    assert!(card["cause"].as_str().unwrap().starts_with("it "), "{}", card["cause"]);
    // The path to the wall, up to the contact.
    let samples = card["samples"].as_array().unwrap();
    let number = |sample: &Value, name: &str| sample[name].as_f64().unwrap();
    let last = samples.last().unwrap();
    assert!(number(last, "before_s").abs() < 0.01 && number(last, "clearance_m") <= 0.0, "{last}");
    assert!(number(&samples[0], "before_s") > 2.0, "{}", samples[0]);
    for svg in ["clearance_svg", "top_svg"] {
        assert!(card[svg].as_str().unwrap().starts_with("<svg "), "{svg}");
    }
    // Without watchers, the card has images as well.
    let images = &card["images"][0];
    let before_s = images["before_s"].as_array().unwrap();
    assert!(images["camera"] == "front" && before_s.len() >= 3, "{images}");
    let image =
        |path: &str| http(server.http, &format!("GET /api/vehicles/vizflyt/crash/{path} HTTP/1.1"));
    for kind in ["colour", "depth"] {
        let (status, answer) = image(&format!("1/0/{kind}/{}", before_s.len() - 1));
        assert!(status == 200 && answer.contains("content-type: image/jpeg"), "{kind}: {status}");
    }
    for (path, expected) in [
        (format!("1/0/colour/{}", before_s.len()), 404),
        ("1/1/colour/0".to_owned(), 404),
        ("2/0/colour/0".to_owned(), 404),
        ("1/0/ids/0".to_owned(), 400),
        ("1/0/colour/-1".to_owned(), 400),
    ] {
        assert_eq!(image(&path).0, expected, "{path}");
    }
    // A page that opens afterwards receives the number of the newest card.
    let mut socket = Socket::open(server.http, &format!("http://{}", server.http)).ok().unwrap();
    assert_eq!(socket.message("state")["crash"], 1);
}
