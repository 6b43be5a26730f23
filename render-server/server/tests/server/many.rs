//! Several vehicles on one server, each with one client over real QUIC.

use std::collections::BTreeMap;
use std::fmt::Write;

use crate::support::{Client, Emitter, STEP_M, Server, Socket, http, send_json, write_arena};
use quinn::{TransportConfig, VarInt};
use vizflyt_protocol::messages::{Event, EventKind, ToRuntime};
use vizflyt_protocol::packet::ImageHeader;

const NAMES: [&str; 4] = ["wasp", "bee", "ant", "fly"];
/// Start of vehicle k, by which its poses and images are distinguished. [m]
const fn start_m(vehicle: usize) -> f64 {
    -2.0 - 4.0 * vehicle as f64
}
/// Slow enough that even a loaded machine renders, encodes and sends most ticks; fast enough that it cannot if anything
/// waits 100 ms for a client.
const SLOWLY: [&str; 2] = ["--max-rate", "40"];

/// Width of camera 0 or 1 of a vehicle, by which its images are distinguished. [px]
fn width_px(vehicle: usize, camera: usize) -> u32 {
    if (vehicle, camera) == (0, 0) { 160 } else { 64 + 16 * (2 * vehicle + camera) as u32 }
}

/// Returns eight cameras, including the arena's own, of four vehicles.
fn four_vehicles() -> String {
    let mut cameras = String::new();
    let mut vehicles = String::new();
    for (vehicle, name) in NAMES.iter().enumerate() {
        for camera in 0..2 {
            if (vehicle, camera) != (0, 0) {
                let width_px = width_px(vehicle, camera);
                write!(
                    cameras,
                    "[[cameras]]\nname = '{name}-{camera}'\nwidth_px = {width_px}\n\
                     height_px = 48\nhorizontal_fov_deg = 90.0\nposition_m = [0.06, 0, 0.02]\n"
                )
                .unwrap();
            }
        }
        let first = if vehicle == 0 { "front".to_owned() } else { format!("{name}-0") };
        write!(
            vehicles,
            "[[vehicles]]\nname = '{name}'\ncameras = ['{first}', '{name}-1']\n\
             spawn = {{ position_m = [{}, 0, 0] }}\n",
            start_m(vehicle)
        )
        .unwrap();
    }
    cameras + &vehicles
}

/// Moves each vehicle slowly backwards from its start.
fn emitters(server: &Server) -> [Emitter; 4] {
    [
        Emitter::along(server.vicon, NAMES[0], |n| start_m(0) - f64::from(n % 1000) * STEP_M),
        Emitter::along(server.vicon, NAMES[1], |n| start_m(1) - f64::from(n % 1000) * STEP_M),
        Emitter::along(server.vicon, NAMES[2], |n| start_m(2) - f64::from(n % 1000) * STEP_M),
        Emitter::along(server.vicon, NAMES[3], |n| start_m(3) - f64::from(n % 1000) * STEP_M),
    ]
}

/// Whether a vehicle can be at this x. [m, world]
fn is_of(vehicle: usize, x_m: f64) -> bool {
    (start_m(vehicle) - 1.1..start_m(vehicle) + 0.1).contains(&x_m)
}

/// Reads `count` images of each of a vehicle's two cameras, and checks that all are its own; returns the headers.
async fn images(client: &Client, vehicle: usize, count: usize) -> Vec<ImageHeader> {
    let mut headers: Vec<ImageHeader> = Vec::new();
    let mut seen = [0; 2];
    while seen.iter().any(|&seen| seen < count) {
        let (header, _) = client.image().await;
        let camera = usize::from(header.camera);
        assert_eq!(header.intrinsics().width_px, width_px(vehicle, camera), "{vehicle} {camera}");
        let x_m = header.world_from_cam().translation_m.x - 0.06;
        assert!(is_of(vehicle, x_m), "vehicle {vehicle} has an image from x = {x_m}");
        assert_eq!(header.together.get() & !3, 0, "only its own cameras are with it");
        seen[camera] += 1;
        headers.push(header);
    }
    headers
}

/// Whether images arrive steadily: most ticks between the first and the last image gave one of each camera.
fn is_steady(headers: &[ImageHeader]) -> bool {
    let mut counts = BTreeMap::<u8, (u64, u64, u64)>::new();
    for header in headers {
        let seq = header.seq.get();
        let (first, last, count) = counts.entry(header.camera).or_insert((seq, seq, 0));
        (*first, *last, *count) = ((*first).min(seq), (*last).max(seq), *count + 1);
    }
    assert_eq!(counts.len(), 2, "{counts:?}");
    println!("first tick, last tick, images of each camera: {counts:?}");
    counts.values().all(|(first, last, count)| 2 * count > last - first)
}

/// Reads images until all are steady. A busy machine may sometimes lose images; a client that delays others would
/// always cost them images.
async fn steady<const N: usize>(
    mut take: impl AsyncFnMut() -> [Vec<ImageHeader>; N],
) -> [Vec<ImageHeader>; N] {
    for _ in 0..5 {
        let all = take().await;
        if all.iter().all(|headers| is_steady(headers)) {
            return all;
        }
    }
    panic!("most ticks give no image");
}

fn emergency(message: ToRuntime) -> Option<Event> {
    match message {
        ToRuntime::Event { event, .. } => (event.kind == EventKind::EmergencyStop).then_some(event),
        _ => None,
    }
}

#[tokio::test]
async fn each_of_four_clients_gets_only_its_own_cameras() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), &four_vehicles()), &SLOWLY);
    let _emitters = emitters(&server);
    for (vehicle, name) in NAMES.iter().enumerate() {
        assert_eq!(server.ready["vehicles"][vehicle]["name"], *name);
        assert_eq!(server.ready["vehicles"][vehicle]["spawn"][0], start_m(vehicle));
    }
    assert_eq!(server.ready["spawn"], server.ready["vehicles"][0]["spawn"]);

    let mut clients = Vec::new();
    for (vehicle, name) in NAMES.iter().enumerate() {
        let (client, arena) = Client::welcomed_to(&server, name, TransportConfig::default()).await;
        let widths: Vec<_> = arena.cameras.iter().map(|c| c.intrinsics.width_px).collect();
        assert_eq!(widths, [width_px(vehicle, 0), width_px(vehicle, 1)], "{name}");
        clients.push(client);
    }
    let all = steady(async || {
        let [a, b, c, d] = [0, 1, 2, 3].map(|vehicle| images(&clients[vehicle], vehicle, 30));
        tokio::join!(a, b, c, d).into()
    })
    .await;
    // All vehicles with a pose are rendered in the same ticks; none loses its share.
    let spans = all.each_ref().map(|headers| {
        let seqs = headers.iter().map(|header| header.seq.get());
        seqs.clone().max().unwrap() - seqs.min().unwrap() + 1
    });
    let (least, most) = (spans.iter().min().unwrap(), spans.iter().max().unwrap());
    assert!(*most <= 3 * least, "ticks for 30 images of each camera: {spans:?}");

    for (vehicle, client) in clients.iter_mut().enumerate() {
        for _ in 0..20 {
            let pose = client.pose().await;
            let x_m = pose.world_from_body.translation_m.x;
            assert!(is_of(vehicle, x_m), "vehicle {vehicle} hears of a pose at x = {x_m}");
        }
    }

    // First one vehicle is stopped, then all: the others receive only the second stop.
    let http_at = server.http;
    let press = |path: &'static str| {
        tokio::task::spawn_blocking(move || {
            send_json(http_at, &format!("POST /api/{path}"), None, "")
        })
    };
    assert_eq!(press("vehicles/wasp/estop").await.unwrap().0, 202);
    let first = clients[0].until(emergency).await;
    let (status, text) = press("estop").await.unwrap();
    assert_eq!((status, &*text), (202, "the runtimes land wasp, bee, ant, fly"));
    let second = clients[0].until(emergency).await;
    assert!(second.stamp > first.stamp);
    for client in &mut clients[1..] {
        assert!(client.until(emergency).await.stamp >= second.stamp, "another's event");
    }
    // Standard output names the vehicle.
    let printed = server.line(|line| line.get("event").map(|_| line["vehicle"].clone()));
    assert_eq!(printed, "wasp");
}

#[test]
fn a_stopped_and_a_slow_client_do_not_delay_others() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), &four_vehicles()), &SLOWLY);
    let _emitters = emitters(&server);
    let alone = || tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    // The wasp's client lives on a tokio runtime that does not run any more: like a process after SIGSTOP, it
    // acknowledges nothing.
    let still = alone();
    let stopped = still.block_on(async {
        let (client, _) = Client::welcomed_to(&server, NAMES[0], TransportConfig::default()).await;
        client.image().await;
        client
    });
    alone().block_on(async {
        // The bee's client accepts no images; the clients of ant and fly work normally.
        let mut no_images = TransportConfig::default();
        no_images.max_concurrent_uni_streams(VarInt::from_u32(0));
        let (slow, _) = Client::welcomed_to(&server, NAMES[1], no_images).await;
        let (ant, _) = Client::welcomed_to(&server, NAMES[2], TransportConfig::default()).await;
        let (fly, _) = Client::welcomed_to(&server, NAMES[3], TransportConfig::default()).await;
        steady(async || tokio::join!(images(&ant, 2, 60), images(&fly, 3, 60)).into()).await;
        drop(slow);
    });
    let _entered = still.enter();
    drop(stopped);
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_that_read_nothing_slow_no_runtime() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), &four_vehicles()), &SLOWLY);
    let _emitters = emitters(&server);
    let own = format!("http://{}", server.http);
    // Each receives the images of two cameras until its socket is full; then it stalls.
    let pages: Vec<_> = NAMES
        .iter()
        .cycle()
        .take(16)
        .map(|name| {
            Socket::open_at(server.http, &own, &format!("/ws?vehicle={name}")).ok().unwrap()
        })
        .collect();
    let (client, _) = Client::welcomed_to(&server, NAMES[3], TransportConfig::default()).await;
    steady(async || [images(&client, 3, 60).await]).await;
    drop(pages);
}

#[test]
fn a_page_shows_the_requested_vehicle() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), &four_vehicles()), &SLOWLY);
    let _emitters = emitters(&server);
    let own = format!("http://{}", server.http);
    let missing = Socket::open_at(server.http, &own, "/ws?vehicle=moth").err();
    assert_eq!(missing, Some(404));
    for (vehicle, path) in [(0, "/ws"), (2, "/ws?vehicle=ant")] {
        let mut socket = Socket::open_at(server.http, &own, path).ok().unwrap();
        let arena = socket.message("arena");
        assert_eq!(arena["vehicle"], NAMES[vehicle]);
        assert_eq!(arena["vehicles"], serde_json::json!(NAMES));
        let widths = [0, 1].map(|camera| arena["cameras"][camera]["width_px"].as_u64());
        assert_eq!(widths, [0, 1].map(|camera| Some(u64::from(width_px(vehicle, camera)))));
        let x_m = loop {
            if let Some(x_m) = socket.message("state")["pose"]["p_world_m"][0].as_f64() {
                break x_m;
            }
        };
        assert!(is_of(vehicle, x_m), "{x_m}");
        let mut pictures = [false; 2];
        while pictures != [true; 2] {
            let (opcode, payload) = socket.next();
            if opcode == 2 {
                pictures[usize::from(payload[1])] = true;
            }
        }
    }
    let (status, answer) = http(server.http, "GET /api/vehicles HTTP/1.1");
    let list = answer.split_once("\r\n\r\n").unwrap().1;
    let list: serde_json::Value = serde_json::from_str(list).unwrap();
    assert_eq!(
        (status, &list[3]["name"], &list[3]["cameras"][1]),
        (200, &"fly".into(), &"fly-1".into())
    );
    assert_eq!((&list[3]["phase"], &list[3]["runtime"]), (&"connecting".into(), &().into()));
    let cameras = |path: &str| http(server.http, &format!("GET /api/vehicles/{path} HTTP/1.1"));
    assert!(cameras("bee/cameras").1.contains("bee-0"));
    assert!(cameras("moth/cameras").1.contains("there is no vehicle 'moth'; there are wasp, bee"));
    let put = |path: &str| {
        send_json(server.http, &format!("PATCH /api/vehicles/{path}"), None, r#"{"tilt_deg": 5}"#)
    };
    assert_eq!(put("bee/cameras/bee-1").0, 200);
    assert_eq!(put("bee/cameras/ant-1").0, 404, "another's camera");
    assert_eq!(put("moth/cameras/bee-1").0, 404);
    let (status, text) = send_json(server.http, "POST /api/vehicles/moth/estop", None, "");
    assert!(status == 404 && text.contains("no vehicle 'moth'"), "{text}");
    let stranger = Some("http://evil.example");
    assert_eq!(send_json(server.http, "POST /api/vehicles/bee/estop", stranger, "").0, 403);
}

#[test]
fn the_command_line_names_vehicles_too() {
    let folder = tempfile::tempdir().unwrap();
    let arena = write_arena(folder.path(), "");
    let server = Server::start(&arena, &["--vehicle", "left", "--vehicle", "right"]);
    let names = [0, 1].map(|index| server.ready["vehicles"][index]["name"].clone());
    assert_eq!(names, ["left", "right"].map(serde_json::Value::from));
}
