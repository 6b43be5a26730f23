//! The page over a real socket: files, WebSocket, stop button, and who may use them.

mod support;

use quinn::TransportConfig;
use support::{Client, Emitter, Server, Socket, http, write_arena};
use vizflyt_protocol::messages::{EventKind, ToRuntime};

/// Messages within which what is waited for must come: a minute's worth.
const MANY: usize = 2000;

#[test]
fn the_page_is_whole_and_fetches_nothing_from_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    for (path, kind) in [
        ("/", "text/html"),
        ("/style.css", "text/css"),
        ("/app.js", "text/javascript"),
        ("/map.js", "text/javascript"),
        ("/icon.svg", "image/svg+xml"),
        ("/api/map", "image/jpeg"),
    ] {
        let (status, answer) = http(server.http, &format!("GET {path} HTTP/1.1"));
        assert_eq!(status, 200, "{path}");
        let head = answer.split("\r\n\r\n").next().unwrap().to_ascii_lowercase();
        assert!(head.contains(&format!("content-type: {kind}")), "{path}: {head}");
        assert!(head.contains("content-security-policy: default-src 'self'"), "{path}");
        assert!(head.contains("x-frame-options: deny"), "{path}");
        let body = answer.split_once("\r\n\r\n").unwrap().1;
        let links = body.replace("http://www.w3.org/2000/svg", "");
        assert!(!links.contains("http://") && !links.contains("https://"), "{path}");
    }
    assert_eq!(http(server.http, "GET /nothing HTTP/1.1").0, 404);
    assert_eq!(http(server.http, "GET /../Cargo.toml HTTP/1.1").0, 404);
}

#[test]
fn a_viewer_sees_the_arena_the_flight_and_the_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let own = format!("http://{}", server.http);
    assert_eq!(Socket::open(server.http, "http://evil.example").err(), Some(403));
    let mut socket = Socket::open(server.http, &own).ok().unwrap();
    let arena = socket.message("arena");
    assert_eq!((&arena["name"], &arena["cameras"][0]["name"]), (&"wall".into(), &"front".into()));
    assert_eq!(arena["fence"]["cuboid"]["half_m"][1], 4.0);
    assert!(socket.message("trail")["points"].as_array().unwrap().is_empty());
    assert!(socket.message("state")["pose"].is_null());
    let _emitter = Emitter::start(server.vicon, "vizflyt");
    assert!((0..MANY).any(|_| !socket.message("state")["pose"].is_null()));
    let mut seen = [false; 2];
    for _ in 0..MANY {
        if seen == [true; 2] {
            break;
        }
        let (opcode, payload) = socket.next();
        if opcode == 2 {
            assert_eq!(payload[1], 0, "camera");
            assert_eq!(payload[2..4], [0xff, 0xd8], "JPEG");
            seen[usize::from(payload[0])] = true;
        }
    }
    assert_eq!(seen, [true; 2], "colour and depth");
    // One that opens later is told the way so far.
    let mut late = Socket::open(server.http, &own).ok().unwrap();
    assert!(!late.message("trail")["points"].as_array().unwrap().is_empty());
}

#[tokio::test]
async fn the_stop_button_reaches_the_runtime_and_only_from_our_page() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let own = format!("http://{}", server.http);
    let press = |origin: &str| {
        http(
            server.http,
            &format!("POST /api/estop HTTP/1.1\r\nContent-Length: 0\r\nOrigin: {origin}"),
        )
    };
    let (status, answer) = press(&own);
    assert_eq!(status, 409, "nobody to land the vehicle");
    assert!(answer.contains("no runtime is connected"));
    let (mut client, _) = Client::welcomed(&server, TransportConfig::default()).await;
    for stranger in ["http://evil.example", "null", "http://127.0.0.1:1"] {
        assert_eq!(press(stranger).0, 403, "{stranger}");
    }
    assert_eq!(http(server.http, "POST /api/estop HTTP/1.1\r\nContent-Length: 0").0, 403);
    assert_eq!(http(server.http, &format!("GET /api/estop HTTP/1.1\r\nOrigin: {own}")).0, 405);
    assert_eq!(press(&own).0, 202);
    let event = client
        .until(|message| match message {
            ToRuntime::Event(event) => Some(event),
            _ => None,
        })
        .await;
    assert_eq!(event.kind, EventKind::EmergencyStop);
    // A page that opens afterwards shows what decided the flight.
    let mut socket = Socket::open(server.http, &own).ok().unwrap();
    let state = socket.message("state");
    assert_eq!(state["outcome"]["kind"], "emergency_stop");
}
