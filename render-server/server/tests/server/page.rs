//! The page over a real socket: files, WebSocket, stop button, and rights to them.

use crate::support::{Client, Emitter, Server, Socket, http, send_json, write_arena};
use quinn::TransportConfig;
use vizflyt_protocol::messages::{EventKind, FlightPhase, Telemetry, ToRuntime, ToServer};

/// An image of the twin: from 1 m above the start, along x.
const TWIN: &str = "/api/twin?x_m=0&y_m=0&z_m=1&qx=-0.5&qy=0.5&qz=-0.5&qw=0.5&fov_deg=50&width_px=160&height_px=90\
     &cut=false&background=0d1217";
/// Maximum number of messages until an expected one: one minute's worth.
const MANY: usize = 2000;

#[test]
fn the_page_is_complete_and_loads_nothing_from_other_hosts() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    for (path, kind) in [
        ("/", "text/html"),
        ("/style.css", "text/css"),
        ("/app.js", "text/javascript"),
        ("/panels/camera_images.js", "text/javascript"),
        ("/top_view.js", "text/javascript"),
        ("/icon.svg", "image/svg+xml"),
        ("/api/map", "image/jpeg"),
        ("/api/splats/0", "application/octet-stream"),
        (TWIN, "image/jpeg"),
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
    let (status, none) = http(server.http, "GET /api/splats/9 HTTP/1.1");
    assert!(status == 404 && none.contains("the twin has 1 parts"), "{status} {none}");
    assert_eq!(http(server.http, "GET /../Cargo.toml HTTP/1.1").0, 404);
    let (status, refused) = http(server.http, &format!("GET {TWIN}&more=1 HTTP/1.1"));
    assert!(status == 400 && refused.contains("more"), "{status} {refused}");
    let wide = TWIN.replace("width_px=160", "width_px=1000");
    let (status, refused) = http(server.http, &format!("GET {wide} HTTP/1.1"));
    assert!(status == 400 && refused.contains("give 16 to 960 a side"), "{status} {refused}");
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
    assert!(socket.message("track")["points"].as_array().unwrap().is_empty());
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
    // A page that opens later receives the path so far.
    let mut late = Socket::open(server.http, &own).ok().unwrap();
    assert!(!late.message("track")["points"].as_array().unwrap().is_empty());
}

#[test]
fn cameras_are_listed_and_changed_by_our_own_page_only() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let (status, answer) = http(server.http, "GET /api/vehicles/vizflyt/cameras HTTP/1.1");
    let cameras = answer.split_once("\r\n\r\n").unwrap().1;
    let cameras: serde_json::Value = serde_json::from_str(cameras).unwrap();
    assert_eq!(
        (status, &cameras[0]["name"], &cameras[0]["near_m"]),
        (200, &"front".into(), &0.05.into())
    );

    let mut socket = Socket::open(server.http, &format!("http://{}", server.http)).ok().unwrap();
    let arena = socket.message("arena");
    let fx_px = arena["cameras"][0]["intrinsics"]["fx_px"].as_f64();
    assert_eq!(fx_px.map(f64::round), Some(80.0));
    let put = |name: &str, body: &str| {
        send_json(server.http, &format!("PUT /api/vehicles/vizflyt/cameras/{name}"), None, body)
    };
    let good =
        r#"{"width_px": 64, "height_px": 48, "horizontal_fov_deg": 70, "position_m": [0, 0, 0]}"#;
    // A listed camera can be put unchanged.
    assert_eq!(put("front", &cameras[0].to_string()).0, 200);
    assert_eq!(put("front", good).0, 200);
    // Every page, the event feed and standard output receive the change.
    assert_eq!(socket.message("cameras")["cameras"][0]["width_px"], 64);
    let text = server.line(|line| line["event"]["text"].as_str().map(str::to_owned));
    assert!(text.starts_with("camera front is now 64x48 px"), "{text}");

    for (name, body, status, expected) in [
        ("left", good, 404, "there is no camera 'left'; there are front"),
        ("front", "{", 400, "settings cannot be read: EOF"),
        ("front", r#"{"fov": 3}"#, 400, "unknown field `fov`"),
        ("front", &good.replace("70", "700"), 400, "horizontal_fov_deg = 700"),
        ("front", &" ".repeat(1 << 20), 413, "length limit"),
    ] {
        let (found, text) = put(name, body);
        assert!(found == status && text.contains(expected), "{found} {text}");
    }
    let stranger = Some("http://evil.example");
    assert_eq!(
        send_json(server.http, "PUT /api/vehicles/vizflyt/cameras/front", stranger, good).0,
        403
    );
    assert_eq!(
        http(server.http, "PUT /api/vehicles/vizflyt/cameras/front HTTP/1.1\r\nContent-Length: 0")
            .0,
        403
    );
}

#[test]
fn light_and_fog_are_readable_by_all_and_changed_by_our_page_only() {
    let folder = tempfile::tempdir().unwrap();
    let more = "[environment]\nlight = [0.5, 0.5, 0.5]\n";
    let server = Server::start(&write_arena(folder.path(), more), &[]);
    let environment = || {
        let (status, answer) = http(server.http, "GET /api/environment HTTP/1.1");
        let body = answer.split_once("\r\n\r\n").unwrap().1;
        assert_eq!(status, 200, "{body}");
        serde_json::from_str::<serde_json::Value>(body).unwrap()
    };
    let mut socket = Socket::open(server.http, &format!("http://{}", server.http)).ok().unwrap();
    let told = environment();
    assert_eq!((&told["name"], &told["light"][2]), (&serde_json::Value::Null, &0.5.into()));
    assert_eq!(told["names"][3], "fog");
    let put = |body: &str, origin| send_json(server.http, "PUT /api/environment", origin, body);
    let (status, answer) = put(r#"{"name": "fog"}"#, None);
    assert!(status == 200 && answer.contains("\"name\":\"fog\""), "{answer}");
    let told = (0..MANY).find_map(|_| {
        let events = socket.message("events");
        let mut texts =
            events["events"].as_array()?.iter().filter_map(|event| event["text"].as_str());
        texts.next_back().map(str::to_owned)
    });
    assert_eq!(told.as_deref(), Some("light and weather are changed to: fog"));
    assert_eq!(environment()["fog_visibility_m"], 12.0);
    assert_eq!(put(r#"{"fog_visibility_m": 20}"#, None).0, 200);
    assert_eq!(environment()["fog_visibility_m"], 20.0);
    assert_eq!(put(r#"{"rain": {"rate_mmph": 5}, "depth_loss": true}"#, None).0, 200);
    assert_eq!(environment()["rain"]["rate_mmph"], 5.0);
    for (body, expected) in [
        (r#"{"name": "hail"}"#, "there are day, "),
        (r#"{"fog": 1}"#, "invalid type"),
        (r#"{"wind": 1}"#, "unknown field `wind`"),
        (r#"{"rain": {"rate": 1}}"#, "unknown field `rate`"),
        (r#"{"snow": {"rate_mmph": -1}}"#, "environment.snow.rate_mmph = -1"),
        (r#"{"light": [9, 1, 1]}"#, "environment.light = 9"),
        ("{", "EOF"),
    ] {
        let (status, answer) = put(body, None);
        assert!(status == 400 && answer.contains(expected), "{body}: {status} {answer}");
    }
    // The rejected request has changed nothing.
    assert_eq!(environment()["rain"]["rate_mmph"], 5.0);
    assert_eq!(put(r#"{"name": "day"}"#, Some("http://evil.example")).0, 403);
}

#[tokio::test]
async fn the_stop_button_works_only_from_the_own_page() {
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
    assert_eq!(status, 409, "no runtime to land the vehicle");
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
            ToRuntime::Event { event, .. } => Some(event),
            _ => None,
        })
        .await;
    assert_eq!(event.kind, EventKind::EmergencyStop);
    // A page that opens afterwards shows the outcome of the flight.
    let mut socket = Socket::open(server.http, &own).ok().unwrap();
    let state = socket.message("state");
    assert_eq!(state["outcome"]["outcome"], "landed");
    assert_eq!(state["outcome"]["title"], "Stopped by hand");
    assert_eq!(state["outcome"]["text"], "the stop button was pressed");
    assert_eq!(state["outcome"]["tone"], "bad");
}

// Two threads: the page's socket is read blocking, and the client must send packets in parallel.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn start_land_and_reset_are_refused_with_the_reason_or_reach_the_runtime() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let press = |what: &str| {
        send_json(server.http, &format!("POST /api/vehicles/vizflyt/{what}"), None, "")
    };
    assert_eq!(press("start").0, 409);
    assert!(press("land").1.contains("so it cannot be landed"));
    assert_eq!(press("reset").0, 202, "on the ground, without a runtime");
    let mut socket = Socket::open(server.http, &format!("http://{}", server.http)).ok().unwrap();
    let (mut client, _) = Client::welcomed(&server, TransportConfig::default()).await;
    for (phase, name) in [
        (FlightPhase::Preparing, "preparing"),
        (FlightPhase::Waiting, "waiting"),
        (FlightPhase::Flying, "flying"),
    ] {
        client.send(&ToServer::Telemetry(Telemetry { phase, ..Telemetry::default() })).await;
        assert!((0..MANY).any(|_| socket.message("state")["report"]["phase"] == name));
        let statuses = ["start", "land", "reset"].map(|what| press(what).0);
        let expected = match phase {
            FlightPhase::Preparing => [409, 202, 202],
            FlightPhase::Waiting => [202, 202, 202],
            _ => [409, 202, 409],
        };
        assert_eq!(statuses, expected, "{name}");
    }
    let mut kinds = Vec::new();
    while kinds.len() < 4 {
        let kind = client
            .until(|message| match message {
                ToRuntime::Event { event, .. } => Some(event.kind),
                _ => None,
            })
            .await;
        kinds.push(kind);
    }
    assert_eq!(kinds, [EventKind::Land, EventKind::Start, EventKind::Land, EventKind::Land]);
}
