//! Compares images with a slow reference, which renders each row at several times of its exposure, and the sensor with
//! its noise model.

use glam::{DQuat, DVec3};
use vizflyt_splat::{CpuRenderer, Rasterizer};

use super::*;
use crate::{SceneKind, film_set};

const STILL: Exposure = Exposure { gain: 1.0, shutter_s: 0.01, iso: 0.0 };

fn phone(width: u32, height: u32) -> Phone {
    Phone { vignette: 0.0, ..Phone::draw(SceneKind::Room, 3, width, height) }
}

fn shoot(
    film: &Film,
    renderer: &mut CpuRenderer,
    track: &Track<'_>,
    middle_s: f64,
) -> Vec<BandImage> {
    let mut images = [RgbdImage::default()];
    let bands = film.bands().iter().map(|band| {
        let camera = film.camera(band, track, middle_s);
        renderer.render(&[], &[camera], &mut images).unwrap();
        let mut taken = BandImage::default();
        film.take(&camera, &images[0], &mut taken);
        taken
    });
    bands.collect()
}

/// Returns the peak signal-to-noise ratio of bytes. [dB]
fn alike_db(a: &[u8], b: &[u8]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    10.0 * libm::log10(255.0 * 255.0 * a.len() as f64 / sum.max(1e-9))
}

#[test]
fn a_static_phone_records_the_rendered_image() {
    let set = film_set(SceneKind::Room, 3, 20.0, false).unwrap();
    let mut renderer = CpuRenderer::new(&set.scene.splats);
    let film = Film::new(phone(160, 120));
    let pose = set.walk.world_from_cam(4.0);
    let bands = shoot(&film, &mut renderer, &|_| pose, 4.0);
    let filmed = film.develop(&bands, &|_| pose, 4.0, &STILL, 1);
    let camera = Camera::new(film.phone().intrinsics, pose, NEAR_M);
    let mut images = [RgbdImage::default()];
    renderer.render(&[], &[camera], &mut images).unwrap();
    let mut plain = Vec::new();
    images[0].write_rgb8(&mut plain);
    // They differ by rounding, and by splats at the border of a band's larger image.
    let db = alike_db(&filmed, &plain);
    assert!(db > 48.0, "{db} dB");
}

/// Reference image: each row is the mean of renderings at eight times of its exposure.
fn brute_force(
    film: &Film,
    renderer: &mut CpuRenderer,
    track: &Track<'_>,
    middle_s: f64,
    shutter_s: f64,
) -> Vec<u8> {
    let k = film.phone().intrinsics;
    let mut bytes = Vec::new();
    let mut images = [RgbdImage::default()];
    for row in 0..k.height_px {
        let mut sum = vec![0f32; 3 * k.width_px as usize];
        for n in 0..8 {
            let row_s = film.phone().row_instant_s(f64::from(row) + 0.5, middle_s);
            let at_s = row_s + shutter_s * ((f64::from(n) + 0.5) / 8.0 - 0.5);
            // Render only this row, with a camera of one row.
            let one = Intrinsics { height_px: 1, cy_px: k.cy_px - f64::from(row), ..k };
            let camera = Camera::new(one, track(at_s), NEAR_M);
            renderer.render(&[], &[camera], &mut images).unwrap();
            for (sum, &shown) in sum.iter_mut().zip(&images[0].rgb) {
                *sum += film.tone.linear(shown) / 8.0;
            }
        }
        bytes.extend(sum.iter().map(|&light| film.tone.shown(light)));
    }
    bytes
}

#[test]
fn rolling_shutter_and_blur_match_the_reference() {
    for kind in [SceneKind::Room, SceneKind::Forest] {
        let set = film_set(kind, 3, 20.0, false).unwrap();
        let mut renderer = CpuRenderer::new(&set.scene.splats);
        let film = Film::new(phone(160, 120));
        let track = |at_s: f64| {
            // A rotation of 50 degrees per second in addition to the walk: 9 px of shear, 4 px of blur at a width of
            // 160.
            let pose = set.walk.world_from_cam(at_s);
            let turn = DQuat::from_rotation_z(0.87 * (at_s - 6.0));
            Pose::new(pose.translation_m, turn * pose.rotation)
        };
        let bands = shoot(&film, &mut renderer, &track, 6.0);
        let filmed = film.develop(&bands, &track, 6.0, &STILL, 1);
        let plain = brute_force(&film, &mut renderer, &track, 6.0, STILL.shutter_s);
        let db = alike_db(&filmed, &plain);
        // For comparison: an image without motion.
        let still = |_| track(6.0);
        let bands = shoot(&film, &mut renderer, &still, 6.0);
        let unmoved_db = alike_db(&film.develop(&bands, &still, 6.0, &STILL, 1), &plain);
        assert!(db > 36.0 && db > unmoved_db + 8.0, "{kind}: {db} dB, unmoved {unmoved_db} dB");
    }
}

/// The edge of a known surface must be at the position that each row's pose predicts, with lens and shutter.
#[test]
fn edges_match_the_pose_of_their_row() {
    // A wall 2 m ahead, white for x > 0.1 m and black otherwise.
    let film = Film::new(phone(640, 480));
    let track = |at_s: f64| {
        let turn = DQuat::from_rotation_y(0.9 * at_s) * DQuat::from_rotation_x(-0.3 * at_s);
        Pose::new(DVec3::new(0.4 * at_s, 0.1 * at_s, 0.0), turn)
    };
    // Here, the world's z axis points forward: a wall at z = 2, bright beyond x = 0.1.
    let bands: Vec<BandImage> = film
        .bands()
        .iter()
        .map(|band| {
            let world_from_cam: Pose<World, Cam> = track(film.instant_s(band, 0.0));
            let k = &band.intrinsics;
            let mut image = BandImage { world_from_cam, ..BandImage::default() };
            for y in 0..k.height_px {
                for x in 0..k.width_px {
                    let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                    let ray = world_from_cam.rotate(k.slope(pixel).unwrap().extend(1.0));
                    let eye = world_from_cam.translation_m;
                    let depth_m = (2.0 - eye.z) / ray.z;
                    // The edge is a ramp over the width of a pixel.
                    let width_m = depth_m / k.fx_px;
                    let beyond = ((eye + ray * depth_m).x - 0.1) / width_m + 0.5;
                    image.light.extend([beyond.clamp(0.0, 1.0) as f32; 3]);
                    image.depth_m.push(depth_m as f32);
                }
            }
            image
        })
        .collect();
    let filmed = film.develop(&bands, &track, 0.0, &STILL, 1);
    let k = film.phone().intrinsics;
    let mut worst_px = 0f64;
    for y in (4..476).step_by(9) {
        // Position of the edge from the sum of dark pixels in the row.
        let row = &filmed[3 * 640 * y..][..3 * 640];
        let dark: f64 = row
            .chunks_exact(3)
            .map(|p| 1.0 - f64::from(film.tone.linear(f32::from(p[0]) / 255.0)))
            .sum();
        let row_s = film.phone().row_instant_s(y as f64 + 0.5, 0.0);
        let cam_from_world = track(row_s).inverse();
        // Find the point of the edge in this row by bisection over its height.
        let (mut low, mut high) = (-2.0, 2.0);
        for _ in 0..60 {
            let middle = f64::midpoint(low, high);
            let p_cam = cam_from_world.transform_point(DVec3::new(0.1, middle, 2.0));
            if k.project(p_cam).unwrap().y < y as f64 + 0.5 { low = middle } else { high = middle }
        }
        let p_cam = cam_from_world.transform_point(DVec3::new(0.1, low, 2.0));
        worst_px = worst_px.max((k.project(p_cam).unwrap().x - dark).abs());
    }
    assert!(worst_px < 0.08, "{worst_px} px");
}

#[test]
fn noise_matches_its_model_and_differs_between_images() {
    let film = Film::new(phone(320, 240));
    let pose = |_| Pose::IDENTITY;
    for (iso, light) in [(100.0, 0.2), (400.0, 0.2), (400.0, 0.02), (1600.0, 0.5)] {
        let exposure = Exposure { gain: 1.0, shutter_s: 0.01, iso };
        let bands: Vec<BandImage> = film
            .bands()
            .iter()
            .map(|band| BandImage {
                world_from_cam: Pose::IDENTITY,
                light: vec![light; 3 * band.intrinsics.pixels()],
                depth_m: vec![2.0; band.intrinsics.pixels()],
            })
            .collect();
        let bytes = film.develop(&bands, &pose, 0.0, &exposure, 5);
        assert_ne!(bytes, film.develop(&bands, &pose, 0.0, &exposure, 6));
        assert_eq!(bytes, film.develop(&bands, &pose, 0.0, &exposure, 5));
        let linear: Vec<f64> =
            bytes.iter().map(|&b| f64::from(film.tone.linear(f32::from(b) / 255.0))).collect();
        let mean = linear.iter().sum::<f64>() / linear.len() as f64;
        let variance = linear.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / linear.len() as f64;
        let (shot, read) = film.phone().noise(iso);
        let expected = (shot * f64::from(light) + read).sqrt();
        // One step of eight bits is up to 0.004 of linear light in this range.
        assert!((mean - f64::from(light)).abs() < 0.002, "ISO {iso}: mean {mean}");
        let found = variance.sqrt();
        assert!(
            (found / expected - 1.0).abs() < 0.2,
            "ISO {iso}, {light}: {found}, not {expected}"
        );
    }
}

#[test]
fn exposure_follows_the_light_with_a_lag() {
    let phone = phone(160, 120);
    let film = Film::new(phone);
    let lit = |light: f32| -> Vec<BandImage> {
        let of = |band: &Band| BandImage {
            world_from_cam: Pose::IDENTITY,
            light: vec![light; 3 * band.intrinsics.pixels()],
            depth_m: vec![2.0; band.intrinsics.pixels()],
        };
        film.bands().iter().map(of).collect()
    };
    let mut meter = Meter::default();
    let first = meter.next(&phone, film.bands(), &lit(0.2), 0.0);
    let next = meter.next(&phone, film.bands(), &lit(0.4), 1.0 / 30.0);
    assert!(next.gain < first.gain && next.gain > 0.8 * first.gain, "{first:?} {next:?}");
    let settled =
        (0..60).fold(next, |_, _| meter.next(&phone, film.bands(), &lit(0.4), 1.0 / 30.0));
    assert!((settled.gain - first.gain / 2.0).abs() < 0.02, "{settled:?}");
    // In a lit room: 1/100 s and some hundred ISO. In the sun: a short shutter.
    assert!(first.shutter_s == 0.01 && (100.0..800.0).contains(&first.iso), "{first:?}");
    let outside = Phone { illuminance_lx: 50_000.0, ..phone };
    let sun = Exposure::of(&outside, 1.0);
    assert!(sun.iso == 50.0 && sun.shutter_s < 0.001, "{sun:?}");
}
