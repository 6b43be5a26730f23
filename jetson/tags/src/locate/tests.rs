use super::*;
use crate::print::Floor;
use crate::simulated::{Sensor, SimulatedCamera, Truth, cube, over_mat, webcams};
use glam::{DQuat, DVec2};

fn at(ms: u64) -> HostTime {
    HostTime::from_ns(3_000_000_000 + ms * 1_000_000)
}

/// Returns the images of one camera of a vehicle that moves as given; the truth is updated every millisecond.
fn images(
    camera: &TagCamera,
    layouts: &[TagLayout],
    pose_at: impl Fn(f64) -> Pose<World, Body>,
    until_ms: u64,
) -> Vec<(HostTime, Gray)> {
    let mut simulated = SimulatedCamera::new(camera.clone(), Sensor::default());
    let mut truth = Truth::default();
    let mut all = Vec::new();
    for ms in 0..until_ms {
        truth.push(at(ms), pose_at(ms as f64 * 1e-3));
        all.extend(simulated.expose(&truth, layouts, false));
    }
    all
}

fn locator(cameras: Vec<TagCamera>, layouts: &[TagLayout]) -> Locator {
    Locator::new(cameras, layouts, LocateSettings::default()).expect("sound")
}

#[test]
fn rejects_invalid_setups_with_the_reason() {
    let check = |cameras: Vec<TagCamera>, layouts: &[TagLayout], part: &str| {
        let error = Locator::new(cameras, layouts, LocateSettings::default()).err();
        let error = error.expect(part).to_string();
        assert!(error.contains(part), "{error:?} lacks {part:?}");
    };
    let floor = over_mat::floor(Vec::new()).print().unwrap().layout;
    check(Vec::new(), &[cube()], "0 cameras");
    check(webcams(1), &[], "0 layouts");
    check(webcams(2), std::slice::from_ref(&floor), "add the layout of the cube");
    check(vec![over_mat::camera()], &[cube()], "add the surveyed layout");
    check(webcams(1), &[cube(), cube()], "tag36h11 is in two layouts");
    let unmounted = TagCamera { mounting: Mounting::Unknown, ..over_mat::camera() };
    check(vec![unmounted], &[floor], "\"belly\" has neither");
}

#[test]
fn resolves_the_ambiguity_of_one_far_face_to_the_true_pose() {
    let camera = webcams(1).remove(0);
    // Only the tail's tag, seen nearly from the front at 5 m.
    let face = TagLayout { tags: vec![cube().tags[2]], ..cube() };
    let pose_at = |t_s: f64| {
        let turn = DQuat::from_rotation_z(-0.35 + 0.5 * t_s) * DQuat::from_rotation_y(0.3);
        Pose::new(DVec3::new(4.6, 0.2 * t_s, 1.6), turn)
    };
    let layouts = [face];
    let mut locator = locator(vec![camera.clone()], &layouts);
    let (mut open, mut located) = (0, 0);
    for (stamp, image) in images(&camera, &layouts, pose_at, 1500) {
        match locator.handle_images(&[StampedImage { camera: 0, stamp, image: &image }]).located {
            Ok(found) => {
                located += 1;
                let truth = pose_at(stamp.seconds_since(at(0)));
                let angle = found.world_from_body.rotation.angle_between(truth.rotation);
                assert!(angle < 0.35, "{angle} rad off at {stamp:?}: the false one");
            }
            Err(Unlocated::Ambiguous) => open += 1,
            Err(other) => panic!("{other:?}"),
        }
    }
    println!("{open} open, {located} located");
    assert!(located > 20, "{open} open, {located} located");
}

#[test]
fn ignores_unknown_tags_and_reports_no_tag() {
    let camera = webcams(1).remove(0);
    let mut other = cube();
    for tag in &mut other.tags {
        tag.id += 50;
    }
    let pose_at = |_| Pose::new(DVec3::new(4.0, 0.0, 1.5), DQuat::IDENTITY);
    let mut locator = locator(vec![camera.clone()], &[cube()]);
    for (stamp, image) in images(&camera, &[other], pose_at, 100) {
        let outcome = locator.handle_images(&[StampedImage { camera: 0, stamp, image: &image }]);
        assert_eq!(outcome.located.err(), Some(Unlocated::NoTag));
        assert!(outcome.looks[0].strangers.iter().all(|tag| tag.id >= 50));
        assert!(!outcome.looks[0].strangers.is_empty());
    }
}

#[test]
fn finds_a_displaced_vehicle_again_and_rejects_old_images() {
    let camera = webcams(1).remove(0);
    // The vehicle is moved between two images.
    let pose_at = |t_s: f64| {
        let y_m = if t_s < 0.3 { -0.6 } else { 0.8 };
        Pose::new(DVec3::new(4.0, y_m, 1.5), DQuat::from_rotation_z(0.5))
    };
    let all = images(&camera, &[cube()], pose_at, 1100);
    let mut locator = locator(vec![camera.clone()], &[cube()]);
    let mut last = None;
    for (stamp, image) in &all {
        let outcome = locator.handle_images(&[StampedImage { camera: 0, stamp: *stamp, image }]);
        if let Ok(found) = outcome.located {
            let truth = pose_at(stamp.seconds_since(at(0)));
            let off_m = found.world_from_body.translation_m.distance(truth.translation_m);
            assert!(off_m < 0.05, "{off_m} m at {stamp:?}");
            // The pose predicts the corners.
            for seen in &outcome.looks[0].seen {
                let expected = seen.expected_px.expect("there is a pose");
                let off = expected[0].distance(seen.detection.corners_px[0]);
                assert!(off < 1.0, "{off} px");
            }
            last = Some(*stamp);
        }
    }
    assert!(last.expect("it was found").seconds_since(at(0)) > 0.9, "found again");
    let (stamp, image) = &all[3];
    let outcome = locator.handle_images(&[StampedImage { camera: 0, stamp: *stamp, image }]);
    assert!(matches!(outcome.located, Err(Unlocated::Old | Unlocated::NoTag)));
}

#[test]
fn does_not_wait_for_a_camera_that_sees_the_vehicle_at_its_edge() {
    // Near the hall's east end the east camera sees only a part of the cube and no complete tag.
    let cameras = webcams(2);
    let pose_at = |t_s: f64| {
        let drift = DVec3::new((3.0 * t_s).sin(), (2.0 * t_s).cos(), 0.0) * 0.03;
        Pose::new(DVec3::new(9.3, 1.2, 1.4) + drift, DQuat::from_rotation_z(0.2 * t_s))
    };
    let mut all: Vec<_> = (0..2)
        .flat_map(|index| {
            let shots = images(&cameras[index], &[cube()], pose_at, 1100);
            shots.into_iter().map(move |(stamp, image)| (stamp, index, image))
        })
        .collect();
    all.sort_by_key(|(stamp, index, _)| (*stamp, *index));
    let mut locator = locator(cameras, &[cube()]);
    let (mut hidden, mut found) = (0, 0);
    for (stamp, camera, image) in &all {
        let outcome =
            locator.handle_images(&[StampedImage { camera: *camera, stamp: *stamp, image }]);
        if stamp.seconds_since(at(0)) < 0.2 {
            continue;
        }
        let look = &outcome.looks[0];
        match camera {
            0 => found += u32::from(outcome.located.is_ok()),
            _ if look.seen.is_empty() => {
                hidden += 1;
                assert!(look.region.is_some(), "{stamp:?}: the whole image was searched");
            }
            _ => {}
        }
    }
    assert!(found > 20 && hidden > 12, "{found} found by one, {hidden} hidden from the other");
}

/// Flies a circle in front of two webcams that are exposed in turn; stamps of the second are late by `late_s`. Returns
/// the findings, and the position error in the last second: root mean square in metres, and mean square in sigmas.
fn fly_before(
    files: Vec<TagCamera>,
    room: Option<&TagLayout>,
    late_s: f64,
) -> (Vec<String>, f64, f64) {
    let pose_at = |t_s: f64| {
        let (s, c) = (1.3 * t_s).sin_cos();
        Pose::new(DVec3::new(5.5 + c, 0.8 * s, 1.4 + 0.2 * s), DQuat::from_rotation_z(0.6 * t_s))
    };
    let layouts: Vec<TagLayout> = std::iter::once(cube()).chain(room.cloned()).collect();
    let mut all = Vec::new();
    for (index, camera) in webcams(2).into_iter().enumerate() {
        let sensor = Sensor { phase: 0.5 * index as f64, ..Sensor::default() };
        let mut simulated = SimulatedCamera::new(camera, sensor);
        let mut truth = Truth::default();
        for ms in 0..3000 {
            truth.push(at(ms), pose_at(ms as f64 * 1e-3));
            if let Some((stamp, image)) = simulated.expose(&truth, &layouts, false) {
                all.push((stamp.plus_seconds(late_s * index as f64), index, image));
            }
        }
    }
    all.sort_by_key(|(stamp, index, _)| (*stamp, *index));
    let mut locator = locator(files, &layouts);
    let (mut off_m2, mut sigmas, mut count) = (0.0f64, 0.0, 0.0);
    for (stamp, camera, image) in &all {
        let image = StampedImage { camera: *camera, stamp: *stamp, image };
        let Ok(found) = locator.handle_images(&[image]).located else { continue };
        let t_s = found.stamp.seconds_since(at(0));
        if t_s > 2.0 {
            let off = found.world_from_body.translation_m - pose_at(t_s).translation_m;
            off_m2 += off.length_squared();
            sigmas += (off / found.position_sigma_m).length_squared() / 3.0;
            count += 1.0;
        }
    }
    let findings =
        locator.findings().iter().map(|finding| finding.words(&["west", "east"])).collect();
    (findings, (off_m2 / count).sqrt(), sigmas / count)
}

#[test]
fn finds_names_and_corrects_errors_of_the_lab() {
    let moved = |index: usize| {
        let mut files = webcams(2);
        if let Mounting::World(pose) = &mut files[index].mounting {
            pose.translation_m += DVec3::new(0.012, -0.018, 0.01);
            pose.rotation *= DQuat::from_scaled_axis(DVec3::new(0.006, 0.009, -0.004));
        }
        files
    };
    let check = |files: Vec<TagCamera>, room, late_s, expected: &[&str]| {
        let (found, off_m, sigmas) = fly_before(files, room, late_s);
        println!("{found:?}, {off_m} m, {sigmas}");
        assert_eq!(found.len(), expected.len(), "{found:?}");
        for (found, part) in found.iter().zip(expected) {
            assert!(found.contains(part), "{found} lacks {part}");
        }
        assert!(off_m < 0.01, "{off_m} m");
        assert!(sigmas < 2.5, "{sigmas}");
    };
    check(webcams(2), None, 0.0, &[]);
    check(webcams(2), None, 0.03, &["east stamps images"]);
    let floor = Floor { size_m: DVec2::splat(2.0), ..over_mat::floor(Vec::new()) };
    let floor = floor.print().unwrap().layout;
    check(moved(0), Some(&floor), 0.0, &["west camera moved by 2."]);
    check(moved(1), Some(&floor), 0.0, &["east camera moved by 2."]);
}
