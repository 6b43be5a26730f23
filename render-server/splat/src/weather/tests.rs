use glam::{DQuat, DVec2, DVec3, Vec2};
use proptest::prelude::*;
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};

use super::particles::{ParticleKind, Streak};
use super::*;

const WIDTH: u32 = 96;
const HEIGHT: u32 = 64;
const MOMENT: Moment = Moment { at_ns: 12_345_678_901, v_world_mps: DVec3::ZERO, seed: 7 };
const MIST: Cloud = Cloud {
    per_m: 0.3,
    color: [0.6, 0.7, 0.8],
    patchiness: 0.0,
    patch_m: 1.5,
    drift_mps: Vec3::ZERO,
    layer_m: None,
    ball: None,
};
const SHOWER: Rain = Rain { rate_mmph: 40.0, wind_mps: Vec2::new(1.0, 0.5), lens_drops: 12 };
const FLURRY: Snow = Snow { rate_mmph: 3.0, wind_mps: Vec2::new(0.4, -0.2) };
const EVENING: Sun =
    Sun { direction: DVec3::X, glare: 1.0, color: [1.0, 0.9, 0.7], behind_m: 50.0 };
const TORCH: OwnLight = OwnLight { reach_m: 2.0, color: [1.0; 3], cos_cone: 0.5 };

/// Returns a camera that looks along the world's x from 1.5 m above its origin.
fn camera() -> Camera {
    let k = Intrinsics::from_horizontal_fov(WIDTH, HEIGHT, 1.57);
    // Columns: the x, y and z axes of the camera in the world.
    let turn = glam::DMat3::from_cols(-DVec3::Y, -DVec3::Z, DVec3::X);
    Camera::new(k, Pose::new(DVec3::new(0.0, 0.0, 1.5), DQuat::from_mat3(&turn)), 0.05)
}

fn wall(rgb: f32, depth_m: f32) -> RgbdImage {
    let mut image = RgbdImage::default();
    image.resize(WIDTH, HEIGHT);
    image.rgb.fill(rgb);
    image.alpha.fill(1.0);
    image.depth_expected_m.fill(depth_m);
    image.depth_median_m.fill(depth_m);
    image.ids.fill(3);
    image
}

fn seen(weather: &Weather, moment: &Moment, image: &RgbdImage) -> RgbdImage {
    let mut image = image.clone();
    WeatherPass::default().apply(weather, &camera(), moment, &mut image);
    image
}

/// Returns the length of a pixel's ray per metre of depth.
fn norm_at(pixel: usize) -> f64 {
    let (x, y) = (pixel as u32 % WIDTH, pixel as u32 / WIDTH);
    let at = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
    camera().intrinsics.slope(at).unwrap().extend(1.0).length()
}

fn everything() -> Weather {
    Weather {
        cloud: Some(Cloud { patchiness: 1.0, drift_mps: Vec3::new(0.4, 0.1, 0.0), ..MIST }),
        rain: Some(SHOWER),
        snow: Some(FLURRY),
        sun: Some(EVENING),
        lamps: Some(Lamps {
            reach_m: 1.0,
            color: [1.0, 0.8, 0.6],
            places: LampPlaces::Grid { height_m: 3.0, spacing_m: 4.0 },
        }),
        own_light: Some(TORCH),
        flicker: Some(Flicker { mains_hz: 50.0, depth: 0.3, readout_s: 0.01 }),
        depth_loss: true,
        ..Weather::CLEAR
    }
}

/// Returns an image with an edge, a gap without surface, and a near object.
fn room() -> RgbdImage {
    let mut image = wall(0.4, 6.0);
    for pixel in 0..image.alpha.len() {
        let (x, y) = (pixel as u32 % WIDTH, pixel as u32 / WIDTH);
        if x < 30 {
            (image.depth_expected_m[pixel], image.depth_median_m[pixel]) = (1.2, 1.2);
        }
        if (40..60).contains(&x) && (20..44).contains(&y) {
            (image.alpha[pixel], image.ids[pixel]) = (0.0, 0);
            (image.depth_expected_m[pixel], image.depth_median_m[pixel]) = (0.0, 0.0);
            image.rgb[3 * pixel..3 * pixel + 3].fill(0.0);
        }
    }
    image
}

#[test]
fn clear_weather_changes_nothing() {
    assert!(Weather::CLEAR.is_clear() && !everything().is_clear());
    assert!(Weather { exposure_s: 0.02, ..Weather::CLEAR }.is_clear());
    assert_eq!(seen(&Weather::CLEAR, &MOMENT, &room()), room());
}

#[test]
fn uniform_air_follows_the_beer_lambert_law() {
    for depth_m in [0.1, 1.0, 3.7, 12.0, 29.0] {
        let image =
            seen(&Weather { cloud: Some(MIST), ..Weather::CLEAR }, &MOMENT, &wall(0.5, depth_m));
        for (pixel, rgb) in image.rgb.chunks_exact(3).enumerate() {
            let left = (-0.3 * f64::from(depth_m) * norm_at(pixel)).exp();
            for (value, color) in rgb.iter().zip(MIST.color) {
                let truth = 0.5 * left + f64::from(color) * (1.0 - left);
                assert!((f64::from(*value) - truth).abs() < 2e-5, "{depth_m} m: {value} {truth}");
            }
        }
    }
}

#[test]
fn rain_attenuates_light_with_distance() {
    let weather = Weather { rain: Some(Rain { lens_drops: 0, ..SHOWER }), ..Weather::CLEAR };
    let per_m = SHOWER.extinction_per_m();
    // There are no drops in front of a wall that is nearer than any drop.
    let image = seen(&weather, &MOMENT, &wall(0.5, 0.1));
    let left = (-per_m * 0.1 * norm_at(0)).exp();
    assert!((f64::from(image.rgb[0]) - 0.5 * left).abs() < 1e-5, "black is the fog of no fog");
}

#[test]
fn patches_have_the_mean_density_and_drift() {
    let mist = Cloud { patchiness: 1.0, patch_m: 0.8, ..MIST };
    let weather = Weather { cloud: Some(mist), ..Weather::CLEAR };
    let (mut sum, mut squares, mut count) = (0.0, 0.0, 0.0);
    for k in 0..40 {
        let moment = Moment { at_ns: k * 31_000_000_000, seed: k as u64, ..MOMENT };
        let image = seen(&weather, &moment, &wall(0.0, 4.0));
        for (pixel, rgb) in image.rgb.chunks_exact(3).enumerate().step_by(61) {
            let taken = -(1.0 - f64::from(rgb[0] / mist.color[0])).ln();
            let density = taken / (0.3 * 4.0 * norm_at(pixel));
            (sum, squares, count) = (sum + density, squares + density * density, count + 1.0);
        }
    }
    let mean: f64 = sum / count;
    assert!((mean - 1.0).abs() < 0.1, "mean density {mean}");
    assert!((squares / count - mean * mean).sqrt() > 0.2, "there are gaps");

    // A cloud that drifted by 0.4 m looks similar to a camera that moved along. It is not
    // identical, because octaves drift apart.
    let drifting = Cloud { drift_mps: Vec3::new(0.0, 1.0, 0.0), ..mist };
    let at = |at_ns: i64, y_m: f64| {
        let mut image = wall(0.0, 4.0);
        let mut camera = camera();
        camera.world_from_cam.translation_m.y = y_m;
        let weather = Weather { cloud: Some(drifting), ..Weather::CLEAR };
        WeatherPass::default().apply(&weather, &camera, &Moment { at_ns, ..MOMENT }, &mut image);
        image.rgb
    };
    let off = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f32>();
    let (first, along, stayed) = (at(0, 0.0), at(400_000_000, 0.4), at(400_000_000, 0.0));
    assert!(off(&first, &along) < 0.25 * off(&first, &stayed));
}

#[test]
fn a_cloud_is_limited_to_its_layer_and_ball() {
    let ball = Ball { center_m: DVec3::new(3.0, 0.0, 1.5), radius_m: 0.8 };
    let cloud = Cloud { per_m: 4.0, ball: Some(ball), ..MIST };
    let image = seen(&Weather { cloud: Some(cloud), ..Weather::CLEAR }, &MOMENT, &wall(0.5, 6.0));
    let at = |x: u32, y: u32| image.rgb[3 * (y * WIDTH + x) as usize];
    assert!(at(WIDTH / 2, HEIGHT / 2) > 0.59, "the ball hides what is behind it");
    assert!((at(2, 2) - 0.5).abs() < 1e-4, "but nothing next to it");
    // The cloud is behind surfaces that are nearer.
    let near = seen(&Weather { cloud: Some(cloud), ..Weather::CLEAR }, &MOMENT, &wall(0.5, 2.0));
    assert!((near.rgb[3 * (HEIGHT / 2 * WIDTH + WIDTH / 2) as usize] - 0.5).abs() < 1e-3);
    let layer = Cloud { per_m: 4.0, layer_m: Some([0.0, 0.5]), ..MIST };
    let image = seen(&Weather { cloud: Some(layer), ..Weather::CLEAR }, &MOMENT, &wall(0.5, 6.0));
    let at = |y: u32| image.rgb[3 * (y * WIDTH + WIDTH / 2) as usize];
    assert!((at(4) - 0.5).abs() < 1e-4 && at(HEIGHT - 1) > 0.55, "{} {}", at(4), at(HEIGHT - 1));
}

fn streaks(rain: Option<Rain>, snow: Option<Snow>, moment: &Moment, k: &Intrinsics) -> Vec<Streak> {
    let (mut rays, mut pass) = (Rays::default(), ParticlePass::default());
    rays.follow(k);
    let camera = Camera { intrinsics: *k, ..camera() };
    let (v_world_mps, at_s) = (moment.v_world_mps, moment.at_ns as f64 * 1e-9);
    let scene = Scene {
        camera: &camera,
        rays: &rays,
        v_world_mps,
        exposure_s: 0.005,
        at_s,
        seed: moment.seed,
    };
    pass.add(RAIN, rain.iter().flat_map(Rain::kinds));
    pass.add(SNOW, snow.iter().flat_map(Snow::kinds));
    pass.fall(&scene, |_, _| [1.0; 3]);
    pass.streaks().copied().collect()
}

#[test]
fn number_and_streak_length_of_drops_match_the_distribution() {
    let k = Intrinsics::from_horizontal_fov(320, 240, 1.57);
    let rain = Rain { wind_mps: Vec2::ZERO, ..SHOWER };
    // The width at a known depth identifies the size. Between 0.2 and 0.32 m, all drops are drawn,
    // even in the corners of the image.
    let (near_m, far_m) = (0.2, 0.32);
    let mut found = vec![0.0; rain.kinds().count()];
    let images = 150;
    for image in 0..images {
        let moment = Moment { seed: image, at_ns: image as i64 * 997_000_000, ..MOMENT };
        for streak in streaks(Some(rain), None, &moment, &k) {
            let diameter_m = f64::from(streak.width_px * streak.z_m) / k.fx_px;
            let same = |kind: &ParticleKind| (kind.diameter_m - diameter_m).abs() < 1e-5;
            let index = rain.kinds().position(|kind| same(&kind)).expect("a kind of this size");
            let middle = (streak.from_px + streak.to_px) * 0.5;
            let inside =
                middle.cmpge(Vec2::ZERO).all() && middle.cmple(Vec2::new(320.0, 240.0)).all();
            if inside && (near_m..far_m).contains(&f64::from(streak.z_m)) {
                found[index] += 1.0;
            }
            // Seen horizontally, a streak is as long as the drop falls during the exposure.
            let fall_mps = -rain.kinds().nth(index).unwrap().v_world_mps.z;
            let length_m =
                f64::from((streak.to_px - streak.from_px).length() * streak.z_m) / k.fx_px;
            assert!((length_m - fall_mps * 0.005).abs() < 1e-4, "{length_m} {fall_mps}");
        }
    }
    let slopes = DVec2::new(320.0 / k.fx_px, 240.0 / k.fy_px);
    let volume_m3 = slopes.x * slopes.y * (far_m.powi(3) - near_m.powi(3)) / 3.0;
    for (kind, found) in rain.kinds().zip(&found) {
        let expected = kind.per_m3 * volume_m3 * images as f64;
        // Five standard deviations of a count.
        let off = (found - expected).abs();
        assert!(
            off < 5.0 * expected.sqrt() + 1.0,
            "{:.1} mm: {found} {expected}",
            kind.diameter_m * 1e3
        );
    }
    assert!(found.iter().sum::<f64>() > 1000.0);
}

#[test]
fn streak_length_is_the_displacement_relative_to_the_camera() {
    let k = Intrinsics::from_horizontal_fov(320, 240, 1.57);
    let rain = Rain { wind_mps: Vec2::ZERO, ..SHOWER };
    // To a camera that falls with a drop, the drop is stationary. To a camera that flies forward,
    // drops approach.
    let mut kinds = rain.kinds();
    let falling = Moment { v_world_mps: kinds.nth(3).unwrap().v_world_mps, ..MOMENT };
    let shortest = streaks(Some(rain), None, &falling, &k)
        .iter()
        .map(|streak| (streak.to_px - streak.from_px).length())
        .fold(f32::INFINITY, f32::min);
    assert!(shortest < 1e-2, "{shortest}");
    let ahead = Moment { v_world_mps: DVec3::X * 20.0, ..MOMENT };
    let outward = streaks(Some(rain), None, &ahead, &k);
    // Streaks point away from the point of approach, which is above the centre because drops fall.
    let away = outward.iter().filter(|streak| {
        let from_center = streak.from_px - Vec2::new(160.0, 120.0);
        from_center.dot(streak.to_px - streak.from_px) > 0.0
    });
    assert!(away.count() * 10 > outward.len() * 7);
}

#[test]
fn a_flake_moves_by_its_velocity_times_the_time() {
    let k = Intrinsics::from_horizontal_fov(320, 240, 1.57);
    let dt_s = 0.04;
    let later = Moment { at_ns: MOMENT.at_ns + 40_000_000, ..MOMENT };
    let place = |streak: &Streak| {
        let middle = ((streak.from_px + streak.to_px) * 0.5).as_dvec2();
        camera().world_from_cam.transform_point(k.unproject(middle, f64::from(streak.z_m)).unwrap())
    };
    let (before, after) =
        (streaks(None, Some(FLURRY), &MOMENT, &k), streaks(None, Some(FLURRY), &later, &k));
    let after: Vec<DVec3> = after.iter().map(place).collect();
    let mut followed = 0;
    for streak in &before {
        // Only flakes well within the view and the reach.
        let middle = (streak.from_px + streak.to_px) * 0.5;
        let inside =
            middle.cmpge(Vec2::splat(60.0)).all() && middle.cmple(Vec2::new(260.0, 180.0)).all();
        if !inside || !(0.5..0.9).contains(&streak.z_m) {
            continue;
        }
        let diameter_m = f64::from(streak.width_px * streak.z_m) / k.fx_px;
        let found =
            FLURRY.kinds().filter(|kind| (kind.diameter_m - diameter_m).abs() < 1e-5).any(|kind| {
                let expected_m = place(streak) + kind.v_world_mps * dt_s;
                after.iter().any(|place_m| (*place_m - expected_m).length() < 2e-4)
            });
        assert!(found, "a flake at {} is gone", place(streak));
        followed += 1;
    }
    assert!(followed > 20, "{followed}");
}

#[test]
fn the_opacity_of_a_streak_does_not_depend_on_its_length() {
    for (width_px, length_px, angle) in
        [(0.3, 0.0, 0.0), (0.3, 17.0, 0.3), (0.8, 5.5, 1.2), (2.5, 30.0, 2.0), (6.0, 9.0, -1.57)]
    {
        let along = Vec2::from_angle(angle) * length_px * 0.5;
        let center = Vec2::new(40.3, 31.8);
        let streak = Streak {
            from_px: center - along,
            to_px: center + along,
            width_px,
            z_m: 1.0,
            color: [1.0; 3],
        };
        let mut sum = 0.0;
        // In bands, as in parallel processing.
        for first in (0..64).step_by(16) {
            streak.draw(96, [first, first + 16], |_, y, opacity| {
                assert!((first..first + 16).contains(&y));
                sum += opacity;
            });
        }
        let area = std::f32::consts::FRAC_PI_4 * width_px * width_px;
        assert!((sum / area - 1.0).abs() < 0.08, "{width_px} {length_px} {angle}: {sum} {area}");
    }
}

#[test]
fn draws_no_particles_behind_a_wall() {
    let weather = Weather { snow: Some(FLURRY), ..Weather::CLEAR };
    let changed = |depth_m: f32| {
        let image = seen(&weather, &MOMENT, &wall(0.0, depth_m));
        image.rgb.iter().filter(|value| **value > 0.02).count()
    };
    assert_eq!(changed(0.1), 0);
    assert!(changed(0.6) < changed(3.0) && changed(0.6) > 0);
}

#[test]
fn surfaces_hide_the_sun() {
    let weather = Weather { sun: Some(EVENING), ..Weather::CLEAR };
    let center = 3 * (HEIGHT / 2 * WIDTH + WIDTH / 2) as usize;
    assert_eq!(seen(&weather, &MOMENT, &wall(0.2, 5.0)).rgb, wall(0.2, 5.0).rgb, "a wall hides it");
    let sky = seen(&weather, &MOMENT, &wall(0.2, 60.0));
    assert!(sky.rgb[center] > 3.0 && sky.rgb[0] > 0.2, "a picture of a sky does not");
    let through = seen(&weather, &MOMENT, &room());
    assert!(through.rgb[center] > 3.0, "nor does a gap");
    // CIE 146 at 20 degrees: 10 / 8000 + 5 / 400.
    let k = camera().intrinsics;
    let x = (k.cx_px + k.fx_px * 20.0_f64.to_radians().tan()) as usize;
    let value = f64::from(sky.rgb[center - 3 * (WIDTH / 2) as usize + 3 * x]);
    let scattered = value * value - 0.04;
    assert!((scattered / 0.013_75 - 1.0).abs() < 0.15, "{scattered}");
    // If it is half hidden, it is half as bright.
    let mut half = wall(0.0, 5.0);
    for pixel in 0..half.alpha.len() {
        if pixel as u32 % WIDTH >= WIDTH / 2 {
            (half.alpha[pixel], half.depth_median_m[pixel]) = (0.0, 0.0);
        }
    }
    let ratio = seen(&weather, &MOMENT, &half).rgb[0].powi(2)
        / seen(&weather, &MOMENT, &wall(0.0, 60.0)).rgb[0].powi(2);
    assert!((0.3..0.7).contains(&ratio), "{ratio}");
    let behind = Sun { direction: -DVec3::X, ..EVENING };
    assert_eq!(
        seen(&Weather { sun: Some(behind), ..Weather::CLEAR }, &MOMENT, &room()).rgb,
        room().rgb
    );
}

#[test]
fn own_light_falls_with_the_square_of_the_distance() {
    let weather = Weather { own_light: Some(TORCH), ..Weather::CLEAR };
    let center = 3 * (HEIGHT / 2 * WIDTH + WIDTH / 2) as usize;
    for depth_m in [0.5, 1.0, 2.0, 8.0] {
        let value = seen(&weather, &MOMENT, &wall(0.1, depth_m)).rgb[center];
        // In addition to the scene's own light, which is 1.
        let added = (value / 0.1).powi(2) - 1.0;
        assert!((added / (2.0 / depth_m).powi(2) - 1.0).abs() < 2e-3, "{depth_m} m: {added}");
    }
    // The corners of a wide image are outside a narrow cone.
    let narrow = OwnLight { cos_cone: 0.95, ..TORCH };
    let image =
        seen(&Weather { own_light: Some(narrow), ..Weather::CLEAR }, &MOMENT, &wall(0.1, 1.0));
    assert_eq!(image.rgb[0], 0.1);
}

#[test]
fn lamps_light_surfaces_near_them_also_in_the_dark() {
    let mut places = [DVec3::NAN; MAX_LAMPS];
    places[2] = DVec3::new(4.0, 0.0, 3.0);
    let lamps = Lamps { reach_m: 1.5, color: [1.0, 0.5, 0.0], places: LampPlaces::At(places) };
    let mut dark = camera();
    dark.atmosphere.light = [0.2; 3];
    let mut image = wall(0.1, 4.0);
    let weather = Weather { lamps: Some(lamps), ..Weather::CLEAR };
    WeatherPass::default().apply(&weather, &dark, &MOMENT, &mut image);
    let pixel = (HEIGHT / 2 * WIDTH + WIDTH / 2) as usize;
    let at = camera().intrinsics.unproject(DVec2::new(48.5, 32.5), 4.0).unwrap();
    let distance_m = (camera().world_from_cam.transform_point(at) - places[2]).length();
    let added = (1.5 / distance_m).powi(2);
    for (channel, share) in [1.0, 0.5, 0.0].into_iter().enumerate() {
        // The capture has a value of 0.5 there, of which 0.1 is left in the dark.
        let truth = 0.5 * (0.2_f64.powi(2) + added * share).sqrt();
        let value = f64::from(image.rgb[3 * pixel + channel]);
        assert!((value - truth).abs() < 1e-4, "{value} {truth}");
    }
    // The same lamp as part of a grid, of which three more lamps are relevant here.
    let grid = LampPlaces::Grid { height_m: 3.0, spacing_m: 4.0 };
    let mut image = wall(0.1, 4.0);
    let weather = Weather { lamps: Some(Lamps { places: grid, ..lamps }), ..Weather::CLEAR };
    WeatherPass::default().apply(&weather, &dark, &MOMENT, &mut image);
    let value = f64::from(image.rgb[3 * pixel]);
    let truth = 0.5 * (0.04 + added + 3.0 * 2.25 / 18.0_f64).sqrt();
    assert!((value - truth).abs() < 0.1 && value > 0.5 * (0.04 + added).sqrt(), "{value} {truth}");
}

#[test]
fn depth_is_unchanged_without_depth_loss() {
    let perfect = seen(&Weather { depth_loss: false, ..everything() }, &MOMENT, &room());
    assert_eq!(perfect.depth_median_m, room().depth_median_m);
    assert_eq!(perfect.depth_expected_m, room().depth_expected_m);
    assert_eq!((perfect.ids, perfect.alpha), (room().ids, room().alpha));

    let cloud = Some(Cloud { per_m: 0.1, ..MIST });
    let weather = Weather { depth_loss: true, cloud, ..Weather::CLEAR };
    let (mut lost, mut expected) = (0.0, 0.0);
    for k in 0..20 {
        let image = seen(&weather, &Moment { at_ns: k * 1_000_000, ..MOMENT }, &wall(0.5, 4.0));
        for (pixel, &depth_m) in image.depth_median_m.iter().enumerate() {
            lost += f64::from(u8::from(depth_m == 0.0));
            expected += 1.0 - (-2.0 * 0.1 * 4.0 * norm_at(pixel)).exp();
            assert_eq!(depth_m == 0.0, image.ids[pixel] == 0);
            assert_eq!(depth_m, image.depth_expected_m[pixel]);
        }
    }
    let sigma = (expected * 0.25_f64).sqrt();
    assert!((lost - expected).abs() < 5.0 * sigma, "{lost} {expected}");
}

fn light_from_above(image: &mut RgbdImage) {
    let half = image.rgb.len() / 2;
    image.rgb[..half].fill(0.8);
}

#[test]
fn drops_on_the_lens_show_their_surroundings_upside_down() {
    let mut image = wall(0.0, 5.0);
    light_from_above(&mut image);
    let before = image.rgb.clone();
    let mut pass = LensPass::default();
    pass.draw(1, 3, 4.0, [WIDTH as usize, HEIGHT as usize], &mut image.rgb);
    let changed: Vec<usize> =
        (0..image.alpha.len()).filter(|&p| image.rgb[3 * p] != before[3 * p]).collect();
    assert!(changed.len() < image.alpha.len() / 50, "one drop is small");
    let rain = Rain { lens_drops: 60, ..SHOWER };
    let now = seen(&Weather { rain: Some(rain), ..Weather::CLEAR }, &MOMENT, &wall(0.3, 0.1));
    let later = Moment { at_ns: MOMENT.at_ns + 10_000_000, ..MOMENT };
    let soon = seen(&Weather { rain: Some(rain), ..Weather::CLEAR }, &later, &wall(0.3, 0.1));
    let moved = now.rgb.iter().zip(&soon.rgb).filter(|(a, b)| (**a - **b).abs() > 0.05).count();
    assert!(moved * 50 < now.rgb.len(), "drops stay from image to image: {moved}");
    // A drop in the dark half shows the bright half in its lower part.
    let (mut above, mut below) = (0.0, 0.0);
    for seed in 0..60 {
        let mut image = wall(0.0, 5.0);
        light_from_above(&mut image);
        let before = image.rgb.clone();
        pass.draw(1, seed, 4.0, [WIDTH as usize, HEIGHT as usize], &mut image.rgb);
        let lit: Vec<usize> =
            (0..image.alpha.len()).filter(|&p| image.rgb[3 * p] != before[3 * p]).collect();
        let (Some(first), Some(last)) = (lit.first(), lit.last()) else { continue };
        let middle = usize::midpoint(*first, *last) / WIDTH as usize;
        for pixel in lit.into_iter().filter(|pixel| pixel / WIDTH as usize > HEIGHT as usize / 2) {
            let row = pixel / WIDTH as usize;
            *(if row < middle { &mut above } else { &mut below }) += image.rgb[3 * pixel];
        }
    }
    assert!(below > 2.0 * above && below > 0.1, "{below} {above}");
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| seen(&everything(), &MOMENT, &room()))
    };
    let one = with(1);
    assert_eq!(one, with(2));
    assert_eq!(one, with(5));
    // The result also does not depend on previous use of the pass.
    let mut pass = WeatherPass::default();
    let mut other = room();
    pass.apply(&everything(), &camera(), &Moment { seed: 8, at_ns: 5, ..MOMENT }, &mut other);
    let mut again = room();
    pass.apply(&everything(), &camera(), &MOMENT, &mut again);
    assert_eq!(one, again);
    assert_ne!(one.rgb, other.rgb);
}

#[test]
fn non_finite_pixels_do_not_spread() {
    let mut image = room();
    let poison = [f32::NAN, f32::INFINITY, -f32::INFINITY, f32::MIN_POSITIVE / 2.0, -1.0];
    for (n, value) in poison.into_iter().enumerate() {
        let pixel = 20 * WIDTH as usize + 7 * n + 5;
        image.depth_expected_m[pixel] = value;
        image.depth_median_m[pixel] = value;
        image.rgb[3 * (pixel + WIDTH as usize)] = value;
    }
    let rain = everything().rain.map(|rain| Rain { lens_drops: 0, ..rain });
    let found = seen(&Weather { rain, ..everything() }, &MOMENT, &image);
    let is_poison = |value: &f32| !value.is_finite();
    assert!(found.rgb.iter().filter(|value| is_poison(value)).count() <= 3 * poison.len());
    // Also with drops on the lens, which average pixels.
    let found = seen(&everything(), &MOMENT, &image);
    assert!(found.rgb.iter().filter(|value| is_poison(value)).count() <= 3 * poison.len());
    assert_eq!(found.alpha, image.alpha);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    /// For any pose and lens, the pass does not panic, and returns colours that a sensor can have.
    #[test]
    fn applies_weather_to_any_camera(
        position in prop::array::uniform3(-1e4..1e4_f64),
        turn in prop::array::uniform4(-1.0..1.0_f64),
        fov in 0.2..2.8_f64,
        lens in 0..3,
        at_ns in any::<i64>(),
        speed in prop::array::uniform3(-20.0..20.0_f64),
        size in (1..50_u32, 1..40_u32),
    ) {
        let distortion = match lens {
            0 => Distortion::None,
            1 => Distortion::BrownConrady { k1: -0.2, k2: 0.04, p1: 0.001, p2: 0.0, k3: 0.0 },
            _ => Distortion::KannalaBrandt { k1: 0.01, k2: 0.0, k3: 0.0, k4: 0.0 },
        };
        let k = Intrinsics { distortion, ..Intrinsics::from_horizontal_fov(size.0, size.1, fov) };
        let turn = DQuat::from_array(turn);
        let turn = if turn.length() > 0.1 { turn.normalize() } else { DQuat::IDENTITY };
        let camera = Camera::new(k, Pose::new(DVec3::from(position), turn), 0.05);
        let mut image = RgbdImage::default();
        image.resize(size.0, size.1);
        image.rgb.fill(0.4);
        image.alpha.fill(0.7);
        image.depth_expected_m.fill(3.0);
        image.depth_median_m.fill(3.0);
        let moment = Moment { at_ns, v_world_mps: DVec3::from(speed), seed: 1 };
        WeatherPass::default().apply(&everything(), &camera, &moment, &mut image);
        prop_assert!(image.rgb.iter().all(|value| value.is_finite() && *value >= 0.0));
    }
}

#[test]
fn the_test_camera_looks_ahead() {
    let ahead = camera().world_from_cam.rotation * DVec3::Z;
    assert!((ahead - DVec3::X).length() < 1e-12);
}
