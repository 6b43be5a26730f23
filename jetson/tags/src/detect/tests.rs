use super::*;
use crate::layout::{CORNERS, LayoutFrame, Square, Tag, TagLayout};
use crate::synth::{Light, Placed, Renderer, SyntheticExposure, webcam};
use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Cam, Pose, World};

/// A tag of 0.16 m in front of a camera at the world's origin that looks along x.
fn tag_at(p_cam: DVec3, tilt: DVec3) -> (TagLayout, Pose<World, Cam>, Pose<Cam, Square>) {
    let world_from_cam = Pose::new(
        DVec3::ZERO,
        DQuat::from_mat3(&glam::DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X)),
    );
    let towards = DQuat::from_rotation_x(std::f64::consts::PI);
    let cam_from_tag: Pose<Cam, Square> = Pose::new(p_cam, towards * DQuat::from_scaled_axis(tilt));
    let world_from_tag = world_from_cam * cam_from_tag;
    let tag = Tag::new(TagFamily::Tag36h11, 17, 0.16, world_from_tag);
    (TagLayout { frame: LayoutFrame::World, tags: vec![tag] }, world_from_cam, cam_from_tag)
}

/// Returns the number of views in which the tag was detected, and the root mean square and maximum error of its
/// corners. [px]
fn errors(distance_m: f64, views: u32) -> (usize, f64, f64) {
    let camera = webcam();
    let renderer = Renderer::new(camera);
    let mut detector = Detector::new(&[TagFamily::Tag36h11], DetectorSettings::default());
    let (mut found, mut sum, mut greatest) = (0, 0.0, 0.0f64);
    for view in 0..views {
        let turn = |rate: f64| (f64::from(view) * rate).sin();
        let p_cam = DVec3::new(0.45 * turn(1.3), 0.22 * turn(2.1), 1.0) * distance_m;
        let tilt = DVec3::new(0.6 * turn(3.3), 0.6 * turn(0.7), 3.0 * turn(5.1));
        let (layout, world_from_cam, cam_from_tag) = tag_at(p_cam, tilt);
        let placed = [Placed::fixed(&layout)];
        let image = renderer.render(&SyntheticExposure {
            light: Light { gradient: DVec2::new(0.4, -0.2), vignette: 0.3, ..Light::default() },
            blur_px: 0.6,
            noise: 4.0,
            seed: view.into(),
            ..SyntheticExposure::still(&placed, world_from_cam)
        });
        let truth = CORNERS
            .map(|c| camera.project(cam_from_tag.transform_point((c * 0.16).extend(0.0))).unwrap());
        let middle = truth.iter().sum::<DVec2>() / 4.0;
        let edge = shortest(&truth);
        let region = Region {
            least_px: middle - 1.6 * edge - 10.0,
            most_px: middle + 1.6 * edge + 10.0,
            tag_edge_px: Some(edge),
        };
        let tags = detector.look(&image, &region, &camera);
        assert!(tags.len() <= 1, "{tags:?}");
        let Some(tag) = tags.first() else { continue };
        assert_eq!((tag.family, tag.id), (TagFamily::Tag36h11, 17));
        found += 1;
        for (seen, truth) in tag.corners_px.iter().zip(truth) {
            sum += seen.distance_squared(truth);
            greatest = greatest.max(seen.distance(truth));
        }
    }
    (found, (sum / f64::from(4 * found as u32)).sqrt(), greatest)
}

#[test]
fn finds_corners_to_a_fraction_of_a_pixel() {
    for (distance_m, most_rms_px) in
        [(1.0, 0.08), (2.0, 0.1), (4.0, 0.1), (6.0, 0.12), (8.0, 0.15), (10.0, 0.2)]
    {
        let (found, rms_px, greatest_px) = errors(distance_m, 40);
        println!("{distance_m} m: {found} of 40, {rms_px:.3} px, {greatest_px:.3} px at most");
        assert!(found >= 37, "{distance_m} m: {found} of 40");
        assert!(rms_px < most_rms_px, "{distance_m} m: {rms_px} px");
    }
}

#[test]
fn searches_the_whole_image_at_reduced_resolution() {
    let camera = webcam();
    let renderer = Renderer::new(camera);
    let mut detector = Detector::new(&[TagFamily::Tag36h11], DetectorSettings::default());
    let (layout, world_from_cam, cam_from_tag) =
        tag_at(DVec3::new(1.2, -0.5, 3.0), DVec3::new(0.3, -0.4, 1.0));
    let image = renderer.render(&SyntheticExposure {
        blur_px: 0.6,
        noise: 3.0,
        ..SyntheticExposure::still(&[Placed::fixed(&layout)], world_from_cam)
    });
    let found = detector.search(&image, &camera, false);
    assert_eq!(found.iter().map(|tag| tag.id).collect::<Vec<_>>(), [17]);
    for (seen, c) in found[0].corners_px.iter().zip(CORNERS) {
        let p_cam = cam_from_tag.transform_point((c * 0.16).extend(0.0));
        let truth = camera.project(p_cam).unwrap();
        assert!(seen.distance(truth) < 0.3, "{seen} for {truth}");
    }
    // A region that extends beyond the image is cut. A region without the tag yields no detection.
    let beside =
        Region { least_px: DVec2::splat(-50.0), most_px: DVec2::splat(300.0), tag_edge_px: None };
    assert!(detector.look(&image, &beside, &camera).is_empty());
    let around =
        Region { least_px: DVec2::new(600.0, -1e9), most_px: DVec2::splat(1e9), tag_edge_px: None };
    assert_eq!(detector.look(&image, &around, &camera).len(), 1);
    // A detector for another family finds no tag.
    let mut other = Detector::new(&[TagFamily::Tag25h9], DetectorSettings::default());
    assert!(other.search(&image, &camera, false).is_empty());
}

#[test]
fn accepts_images_and_regions_of_any_size() {
    let mut detector = Detector::new(&TagFamily::ALL, DetectorSettings::default());
    let all = Region { least_px: DVec2::ZERO, most_px: DVec2::splat(1e4), tag_edge_px: Some(10.0) };
    for (width, height) in [(0, 0), (1, 1), (3, 500), (24, 24), (25, 31), (641, 27)] {
        let camera = Intrinsics { width_px: width, height_px: height, ..webcam() };
        for seed in 0..3u32 {
            let pixels =
                (0..width * height).map(|i| (i.wrapping_mul(2654435761 + seed) >> 24) as u8);
            let image = Gray::new(width, height, pixels.collect()).unwrap();
            assert!(detector.search(&image, &camera, false).is_empty());
            assert!(detector.look(&image, &all, &camera).is_empty());
            for poison in [f64::NAN, f64::INFINITY] {
                let nowhere = Region { most_px: DVec2::new(poison, 50.0), ..all };
                assert!(detector.look(&image, &nowhere, &camera).is_empty());
            }
        }
    }
}

#[test]
fn returns_border_corners_for_families_with_data_outside_the_border() {
    let camera = webcam();
    let renderer = Renderer::new(camera);
    for family in TagFamily::ALL {
        let mut detector = Detector::new(&[family], DetectorSettings::default());
        let (mut layout, world_from_cam, cam_from_tag) =
            tag_at(DVec3::new(0.1, 0.05, 1.2), DVec3::new(0.3, 0.2, -2.0));
        layout.tags[0].family = family;
        let image = renderer.render(&SyntheticExposure {
            blur_px: 0.5,
            ..SyntheticExposure::still(&[Placed::fixed(&layout)], world_from_cam)
        });
        let found = detector.search(&image, &camera, false);
        let [tag] = found[..] else { panic!("{family}: {found:?}") };
        assert_eq!((tag.family, tag.id), (family, 17));
        for (seen, c) in tag.corners_px.iter().zip(CORNERS) {
            let truth =
                camera.project(cam_from_tag.transform_point((c * 0.16).extend(0.0))).unwrap();
            assert!(seen.distance(truth) < 0.4, "{family}: {seen} for {truth}");
        }
    }
}
