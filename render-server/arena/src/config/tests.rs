use vizflyt_protocol::geometry::Distortion;

use super::*;

const FOREST: &str = r#"
name = "forest"
scene = "scene.ply"
body_radius_m = 0.12
takeoff_height_m = 1.2
time_limit_s = 60.0
[spawn]
position_m = [1.0, 0.0, 0.0]
yaw_deg = 90.0
[goal]
position_m = [38.0, 0.0, 1.2]
radius_m = 1.0
[geofence]
min_m = [-1.0, -6.0, -0.5]
max_m = [42.0, 6.0, 4.0]
[limits]
max_speed_mps = 6.0
max_acceleration_mps2 = 8.0
[occupancy]
voxel_m = 0.05
min_opacity = 0.3
floor_z_m = 0.0
[[cameras]]
name = "front"
width_px = 320
height_px = 240
horizontal_fov_deg = 90.0
position_m = [0.06, 0.0, 0.02]
tilt_deg = 10.0
[[stages]]
name = "window 1"
center_m = [10.0, 0.0, 1.2]
normal = [1.0, 0.0, 0.0]
width_m = 1.0
height_m = 1.0
"#;

#[test]
fn rules_restrict_setpoints() {
    let with = |more: &str| ArenaConfig::parse(&format!("{more}\n{FOREST}"));
    let usual = with("").unwrap();
    assert_eq!(usual.info().setpoints, SetpointKinds::USUAL);
    let positions = with("rules = { setpoints = [\"position\"] }\nattitude_rate = true").unwrap();
    let kinds = [SetpointKind::Position, SetpointKind::AttitudeRate];
    assert_eq!(positions.info().setpoints, kinds.into_iter().collect());
    assert_eq!(ArenaConfig::parse(&positions.to_toml().unwrap()).unwrap(), positions);
    let none = with("rules = { setpoints = [] }").unwrap_err().to_string();
    assert!(none.contains("rules.setpoints") && none.contains("name one kind"), "{none}");
    let blind = with("ground_truth = false").unwrap();
    assert_eq!(blind.info().setpoints, SetpointKinds::BY_OWN_SENSES);
    assert!(!blind.info().setpoints.contains(SetpointKind::Position));
    let error = with("ground_truth = false\nrules = { setpoints = [\"position\"] }").unwrap_err();
    assert!(error.to_string().contains("which ground_truth = false withholds"), "{error}");
    let unknown = with("rules = { setpoints = [\"speed\"] }").unwrap_err().to_string();
    assert!(unknown.contains("`velocity`"), "{unknown}");
}

/// Parses the forest with one line replaced and expects an error message that contains each of `parts`.
#[track_caller]
fn check_refused(from: &str, to: &str, parts: &[&str]) {
    assert!(FOREST.contains(from), "{from:?} is not in the example");
    let message = ArenaConfig::parse(&FOREST.replace(from, to)).unwrap_err().to_string();
    for part in parts {
        assert!(message.contains(part), "{message:?} lacks {part:?}");
    }
}

#[test]
fn the_example_parses_and_round_trips() {
    let arena = ArenaConfig::parse(FOREST).unwrap();
    let text = arena.to_toml().unwrap();
    assert_eq!(ArenaConfig::parse(&text).unwrap(), arena);
    // Optional parts may be absent, before and after a round trip.
    let bare = ArenaConfig { goal: None, stages: vec![], ..arena };
    assert_eq!(ArenaConfig::parse(&bare.to_toml().unwrap()).unwrap(), bare);
}

#[test]
fn conversions_keep_frames_and_units() {
    let arena = ArenaConfig::parse(FOREST).unwrap();
    let nose = arena.world_from_body_at_spawn().rotate(DVec3::X);
    assert!((nose - DVec3::Y).length() < 1e-12);
    let axis = arena.cameras[0].body_from_cam().rotate(DVec3::Z);
    assert!((axis.z - 10f64.to_radians().sin()).abs() < 1e-12, "tilted up");
    let info = arena.info();
    assert_eq!(info.cameras[0].name.as_str(), "front");
    assert_eq!(info.goal_m, Some(DVec3::new(38.0, 0.0, 1.2)));
    assert_eq!(info.geofence.signed_distance_m(DVec3::new(0.0, 0.0, 2.0)), -1.0);
    assert_eq!(arena.scene_path(Path::new("a/arena.toml")), Path::new("a/scene.ply"));
}

#[test]
fn reads_and_checks_bodies_and_no_fly_boxes() {
    let parts = r#"
[[body]]
from_m = [0.0, -0.08, 0.0]
to_m = [0.0, 0.08, 0.0]
radius_m = 0.03
[[body]]
from_m = [0.0, 0.0, 0.02]
radius_m = 0.06
[[no_fly]]
name = "table"
min_m = [5.0, -1.0, 0.0]
max_m = [6.0, 1.0, 0.8]
"#;
    let text = format!("{FOREST}{parts}");
    let arena = ArenaConfig::parse(&text).unwrap();
    assert_eq!((arena.body.len(), arena.body[1].to_m), (2, None));
    let info = arena.info();
    assert!((info.no_fly[0].signed_distance_m(DVec3::new(5.5, 0.0, 1.0)) - 0.2).abs() < 1e-12);
    assert_eq!(ArenaConfig::parse(&arena.to_toml().unwrap()).unwrap(), arena);
    let refused = |from: &str, to: &str, part: &str| {
        assert!(text.contains(from), "{from}");
        let message = ArenaConfig::parse(&text.replace(from, to)).unwrap_err().to_string();
        assert!(message.contains(part), "{message:?} lacks {part:?}");
    };
    refused("[0.0, 0.08, 0.0]", "[0.0, 0.1, 0.0]", "body[0].to_m");
    refused("radius_m = 0.06", "radius_m = nan", "body[1].radius_m = NaN");
    refused("max_m = [6.0, 1.0, 0.8]", "max_m = [6.0, -1.0, 0.8]", "no_fly[0].max_m");
    refused("min_m = [5.0, -1.0, 0.0]", "min_m = [1.05, -1.0, 0.0]", "spawn at");
    refused("max_m = [6.0, 1.0, 0.8]", "max_m = [12.0, 1.0, 1.2]", "stage window 1");
    refused("name = \"table\"", "name = \"\"", "no_fly[0].name");
}

#[test]
fn toml_errors_name_the_line() {
    check_refused("time_limit_s = 60.0", "time_limit = 60.0", &["line 6", "time_limit"]);
    check_refused("radius_m = 1.0", "radius_m = \"one\"", &["line 12", "f64"]);
}

#[test]
fn absent_safety_limits_are_errors() {
    check_refused("max_speed_mps = 6.0", "", &["max_speed_mps"]);
    check_refused("body_radius_m = 0.12", "", &["body_radius_m"]);
    check_refused("max_m = [42.0, 6.0, 4.0]", "", &["max_m"]);
}

#[test]
fn rejects_invalid_values_with_key_and_value() {
    check_refused("= 0.12", "= nan", &["body_radius_m = NaN", "0.01 to 2"]);
    check_refused("max_speed_mps = 6.0", "max_speed_mps = inf", &["limits.max_speed_mps = inf"]);
    check_refused(
        "[1.0, 0.0, 0.0]\nyaw",
        "[1.0, 7.0, 0.0]\nyaw",
        &["spawn.position_m = [1, 7, 0]"],
    );
    check_refused("[38.0, 0.0, 1.2]", "[38.0, 0.0, 3.95]", &["goal.position_m", "inside"]);
    check_refused("takeoff_height_m = 1.2", "takeoff_height_m = 3.9", &["takeoff_height_m = 3.9"]);
    check_refused("[42.0, 6.0, 4.0]", "[42.0, -6.0, 4.0]", &["geofence.max_m"]);
    check_refused("width_px = 320", "width_px = 0", &["cameras[0]", "0x240"]);
    check_refused("fov_deg = 90.0", "fov_deg = 180.0", &["cameras[0].horizontal_fov_deg = 180"]);
    check_refused("normal = [1.0, 0.0, 0.0]", "normal = [0, 0, 0]", &["stages[0].normal"]);
    check_refused("voxel_m = 0.05", "voxel_m = 0.0", &["occupancy.voxel_m = 0"]);
    check_refused("\"window 1\"", "\"\"", &["stages[0].name"]);
}

#[test]
fn calibrated_camera_keeps_its_values() {
    let calibration = "fx_px = 211.0\nfy_px = 212.5\ncx_px = 150.25\ncy_px = 130.0\n\
        distortion = { model = \"brown-conrady\", k1 = -0.2, p2 = 0.001 }\n\
        near_m = 0.2\nrate_hz = 15.0\nyaw_deg = 90.0\nroll_deg = 90.0";
    let arena =
        ArenaConfig::parse(&FOREST.replace("horizontal_fov_deg = 90.0", calibration)).unwrap();
    assert_eq!(ArenaConfig::parse(&arena.to_toml().unwrap()).unwrap(), arena);
    let camera = &arena.cameras[0];
    let k = camera.intrinsics();
    assert_eq!([k.fx_px, k.fy_px, k.cx_px, k.cy_px], [211.0, 212.5, 150.25, 130.0]);
    let lens = Distortion::BrownConrady { k1: -0.2, k2: 0.0, p1: 0.0, p2: 0.001, k3: 0.0 };
    assert_eq!(k.distortion, lens);
    assert_eq!((camera.near_m, camera.rate_hz), (0.2, Some(15.0)));
    // Turned left and tilted up by 10 degrees; its right side, which points ahead without roll, is down.
    let pose = camera.body_from_cam();
    let (sin, cos) = 10f64.to_radians().sin_cos();
    assert!((pose.rotate(DVec3::Z) - DVec3::new(0.0, cos, sin)).length() < 1e-12);
    assert!((pose.rotate(DVec3::X) - DVec3::new(0.0, sin, -cos)).length() < 1e-12);
    assert!((pose.rotate(DVec3::Y) + DVec3::X).length() < 1e-12);
}

#[test]
fn rejects_contradictory_cameras() {
    let fov = "horizontal_fov_deg = 90.0";
    let four = "fx_px = 100.0\nfy_px = 100.0\ncx_px = 160.0\ncy_px = 120.0";
    check_refused(fov, "", &["cameras[0].fx_px = absent", "horizontal_fov_deg, or fx_px"]);
    check_refused(fov, "fx_px = 100.0", &["cameras[0].fy_px = absent", "give all of"]);
    check_refused(fov, &format!("{fov}\n{four}"), &["cameras[0].fx_px = 100", "remove it, or"]);
    let lens = "distortion = { model = \"kannala-brandt\", k1 = 0.01 }";
    check_refused(fov, &format!("{fov}\n{lens}"), &["horizontal_fov_deg = 90", "calibration"]);
    check_refused(fov, lens, &["cameras[0].fx_px = absent", "give all of"]);
    let bad = |from: &str, to: &str, parts: &[&str]| {
        check_refused(fov, &format!("{four}\n{lens}").replace(from, to), parts);
    };
    bad("fx_px = 100.0", "fx_px = -1.0", &["cameras[0].fx_px, fy_px = -1, 100"]);
    bad("cx_px = 160.0", "cx_px = nan", &["cameras[0].cx_px, cy_px = NaN, 120"]);
    bad("k1 = 0.01", "k1 = 1e9", &["cameras[0].distortion", "OpenCV"]);
    bad("k1 = 0.01", "p1 = 0.01", &["line", "p1"]);
    bad("kannala-brandt", "fisheye", &["line", "kannala-brandt"]);
    bad(lens, "near_m = 0.0", &["cameras[0].near_m = 0"]);
    bad(lens, "rate_hz = 0.0", &["cameras[0].rate_hz = 0"]);
    bad(lens, "roll_deg = inf", &["cameras[0].roll_deg = inf"]);
}

#[test]
fn rejects_too_many_cameras_and_equal_names() {
    let arena = ArenaConfig::parse(FOREST).unwrap();
    let twice = ArenaConfig { cameras: vec![arena.cameras[0].clone(); 2], ..arena.clone() };
    let message = twice.validate().unwrap_err().to_string();
    assert!(message.contains("cameras[1].name = \"front\""), "{message}");
    let nine = (0..9).map(|n| CameraConfig { name: n.to_string(), ..arena.cameras[0].clone() });
    let many = ArenaConfig { cameras: nine.collect(), ..arena.clone() };
    assert!(many.validate().unwrap_err().to_string().contains("1 to 8"));
    assert!(ArenaConfig { cameras: vec![], ..arena }.validate().is_err());
}

/// Returns the forest with a second camera and these vehicles.
fn with_vehicles(vehicles: &str) -> Result<ArenaConfig, ConfigError> {
    let camera = &FOREST[FOREST.find("[[cameras]]").unwrap()..FOREST.find("[[stages]]").unwrap()];
    let rear = camera.replace("front", "rear");
    ArenaConfig::parse(&format!("{FOREST}{rear}{vehicles}"))
}

#[test]
fn each_vehicle_has_its_own_spawn_and_cameras() {
    let vehicles = r#"
[[vehicles]]
name = "wasp"
spawn = { position_m = [2.0, 1.0, 0.0], yaw_deg = 30.0 }
cameras = ["rear"]
[[vehicles]]
name = "bee"
"#;
    let arena = with_vehicles(vehicles).unwrap();
    assert_eq!(ArenaConfig::parse(&arena.to_toml().unwrap()).unwrap(), arena);
    let flying = arena.flying(&[]).unwrap();
    let names: Vec<_> = flying.iter().map(|vehicle| vehicle.name.as_str()).collect();
    assert_eq!(names, ["wasp", "bee"]);
    let [wasp, bee] = [0, 1].map(|index| arena.of_vehicle(&flying[index]));
    assert_eq!((wasp.spawn.position_m.y, wasp.cameras.len()), (1.0, 1));
    assert_eq!(wasp.cameras[0].name, "rear");
    assert_eq!((bee.spawn, bee.cameras.len()), (arena.spawn, 2));
    wasp.validate().unwrap();
    // The command line overrides the file; settings in the file of a vehicle that it names still apply.
    let chosen = arena.flying(&["fly".to_owned(), "wasp".to_owned()]).unwrap();
    assert_eq!(chosen, [VehicleConfig::named("fly"), flying[0].clone()]);
    let alone = ArenaConfig::parse(FOREST).unwrap().flying(&[]).unwrap();
    assert_eq!(alone, [VehicleConfig::named("vizflyt")]);
}

#[test]
fn rejects_invalid_vehicles() {
    let check = |vehicle: &str, expected: &str| {
        let error = with_vehicles(&format!("[[vehicles]]\n{vehicle}\n")).unwrap_err().to_string();
        assert!(error.contains(expected), "{error:?} lacks {expected:?}");
    };
    check("name = ''", "vehicles[0].name = \"\"");
    check("name = 'abcdefghijklmnopqrstuvwxyz'", "at most 24 bytes");
    check(
        "name = 'a'\n[[vehicles]]\nname = 'a'",
        "vehicles[1].name = \"a\": another has this name",
    );
    check(
        "name = 'a'\ncameras = ['front', 'left']",
        "vehicles[0].cameras = \"left\": is not among the [[cameras]]: front, rear",
    );
    check("name = 'a'\ncameras = ['rear', 'rear']", "vehicles[0].cameras = \"rear\": another has");
    check("name = 'a'\ncameras = []", "or leave `cameras` out for all");
    let outside = "spawn = { position_m = [0.0, 20.0, 0.0] }";
    check(&format!("name = 'a'\n{outside}"), "vehicles[0].spawn.position_m = [0, 20, 0]: must be");
    check("name = 'a'\nspawn = 3", "line");
    let nine: Vec<_> = (0..9).map(|n| format!("name = '{n}'")).collect();
    check(&nine.join("\n[[vehicles]]\n"), "vehicles = 9 of them");
    let arena = ArenaConfig::parse(FOREST).unwrap();
    let twice = arena.flying(&["a".to_owned(), "a".to_owned()]).unwrap_err().to_string();
    assert!(twice.starts_with("--vehicle = \"a\": another has this name"), "{twice}");
}
