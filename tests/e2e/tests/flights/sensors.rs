//! Sensors other than cameras in a flight of the real program: the plugin's readings compared with the true geometry of
//! the forest, a change in flight, and the log.

use std::fs::File;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use glam::DVec3;
use serde_json::Value;
use vizflyt_e2e::{Demo, good, run};
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::sensor::records::{LidarPoint, RangeReading};
use vizflyt_protocol::sensor::{SensorHeader, SensorKind};
use vizflyt_runtime::log::read::{LogReader, Recorded, RecordedFlight};
use vizflyt_scenes::{Generated, SceneKind, generate};
use zerocopy::FromBytes;

const AIRBORNE: Duration = Duration::from_secs(90);
const FLIGHT: Duration = Duration::from_mins(4);
const SEED: u64 = 7;
/// Sensors without noise, so that only geometric errors remain.
const SENSORS: &str = r#"
[[sensors]]
name = "down"
model = "lidar-lite-v3"
position_m = [0.0, 0.0, -0.05]
tilt_deg = -90.0
rate_hz = 40.0
to_autopilot = true
settings = { sigma_m = 0.0, sigma_per_m = 0.0, range_step_m = 0.0 }

[[sensors]]
name = "top"
model = "os1-16"
position_m = [0.0, 0.0, 0.1]
settings = { sigma_m = 0.0, sigma_per_m = 0.0, range_step_m = 0.0 }

[[sensors]]
name = "nose"
model = "iwr6843"
position_m = [0.1, 0.0, 0.0]
"#;

/// Returns the distance from `from_m` along a unit vector to the first solid. [m, world]
fn true_range_m(truth: &[Volume], from_m: DVec3, along: DVec3) -> f64 {
    let mut range_m = 0.0;
    for _ in 0..400 {
        let at_m = from_m + along * range_m;
        let free_m = truth.iter().map(|solid| solid.signed_distance_m(at_m)).fold(99.0, f64::min);
        if free_m < 1e-4 || range_m > 150.0 {
            break;
        }
        range_m += free_m;
    }
    range_m
}

/// Returns a quantile. [m]
fn quantile(errors_m: &mut [f64], share: f64) -> f64 {
    errors_m.sort_by(f64::total_cmp);
    errors_m[((errors_m.len() - 1) as f64 * share) as usize]
}

fn request(url: &str, line: &str, body: &str) -> String {
    let address = url.trim_start_matches("http://").trim_end_matches('/');
    let mut stream = TcpStream::connect(address).unwrap();
    let head = format!("Host: {address}\r\nOrigin: http://{address}\r\nConnection: close\r\n");
    write!(stream, "{line} HTTP/1.1\r\n{head}Content-Length: {}\r\n\r\n{body}", body.len())
        .unwrap();
    let mut response = String::new();
    stream.read_to_string(&mut response).unwrap();
    response
}

#[test]
fn readings_match_the_true_geometry_and_change_in_flight() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("forest");
    let (place, flights) = (place.to_str().unwrap(), folder.path().join("flights"));
    good(&["scene", "generate", "forest", "--seed", "7", "-o", place]);
    let arena = folder.path().join("forest/arena.toml");
    let text = std::fs::read_to_string(&arena).unwrap();
    std::fs::write(&arena, text + SENSORS).unwrap();
    let logs = flights.to_str().unwrap();
    let mut demo =
        Demo::start(&["--scene", place, "--seconds", "12", "--log", "full", "--log-dir", logs]);
    let url = demo.wait_for("http://", AIRBORNE);
    let url = url.split_whitespace().last().unwrap().to_owned();
    demo.wait_for("plugin flies", AIRBORNE);
    let list = request(&url, "GET /api/vehicles/vizflyt/sensors", "");
    assert!(list.contains(r#""kind":"range_finder""#) && list.contains("os1-16"), "{list}");
    let path = "/api/vehicles/vizflyt/sensors/nose";
    let off = request(&url, &format!("PATCH {path}"), r#"{"enabled": false}"#);
    assert!(off.starts_with("HTTP/1.1 200"), "{off}");
    demo.wait_for("sensor nose, a radar, is off", AIRBORNE);
    let wrong = request(&url, &format!("PATCH {path}"), r#"{"model": "tfmini"}"#);
    assert!(wrong.starts_with("HTTP/1.1 400") && wrong.contains("it stays one"), "{wrong}");
    let reading = request(&url, "GET /api/vehicles/vizflyt/sensors/down/reading", "");
    assert!(reading.contains(r#""range_m":"#), "{reading}");
    demo.wait(FLIGHT);

    let log = std::fs::read_dir(&flights).unwrap().next().unwrap().unwrap().path();
    let Generated { truth, arena, .. } = generate(SceneKind::Forest, SEED);
    let fence = &arena.geofence;
    let reader = LogReader::new(File::open(&log).unwrap()).unwrap();
    let mut flight = RecordedFlight::new(reader, true);
    let (mut ranges_m, mut points_m, mut radar) = (Vec::new(), Vec::new(), 0);
    let mut seqs = [0; 3];
    while let Some(recorded) = flight.next().unwrap() {
        let Recorded::Observation(observation) = recorded else { continue };
        for records in &observation.records {
            let index = records.sensor as usize;
            let stride = size_of::<SensorHeader>();
            let head = &observation.sensors[index * stride..(index + 1) * stride];
            let sensor = SensorHeader::read_from_bytes(head).unwrap();
            assert_eq!(sensor.name(), records.name);
            let is_new = std::mem::replace(&mut seqs[index], sensor.seq) != sensor.seq;
            if !is_new {
                continue;
            }
            let world_from_body = sensor.pose_at_reading().expect("the forest gives the pose");
            let world_from_sensor = world_from_body * sensor.body_from_sensor();
            let from_m = world_from_sensor.translation_m;
            // Near the ground, distances are below the sensor's minimum.
            if from_m.z < 0.5 {
                continue;
            }
            let is_ahead_m = |p_m: DVec3| {
                let along = world_from_sensor.rotate(p_m).normalize();
                (p_m.length() - true_range_m(&truth, from_m, along)).abs()
            };
            match sensor.kind().unwrap() {
                SensorKind::RangeFinder => {
                    let range = RangeReading::read_from_bytes(&records.bytes).unwrap();
                    let range_m = range.measured_m().expect("there is a floor");
                    ranges_m.push(is_ahead_m(DVec3::X * f64::from(range_m)));
                }
                SensorKind::Lidar => {
                    let bytes = records.bytes.chunks_exact(size_of::<LidarPoint>());
                    assert!(bytes.len() > 1000, "a sweep of {} points", bytes.len());
                    let points = bytes.map(|bytes| LidarPoint::read_from_bytes(bytes).unwrap());
                    // Only the last milliseconds of the sweep, because the pose is that of its end.
                    let last = points.filter(|point| point.before_ns < 8_000_000).step_by(7);
                    // Only hits on trunks within the fence: the true geometry has neither plants nor objects beyond.
                    let on_trunks =
                        last.map(|p| DVec3::from(p.p_m.map(f64::from))).filter(|&p_m| {
                            let along = world_from_sensor.rotate(p_m).normalize();
                            let hit_m = from_m + along * true_range_m(&truth, from_m, along);
                            hit_m.z > 0.2
                                && hit_m.cmpgt(fence.min_m).all()
                                && hit_m.cmplt(fence.max_m).all()
                        });
                    points_m.extend(on_trunks.map(is_ahead_m));
                }
                SensorKind::Radar => radar += 1,
                SensorKind::Sonar => panic!("there is none"),
            }
        }
    }
    assert!(ranges_m.len() > 60 && points_m.len() > 1500, "{} {}", ranges_m.len(), points_m.len());
    let figures = [
        quantile(&mut ranges_m, 0.5),
        quantile(&mut ranges_m, 0.95),
        quantile(&mut points_m, 0.5),
        quantile(&mut points_m, 0.9),
    ];
    println!(
        "down: median {:.4}, 95 % {:.4}; top: median {:.4}, 90 % {:.4} m; {radar} of the radar",
        figures[0], figures[1], figures[2], figures[3]
    );
    // Splats differ from the solids that they cover; a beam that grazes a trunk measures the background.
    assert!(figures[0] < 0.03 && figures[1] < 0.10, "down: {figures:?}");
    assert!(figures[2] < 0.03 && figures[3] < 0.30, "top: {figures:?}");

    // The data set contains every reading once.
    let set = folder.path().join("set");
    let set_name = set.to_str().unwrap();
    good(&["export", log.to_str().unwrap(), "--format", "euroc", "-o", set_name]);
    let sweeps = std::fs::read_dir(set.join("mav0/top/data")).unwrap().count();
    let ranges = std::fs::read_to_string(set.join("mav0/down/data.csv")).unwrap().lines().count();
    assert!(sweeps > 50 && ranges > ranges_m.len(), "{sweeps} sweeps, {ranges} distances");
    let place = std::fs::read_to_string(set.join("mav0/nose/sensor.yaml")).unwrap();
    assert!(place.contains("sensor_type: radar") && place.contains("T_BS"), "{place}");

    // The replay gives the plugin the same readings.
    let report = folder.path().join("report.json");
    let arguments = ["replay", log.to_str().unwrap(), "--report", report.to_str().unwrap()];
    let done = run(&arguments);
    assert!(done.status.success(), "{done:?}");
    let report: Value = serde_json::from_str(&std::fs::read_to_string(report).unwrap()).unwrap();
    let found = &report["found"];
    assert!(found["compared"].as_u64().unwrap() > 50, "{found:#}");
    assert_eq!(found["images_missing"], 0, "{found:#}");
}
