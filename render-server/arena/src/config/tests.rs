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

/// Parses the forest with one line replaced and expects a message that holds each of `parts`.
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
fn toml_errors_point_at_the_line() {
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
fn values_that_cannot_work_are_refused_by_key_and_value() {
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
fn cameras_are_bounded_and_named_apart() {
    let arena = ArenaConfig::parse(FOREST).unwrap();
    let twice = ArenaConfig { cameras: vec![arena.cameras[0].clone(); 2], ..arena.clone() };
    let message = twice.validate().unwrap_err().to_string();
    assert!(message.contains("cameras[1].name = \"front\""), "{message}");
    let nine = (0..9).map(|n| CameraConfig { name: n.to_string(), ..arena.cameras[0].clone() });
    let many = ArenaConfig { cameras: nine.collect(), ..arena.clone() };
    assert!(many.validate().unwrap_err().to_string().contains("1 to 8"));
    assert!(ArenaConfig { cameras: vec![], ..arena }.validate().is_err());
}
