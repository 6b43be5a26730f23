use super::*;
use glam::DQuat;
use vizflyt_protocol::geometry::Distortion;

fn one_tag(size_m: f64) -> TagLayout {
    let world_from_tag: Pose<World, Square> = Pose::IDENTITY;
    TagLayout {
        frame: LayoutFrame::World,
        tags: vec![Tag::new(TagFamily::Tag36h11, 3, size_m, world_from_tag)],
    }
}

/// A camera at this height above the origin that looks down, with the top of the image to the north.
fn above(height_m: f64) -> Pose<World, Cam> {
    // x of the camera points east, y south, z down.
    Pose::new(DVec3::Z * height_m, DQuat::from_rotation_x(std::f64::consts::PI))
}

#[test]
fn renders_cells_at_their_projected_positions() {
    let lens = Distortion::BrownConrady { k1: -0.2, k2: 0.05, p1: 0.001, p2: -0.001, k3: 0.0 };
    let k = Intrinsics { distortion: lens, ..Intrinsics::from_horizontal_fov(640, 480, 1.2) };
    let mat = one_tag(0.4);
    let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.2, 0.5);
    let world_from_cam = Pose::new(DVec3::new(0.1, -0.2, 0.8), turn * above(1.0).rotation);
    let image =
        Renderer::new(k).render(&SyntheticExposure::still(&[Placed::fixed(&mat)], world_from_cam));
    let cells = TagFamily::Tag36h11.cells(3).unwrap();
    let mut seen = 0;
    for row in 0..10 {
        for column in 0..10 {
            // Middle of the cell, from the upper left of the tag.
            let along = |i: u32| (f64::from(i) + 0.5 - 5.0) * 0.4 / 8.0;
            let p_world = DVec3::new(along(column), -along(row), 0.0);
            let Some(pixel) = k.project(world_from_cam.inverse().transform_point(p_world)) else {
                continue;
            };
            if pixel.x < 0.0 || pixel.y < 0.0 || pixel.x >= 640.0 || pixel.y >= 480.0 {
                continue;
            }
            let grey = image.at(pixel.x as u32, pixel.y as u32);
            let expected = if cells.is_white(column, row) { 205 } else { 30 };
            assert_eq!(grey, expected, "column {column}, row {row} at {pixel}");
            seen += 1;
        }
    }
    assert!(seen > 80, "only {seen} cells are in the image");
}

#[test]
fn renders_edges_accurate_to_a_thirtieth_of_a_pixel() {
    let k = Intrinsics::from_horizontal_fov(320, 240, 1.2);
    let renderer = Renderer::new(k);
    let mat = one_tag(0.4);
    for i in 0..7 {
        let shift_m = f64::from(i) * 0.0007;
        let pose = Pose::new(DVec3::new(shift_m, 0.0, 1.0), above(1.0).rotation);
        let image = renderer.render(&SyntheticExposure::still(&[Placed::fixed(&mat)], pose));
        // Left edge of the black square, along a row through its black border.
        let y = k.project(pose.inverse().transform_point(DVec3::new(0.0, 0.175, 0.0))).unwrap().y;
        let edge = k.project(pose.inverse().transform_point(DVec3::new(-0.2, 0.0, 0.0))).unwrap().x;
        let white_px: f64 = (edge as u32 - 5..edge as u32 + 5)
            .map(|x| (f64::from(image.at(x, y as u32)) - 30.0) / 175.0)
            .sum();
        let found = f64::from(edge as u32 - 5) + white_px;
        assert!((found - edge).abs() < 1.0 / 30.0, "{found} instead of {edge}");
    }
}

#[test]
fn optical_and_motion_blur_do_not_shift_an_edge() {
    let k = Intrinsics::from_horizontal_fov(320, 240, 1.2);
    let renderer = Renderer::new(k);
    let mat = one_tag(0.4);
    let placed = [Placed::fixed(&mat)];
    let still = SyntheticExposure::still(&placed, above(1.0));
    // Motion of 6 px during the exposure, symmetric about the same middle.
    let shift = DVec3::X * 3.0 / k.fx_px;
    let moving = [-shift, shift].map(|s| Pose::new(DVec3::Z + s, above(1.0).rotation));
    let row = |shot: &SyntheticExposure<'_>| -> (f64, usize) {
        let image = renderer.render(shot);
        let y = (120.0 - 0.175 * k.fx_px) as u32;
        let greys: Vec<f64> =
            (100..120).map(|x| (f64::from(image.at(x, y)) - 30.0) / 175.0).collect();
        let between = greys.iter().filter(|g| (0.02..0.98).contains(*g)).count();
        (greys.iter().sum(), between)
    };
    let (sharp_at, sharp) = row(&still);
    let (blurred_at, blurred) = row(&SyntheticExposure { blur_px: 1.2, ..still });
    let (moved_at, moved) = row(&SyntheticExposure { world_from_cam: moving, ..still });
    assert!(sharp <= 2 && blurred >= 4 && moved >= 5, "{sharp}, {blurred}, {moved}");
    // Each edge is accurate to 1/30 px.
    assert!((blurred_at - sharp_at).abs() < 0.07, "{blurred_at} instead of {sharp_at}");
    assert!((moved_at - sharp_at).abs() < 0.07, "{moved_at} instead of {sharp_at}");
}

#[test]
fn light_and_noise_match_their_settings_and_repeat_by_seed() {
    let k = Intrinsics::from_horizontal_fov(320, 240, 1.2);
    let renderer = Renderer::new(k);
    let paper = Gray::plain(320, 240, 120);
    let light = Light { gradient: DVec2::new(0.5, 0.0), ..Light::default() };
    let shot = SyntheticExposure {
        background: Some(&paper),
        noise: 5.0,
        seed: 7,
        light,
        ..SyntheticExposure::still(&[], above(1.0))
    };
    let image = renderer.render(&shot);
    assert_eq!(image, renderer.render(&shot));
    assert_ne!(image, renderer.render(&SyntheticExposure { seed: 8, ..shot }));
    let column = |x: u32| (0..240).map(move |y| (x, y));
    let mean = |x: u32| column(x).map(|(x, y)| f64::from(image.at(x, y))).sum::<f64>() / 240.0;
    assert!((mean(2) - 120.0 * 0.754).abs() < 2.0 && (mean(317) - 120.0 * 1.246).abs() < 2.0);
    let middle = mean(160);
    let variance =
        column(160).map(|(x, y)| (f64::from(image.at(x, y)) - middle).powi(2)).sum::<f64>() / 239.0;
    assert!((variance.sqrt() - 5.0).abs() < 1.0, "{}", variance.sqrt());
}

#[test]
fn faces_are_visible_from_the_front_and_occlude_others() {
    let k = Intrinsics::from_horizontal_fov(320, 240, 1.2);
    let renderer = Renderer::new(k);
    let wall = Gray::plain(320, 240, 200);
    let mat = one_tag(0.3);
    let floor = Placed::fixed(&mat);
    let placed = [floor];
    let back = |height_m: f64| {
        let shot = SyntheticExposure {
            background: Some(&wall),
            ..SyntheticExposure::still(&placed, Pose::new(DVec3::Z * height_m, DQuat::IDENTITY))
        };
        renderer.render(&shot)
    };
    // From below, looking up: the paper's back is not drawn.
    assert!(back(-1.0).pixels().iter().all(|&p| p == 200));
    // A white cube face 0.5 m above the mat occludes its middle, in any order of layouts.
    let world_from_body: Pose<World, Body> = Pose::new(DVec3::Z * 0.5, DQuat::IDENTITY);
    let body_from_tag: Pose<Body, Square> = Pose::IDENTITY;
    let lid = TagLayout {
        frame: LayoutFrame::Body,
        tags: vec![Tag::new(TagFamily::Tag36h11, 9, 0.08, body_from_tag)],
    };
    let lid = Placed::on_vehicle(&lid, [world_from_body; 2]);
    let one = renderer.render(&SyntheticExposure::still(&[lid, floor], above(1.0)));
    assert_eq!(one, renderer.render(&SyntheticExposure::still(&[floor, lid], above(1.0))));
    assert_ne!(one, renderer.render(&SyntheticExposure::still(&[floor], above(1.0))));
}
