use super::*;
use crate::detect::{Detector, DetectorSettings};
use crate::detection::Detection;
use crate::layout::{LayoutFrame, Tag, TagLayout};
use crate::print::{BAR_MM, Cube, Mat, Paper};
use crate::synth::{Placed, Random, Renderer, SyntheticExposure, webcam};
use glam::{DMat3, DQuat, DVec3};
use vizflyt_protocol::geometry::Distortion;

fn printed() -> TagLayout {
    let mat = Mat {
        family: TagFamily::Tag36h11,
        first_id: 100,
        columns: 4,
        rows: 6,
        pitch_mm: 95.0,
        tag_mm: 70.0,
        middle_m: DVec3::ZERO,
        paper: Paper::A4,
        bar_mm: BAR_MM,
    };
    mat.print().unwrap().layout
}

/// The mat after gluing by hand: off by millimetres, except for the first tag.
fn glued(random: &mut Random) -> TagLayout {
    let mut layout = printed();
    for tag in layout.tags.iter_mut().skip(1) {
        let mut vector = || DVec3::new(random.normal(), random.normal(), 0.2 * random.normal());
        tag.position_m += vector() * 0.003;
        tag.rotation_xyzw =
            (DQuat::from_scaled_axis(vector() * 0.01) * tag.rotation_xyzw).normalize();
    }
    layout
}

/// Pose of a camera above the floor that looks roughly straight down.
fn over(x_m: f64, y_m: f64, height_m: f64, tilt: DVec3) -> Pose<World, Cam> {
    let down = DQuat::from_rotation_x(std::f64::consts::PI);
    Pose::new(DVec3::new(x_m, y_m, height_m), DQuat::from_scaled_axis(tilt) * down)
}

/// Returns the detections of tags by a camera, with `noise_px` on the corners.
fn look(
    lens: &Intrinsics,
    cam_from_layout: impl Fn(DVec3) -> DVec3,
    tags: &[Tag],
    noise_px: f64,
    random: &mut Random,
) -> Vec<Detection> {
    let size = DVec2::new(lens.width_px.into(), lens.height_px.into());
    let mut seen = Vec::new();
    for tag in tags {
        let [a, b, _, d] = tag.corners_m().map(&cam_from_layout);
        let faces = (b - a).cross(d - a).dot(a) < 0.0;
        let corners = tag.corners_m().map(|corner| {
            let noise = DVec2::new(random.normal(), random.normal()) * noise_px;
            lens.project(cam_from_layout(corner))
                .map(|pixel| pixel + noise)
                .filter(|p| p.cmpgt(DVec2::splat(2.0)).all() && p.cmplt(size - 2.0).all())
        });
        if faces && corners.iter().all(Option::is_some) {
            let corners_px = corners.map(Option::unwrap);
            seen.push(Detection {
                family: tag.family,
                id: tag.id,
                corners_px,
                hamming: 0,
                margin: 60.0,
            });
        }
    }
    seen
}

fn flight(tags: &[Tag], lens: &Intrinsics, random: &mut Random) -> Vec<Vec<Detection>> {
    (0..50)
        .map(|i| {
            let along = f64::from(i) / 49.0;
            let tilt = DVec3::new(random.normal(), random.normal(), random.normal()) * 0.2;
            let x_m = 0.12 * (9.0 * along).sin();
            let camera = over(x_m, -0.25 + 0.5 * along, 0.35 + 0.1 * random.unit(), tilt);
            let inverse = camera.inverse();
            look(lens, |p| inverse.transform_point(p), tags, 0.15, random)
        })
        .collect()
}

#[test]
fn surveys_a_glued_mat_and_an_extra_tag_to_a_millimetre() {
    let mut random = Random::new(2);
    let mut truth = glued(&mut random);
    // A tilted tag next to the mat that is not in the layout.
    let pose: Pose<World, Square> =
        Pose::new(DVec3::new(0.3, 0.0, 0.05), DQuat::from_rotation_y(-0.6));
    truth.tags.push(Tag::new(TagFamily::Tag36h11, 7, 0.07, pose));
    let lens = webcam();
    let images = flight(&truth.tags, &lens, &mut random);
    let anchor = (TagFamily::Tag36h11, 100);
    let others = Some((TagFamily::Tag36h11, 0.07));
    let found = mat(&lens, &printed(), others, Some(anchor), &images).unwrap();
    assert_eq!(found.layout.tags.len(), 25);
    assert!(found.left_out.is_empty(), "{:?}", found.left_out);
    // 0.15 px on each of two axes.
    assert!((0.15..0.25).contains(&found.rms_px), "{}", found.rms_px);
    for (tag, residual) in found.layout.tags.iter().zip(&found.residuals) {
        let expected = truth.find(tag.family, tag.id).unwrap();
        let off_m = tag.position_m.distance(expected.position_m);
        assert!(off_m < 0.001, "tag {} is {} mm off", tag.id, 1e3 * off_m);
        assert!(residual.sigma_m < 0.001 && residual.rms_m < 0.0003, "{residual:?}");
        assert_eq!(residual.moved_m.is_none(), tag.id == 7);
    }
    // Without an anchor, the survey is the best fit to the printed layout.
    let found = mat(&lens, &printed(), None, None, &images).unwrap();
    let shift: DVec3 = found
        .layout
        .tags
        .iter()
        .map(|tag| tag.position_m - printed().find(tag.family, tag.id).unwrap().position_m)
        .sum();
    assert!(shift.length() / 24.0 < 1e-4, "{shift}");
}

#[test]
fn surveys_a_mat_from_rendered_images() {
    let mut random = Random::new(4);
    let truth = glued(&mut random);
    let lens = webcam();
    let renderer = Renderer::new(lens);
    let mut detector = Detector::new(&[TagFamily::Tag36h11], DetectorSettings::default());
    let placed = [Placed::fixed(&truth)];
    let images: Vec<Vec<Detection>> = (0..12u32)
        .map(|i| {
            let tilt = DVec3::new(random.normal(), random.normal(), random.normal()) * 0.2;
            let camera =
                over(0.05 * (f64::from(i % 3) - 1.0), 0.06 * f64::from(i / 3) - 0.1, 0.5, tilt);
            let shot = SyntheticExposure {
                blur_px: 0.6,
                noise: 3.0,
                seed: i.into(),
                ..SyntheticExposure::still(&placed, camera)
            };
            detector.search(&renderer.render(&shot), &lens, true)
        })
        .collect();
    let found = mat(&lens, &printed(), None, Some((TagFamily::Tag36h11, 100)), &images).unwrap();
    assert_eq!(found.layout.tags.len(), 24, "{:?}", found.left_out);
    for tag in &found.layout.tags {
        let off_m = tag.position_m.distance(truth.find(tag.family, tag.id).unwrap().position_m);
        assert!(off_m < 0.0015, "tag {} is {} mm off", tag.id, 1e3 * off_m);
    }
}

#[test]
fn rejects_invalid_surveys_with_the_reason() {
    let mut random = Random::new(2);
    let lens = webcam();
    let images = flight(&printed().tags, &lens, &mut random);
    let refused = |lens: &Intrinsics, anchor, images: &[Vec<Detection>], parts: &[&str]| {
        let error = mat(lens, &printed(), None, anchor, images).unwrap_err().to_string();
        for part in parts {
            assert!(error.contains(part), "{error:?} lacks {part:?}");
        }
    };
    refused(&lens, None, &images[..3], &["3 usable images", "5 are needed"]);
    refused(&lens, Some((TagFamily::Tag36h11, 9)), &images, &["tag36h11 9"]);
    let other = Intrinsics { fx_px: 700.0, fy_px: 930.0, distortion: Distortion::None, ..lens };
    refused(&other, None, &images, &["px off", "camera file"]);
    // A tag without images is reported as left out.
    let few: Vec<Vec<Detection>> = images
        .iter()
        .map(|image| image.iter().copied().filter(|d| d.id != 110).collect())
        .collect();
    let found = mat(&lens, &printed(), None, None, &few).unwrap();
    assert_eq!(found.left_out, [(TagFamily::Tag36h11, 110, "in no image")]);
}

fn cube() -> TagLayout {
    let cube = Cube {
        family: TagFamily::Tag36h11,
        first_id: 0,
        faces: 5,
        face_mm: 170.0,
        tag_mm: 132.0,
        middle_m: DVec3::ZERO,
        paper: Paper::A4,
        bar_mm: BAR_MM,
    };
    cube.print().unwrap().layout
}

/// Pose of a camera at `from_m` that looks at `to_m`.
fn towards(from_m: DVec3, to_m: DVec3) -> Pose<World, Cam> {
    let z = (to_m - from_m).normalize();
    let x = z.cross(DVec3::Z).normalize();
    Pose::new(from_m, DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z)).normalize())
}

#[test]
fn locates_cameras_by_the_mat_or_else_by_the_cube() {
    let mut random = Random::new(9);
    let lens = webcam();
    let large = Mat {
        family: TagFamily::Tag36h11,
        first_id: 100,
        columns: 3,
        rows: 3,
        pitch_mm: 250.0,
        tag_mm: 180.0,
        middle_m: DVec3::ZERO,
        paper: Paper::A3,
        bar_mm: BAR_MM,
    };
    let mat_layout = large.print().unwrap().layout;
    let middle = DVec3::new(0.0, 0.0, 0.7);
    let truth = [
        towards(DVec3::new(-3.0, -1.5, 2.5), middle),
        towards(DVec3::new(3.0, -1.0, 2.2), middle),
        towards(DVec3::new(0.0, 3.0, 2.4), middle + DVec3::Z * 0.3),
    ];
    let moments: Vec<Pose<World, Body>> = (0..14)
        .map(|i| {
            let angle = f64::from(i);
            let p =
                DVec3::new(0.9 * angle.sin(), 0.7 * (1.7 * angle).cos(), 0.9 + 0.3 * random.unit());
            Pose::new(p, DQuat::from_rotation_z(angle * 0.7))
        })
        .collect();
    let see = |camera: usize, sees_mat: bool, random: &mut Random| -> CameraImages {
        let cam_from_world = truth[camera].inverse();
        let images = moments
            .iter()
            .map(|world_from_body| {
                let cam_from_body = cam_from_world * *world_from_body;
                let tags = cube().tags;
                let mut seen =
                    look(&lens, |p| cam_from_body.transform_point(p), &tags, 0.2, random);
                if sees_mat {
                    let tags = &mat_layout.tags;
                    seen.extend(look(
                        &lens,
                        |p| cam_from_world.transform_point(p),
                        tags,
                        0.2,
                        random,
                    ));
                }
                seen
            })
            .collect();
        CameraImages { name: format!("camera {camera}"), intrinsics: lens, images }
    };
    let all = [see(0, true, &mut random), see(1, true, &mut random), see(2, false, &mut random)];
    let found = cameras(&all, &mat_layout, Some(&cube())).unwrap();
    let scale = found.cube.expect("there is a cube");
    assert!((scale.scale - 1.0).abs() < 4.0 * scale.sigma && scale.sigma < 0.002, "{scale:?}");
    for (found, truth) in found.cameras.iter().zip(&truth) {
        let off_m = found.world_from_cam.translation_m.distance(truth.translation_m);
        let off_rad = found.world_from_cam.rotation.angle_between(truth.rotation);
        assert!(off_m < 0.005 && off_rad < 0.002, "{off_m} m, {off_rad} rad off: {found:?}");
        assert!(off_m < 5.0 * found.sigma_m && found.sigma_m < 0.01, "{off_m}: {found:?}");
        assert!(found.rms_px < 0.4, "{found:?}");
    }
    // Printed at 97 %: two cameras that see the mat determine the size.
    let mut shrunk = cube();
    for tag in &mut shrunk.tags {
        tag.size_m /= 0.97;
        tag.position_m /= 0.97;
    }
    let found = cameras(&all, &mat_layout, Some(&shrunk)).unwrap();
    let scale = found.cube.expect("there is a cube");
    assert!((scale.scale - 0.97).abs() < 4.0 * scale.sigma && scale.sigma < 0.002, "{scale:?}");
    for (found, truth) in found.cameras.iter().zip(&truth) {
        let off_m = found.world_from_cam.translation_m.distance(truth.translation_m);
        assert!(off_m < 0.005, "{off_m} m off: {found:?}");
    }
    // A single camera that sees the mat does not: the other camera's distance scales with the cube.
    let alone = [see(0, true, &mut random), see(1, false, &mut random)];
    let scale = cameras(&alone, &mat_layout, Some(&shrunk)).unwrap().cube.expect("there is a cube");
    assert!(scale.sigma > 0.02, "{scale:?}");
    // Without the cube, the third camera has no connection to the room.
    let error = cameras(&all, &mat_layout, None).unwrap_err().to_string();
    assert!(error.contains("\"camera 2\"") && error.contains("cube"), "{error}");
    // A cube that is larger than its layout contradicts the mat.
    let mut larger = cube();
    for tag in &mut larger.tags {
        tag.size_m *= 1.1;
    }
    let error = cameras(&all, &mat_layout, Some(&larger)).unwrap_err().to_string();
    assert!(error.contains("px off"), "{error}");
    assert_eq!(mat_layout.frame, LayoutFrame::World);
}
