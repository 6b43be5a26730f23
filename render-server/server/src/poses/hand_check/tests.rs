mod setups;

use std::fmt::Write;

use super::*;
use proptest::prelude::*;

fn config(text: &str) -> LocalizationConfig {
    LocalizationConfig::parse(text).unwrap()
}

/// Motions of the user, at 50 Hz: (up [m], ahead [m], left [rad], nose up [rad]); in the last one the left side
/// is raised instead.
fn carried(start: &Pose<World, Body>, jitter: f64) -> Vec<(f64, Pose<World, Body>)> {
    let held = [
        (0.0, 0.0, 0.0, 0.0),
        (0.45, 0.03, 0.05, 0.0),
        (0.47, 0.6, -0.08, 0.05),
        (0.5, 0.63, 1.45, 0.03),
        (0.48, 0.6, 1.5, 0.5),
        (0.5, 0.6, 1.52, 0.04),
    ];
    let mut poses = Vec::new();
    let mut before = held[0];
    for (index, now) in held.into_iter().enumerate() {
        for tick in 0..120u32 {
            let share = (f64::from(tick) / 60.0).min(1.0);
            let mix = |a: f64, b: f64| a + (b - a) * share;
            // Tremor, the same in every run.
            let shake = DVec3::new((tick * 7 % 5) as f64, (tick * 3 % 7) as f64, (tick % 3) as f64);
            let p = start.translation_m
                + DVec3::Z * mix(before.0, now.0)
                + start.rotate(DVec3::X * mix(before.1, now.1))
                + shake * jitter;
            let rotation = start.rotation
                * DQuat::from_rotation_z(mix(before.2, now.2))
                * DQuat::from_rotation_y(-mix(before.3, now.3))
                * DQuat::from_rotation_x(if index == 5 { 0.5 * share } else { 0.0 });
            let at_s = index as f64 * 2.4 + f64::from(tick) * 0.02;
            poses.push((at_s, Pose::new(p, rotation)));
        }
        before = now;
    }
    poses
}

/// Runs the check for a vehicle with the stream settings `stream`, on a server with the settings `set`.
fn diagnosis(stream: &LocalizationConfig, set: &LocalizationConfig, yaw_rad: f64) -> Diagnosis {
    let start = Pose::new(DVec3::new(1.0, -2.0, 0.02), DQuat::from_rotation_z(yaw_rad));
    let mut check = Check::new(set.clone());
    for (at_s, pose) in carried(&start, 2e-4) {
        let (p_stream, rotation) = stream.alignment().streamed(&pose);
        let rotation = match stream.driver {
            Driver::Vicon => {
                let angles = stream.euler.unwrap_or_default().angles(rotation);
                set.euler.unwrap_or_default().rotation(angles)
            }
            _ => rotation,
        };
        check.handle_pose(at_s, &set.alignment().world_from_body(p_stream, rotation));
    }
    assert_eq!(check.step(), HandCheckStep::Done, "{stream:?} as {set:?}: {:?}", check.rests);
    check.diagnosis()
}

fn check(stream: &str, set: &str, expected: &[(&str, &str)]) {
    let diagnosis = diagnosis(&config(stream), &config(set), 0.3);
    let found: Vec<_> =
        diagnosis.change.iter().map(|(key, value)| (*key, value.as_str())).collect();
    assert_eq!(found, expected, "{stream} as {set}: {:#?}", diagnosis.faults);
    assert_eq!(diagnosis.faults.is_empty(), expected.is_empty(), "{:#?}", diagnosis.faults);
}

#[test]
fn keeps_correct_settings() {
    for settings in [
        "vicon",
        "json",
        "natnet,up=y",
        "vicon,euler=zyx,units=cm,nose=-y",
        "json,axes=x-yz,offset.yaw_deg=50",
    ] {
        check(settings, settings, &[]);
    }
}

#[test]
fn names_the_setting_to_change() {
    // Swapped axes.
    check("natnet,up=y", "natnet", &[("up", "y")]);
    check("natnet", "natnet,up=y", &[("up", "z")]);
    check("json,axes=yzx", "json", &[("axes", "yzx")]);
    // Mirrored frames.
    check("json,axes=x-yz", "json", &[("axes", "x-yz")]);
    check("json", "json,axes=x-yz", &[("axes", "xyz")]);
    // Wrong units.
    check("json,units=mm", "json", &[("units", "mm")]);
    check("vicon,units=m", "vicon", &[("units", "m")]);
    check("natnet,units=cm", "natnet", &[("units", "cm")]);
    // Wrong Euler order.
    check("vicon", "vicon,euler=zyx", &[("euler", "xyz")]);
    check("vicon,euler=zyx", "vicon", &[("euler", "zyx")]);
    check("vicon,euler=vector", "vicon", &[("euler", "vector")]);
    // Other axes of the object.
    check("json,nose=y", "json", &[("nose", "y")]);
    check("json", "json,nose=-x", &[("nose", "x")]);
    // Two changes at once.
    check("natnet,up=y,units=mm", "natnet", &[("units", "mm"), ("up", "y")]);
    check("vicon,units=m,nose=y", "vicon", &[("units", "m"), ("nose", "y")]);
}

#[test]
fn findings_are_described() {
    let found = diagnosis(&config("natnet,up=y"), &config("natnet"), 0.0);
    assert!(found.faults[0].starts_with("lifted, it went along +y, not up"), "{:#?}", found.faults);
    let found = diagnosis(&config("json,axes=x-yz"), &config("json"), 0.0);
    assert!(found.faults.iter().any(|fault| fault.contains("it turned right by")), "{found:?}");
    let found = diagnosis(&config("json,units=mm"), &config("json"), 0.0);
    assert_eq!(found.faults, ["lifted by half a metre or so, it went 449.50 m"]);
}

#[test]
fn a_vehicle_that_moves_on_is_not_at_rest() {
    let mut check = Check::new(config("json"));
    for tick in 0..500u32 {
        let t = f64::from(tick) * 0.01;
        let pose = Pose::new(DVec3::X * t, DQuat::IDENTITY);
        assert!(!check.handle_pose(t, &pose), "at {t} s");
    }
    // The same while it turns on the spot.
    let mut check = Check::new(config("json"));
    for tick in 0..500u32 {
        let t = f64::from(tick) * 0.01;
        assert!(!check.handle_pose(t, &Pose::new(DVec3::X, DQuat::from_rotation_z(t))), "at {t} s");
    }
    // Standing still for long does not count as a lift.
    let mut check = Check::new(config("json"));
    for tick in 0..2000u32 {
        let shake = DVec3::splat(f64::from(tick * 7 % 11) * 1e-4);
        check.handle_pose(f64::from(tick) * 0.005, &Pose::new(shake, DQuat::IDENTITY));
    }
    assert_eq!(check.step(), HandCheckStep::Lift);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// For any stream and settings, the named change corrects the poses.
    #[test]
    fn the_change_corrects_the_poses(axes in 0usize..48, nose in 0usize..4, unit in 0usize..3, yaw_rad in -3.0..3.0f64) {
        let mut stream = config("json");
        stream.axes = Axes::all().nth(axes);
        stream.nose = Nose::NAMED[nose];
        stream.units = Some(Units::ALL[unit]);
        let first = diagnosis(&stream, &config("json"), yaw_rad);
        let mut text = "json".to_owned();
        for (key, value) in &first.change {
            let _ = write!(text, ",{key}={value}");
        }
        prop_assert!(first.faults.is_empty() || !first.change.is_empty(), "{:?}", first);
        let second = diagnosis(&stream, &config(&text), yaw_rad);
        prop_assert_eq!(second, Diagnosis::default(), "{}", text);
    }
}
