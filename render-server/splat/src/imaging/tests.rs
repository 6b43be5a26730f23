//! Tests of the complete imager, against formulas and against images that are rendered at every instant of every row.

use glam::{DQuat, DVec3, Quat, Vec3};

use super::*;
use crate::{CpuRenderer, Rasterizer, Splats};

/// Sensor without noise and filters, 1000 e at full scale.
const IDEAL: Sensor = Sensor {
    full_well_e: 1000.0,
    read_noise_e: 0.0,
    electrons_per_s: 100_000.0,
    bits: 14,
    filter: ColorFilter::Rgb,
    denoise: false,
    noise: false,
    vignette: 0.0,
    readout_s: 0.0,
    exposure: ExposureControl::Fixed(Exposure { shutter_s: 0.01, gain: 1.0 }),
};

fn model(sensor: Sensor) -> CameraModel {
    CameraModel { sensor: Some(sensor), depth: DepthModel::Perfect }
}

fn lens(width: u32, height: u32) -> Intrinsics {
    Intrinsics::from_horizontal_fov(width, height, 1.2)
}

fn still(camera: &Camera) -> impl Fn(f64) -> Pose<World, Cam> + Sync + use<> {
    let pose = camera.world_from_cam;
    move |_| pose
}

fn flat(k: &Intrinsics, shown: f32, depth_m: f32) -> RgbdImage {
    let mut image = RgbdImage::default();
    image.resize(k.width_px, k.height_px);
    image.rgb.fill(shown);
    image.alpha.fill(1.0);
    image.depth_median_m.fill(depth_m);
    image.depth_expected_m.fill(depth_m);
    image
}

fn take(model: &CameraModel, camera: &Camera, path: &Path<'_>, mut image: RgbdImage) -> RgbdImage {
    let shot = Shot { camera, path, at_s: 0.0, key: NoiseKey::new(1, 2, 3) };
    Imager::default().apply(model, &shot, &mut image);
    image
}

#[test]
fn perfect_camera_changes_nothing_and_ideal_sensor_only_rounds() {
    let k = lens(32, 24);
    let camera = Camera::new(k, Pose::IDENTITY, 0.01);
    let mut image = flat(&k, 0.3, 2.0);
    for (n, value) in image.rgb.iter_mut().enumerate() {
        *value = (n % 256) as f32 / 255.0;
    }
    assert_eq!(take(&CameraModel::default(), &camera, &still(&camera), image.clone()), image);
    let taken = take(&model(IDEAL), &camera, &still(&camera), image.clone());
    let (mut before, mut after) = (Vec::new(), Vec::new());
    image.write_rgb8(&mut before);
    taken.write_rgb8(&mut after);
    let worst = before.iter().zip(&after).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(worst <= Some(1), "{worst:?}");
    assert_eq!((taken.depth_median_m, taken.ids), (image.depth_median_m, image.ids));
}

/// Returns the linear light of the first channel.
fn linear(image: &RgbdImage, n: usize) -> f64 {
    f64::from(tone().linear(image.rgb[3 * n]))
}

#[test]
fn exposure_gain_and_vignette_multiply() {
    let k = lens(64, 48);
    let camera = Camera::new(k, Pose::IDENTITY, 0.01);
    let image = flat(&k, 0.5, 2.0);
    let light = linear(&image, 0);
    let middle = 24 * 64 + 32;
    let at = |shutter_s: f64, gain: f64, vignette: f64| {
        let exposure = ExposureControl::Fixed(Exposure { shutter_s, gain });
        let sensor = Sensor { vignette, exposure, ..IDEAL };
        take(&model(sensor), &camera, &still(&camera), image.clone())
    };
    for (shutter_s, gain) in [(0.01, 1.0), (0.005, 1.0), (0.005, 3.0), (0.02, 2.0)] {
        let found = linear(&at(shutter_s, gain, 0.0), middle);
        let expected = shutter_s * 100.0 * gain * light;
        assert!((found - expected).abs() < 0.004, "{shutter_s} s x {gain}: {found}");
    }
    let dark = at(0.01, 1.0, 0.4);
    let corner = (0.5 / 64.0 - 0.5f64).powi(2) + (0.5 / 48.0 - 0.5f64).powi(2);
    let expected = light * (1.0 - 0.4 * corner / 0.5);
    assert!((linear(&dark, 0) - expected).abs() < 0.004, "{}", linear(&dark, 0));
}

/// Renders a wall 2 m ahead, black on the left of x = 0 and white on the right.
fn stripe_edge(k: &Intrinsics, world_from_cam: &Pose<World, Cam>) -> RgbdImage {
    let mut image = flat(k, 0.0, 2.0);
    for y in 0..k.height_px {
        for x in 0..k.width_px {
            let pixel = glam::DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let ray = world_from_cam.rotate(k.slope(pixel).unwrap().extend(1.0));
            let eye = world_from_cam.translation_m;
            let depth_m = (2.0 - eye.z) / ray.z;
            let n = (y * k.width_px + x) as usize;
            let is_white = (eye + ray * depth_m).x > 0.0;
            image.rgb[3 * n..3 * n + 3].fill(f32::from(u8::from(is_white)));
            image.depth_median_m[n] = depth_m as f32;
        }
    }
    image
}

/// Length of the blur: movement of the image during the exposure of a row, `omega f t`.
#[test]
fn blur_length_equals_the_rotation_during_the_exposure() {
    let k = lens(320, 240);
    for (omega_radps, shutter_s) in [(2.0f64, 0.01), (1.0, 0.02), (-2.0, 0.03)] {
        let path = move |at_s: f64| -> Pose<World, Cam> {
            Pose::new(DVec3::ZERO, DQuat::from_rotation_y(omega_radps * at_s))
        };
        let camera = Camera::new(k, path(0.0), 0.01);
        let exposure = ExposureControl::Fixed(Exposure { shutter_s, gain: 1.0 });
        let electrons_per_s = IDEAL.full_well_e / shutter_s;
        let taken = take(
            &model(Sensor { electrons_per_s, exposure, ..IDEAL }),
            &camera,
            &path,
            stripe_edge(&k, &camera.world_from_cam),
        );
        // An edge that moves evenly over L pixels becomes a ramp of L: the second moment of its slope is L^2 / 12.
        let row: Vec<f64> = (0..320).map(|x| linear(&taken, 120 * 320 + x)).collect();
        let steps: Vec<f64> = row.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let total: f64 = steps.iter().sum();
        let at = |power: i32, middle: f64| {
            let terms = steps.iter().enumerate().map(|(x, d)| d * (x as f64 - middle).powi(power));
            terms.sum::<f64>() / total
        };
        // Interpolation between pixels, and the differences, add a pixel each.
        let found_px = (12.0 * at(2, at(1, 0.0)) - 2.0).sqrt();
        let expected_px = (omega_radps * k.fx_px * shutter_s).abs();
        assert!((total - 1.0).abs() < 0.02, "the ramp is whole: {total}");
        assert!((found_px - expected_px).abs() < 0.4, "{found_px} px, not {expected_px} px");
    }
}

/// Rows are exposed one after the other: a vertical edge is sheared by `omega f` times each row's instant.
#[test]
fn rolling_shutter_shears_by_the_instant_of_each_row() {
    let k = lens(320, 240);
    let (omega_radps, readout_s) = (0.8, 0.03);
    let path = |at_s: f64| -> Pose<World, Cam> {
        Pose::new(DVec3::ZERO, DQuat::from_rotation_y(omega_radps * at_s))
    };
    let camera = Camera::new(k, path(0.0), 0.01);
    let exposure = ExposureControl::Fixed(Exposure { shutter_s: 1e-5, gain: 1000.0 });
    let rolling = Sensor { readout_s, exposure, ..IDEAL };
    let edge_px = |image: &RgbdImage, y: usize| {
        320.0 - (0..320).map(|x| linear(image, y * 320 + x)).sum::<f64>()
    };
    let image = stripe_edge(&k, &camera.world_from_cam);
    let taken = take(&model(rolling), &camera, &path, image.clone());
    let global = take(&model(Sensor { readout_s: 0.0, ..rolling }), &camera, &path, image);
    for y in [5usize, 60, 120, 180, 235] {
        let row_s = ((y as f64 + 0.5) / 240.0 - 0.5) * readout_s;
        // Rotation to the right moves the edge to the left.
        let moved_px = -k.fx_px * libm::tan(omega_radps * row_s);
        let found_px = edge_px(&taken, y) - edge_px(&global, 120);
        assert!((found_px - moved_px).abs() < 0.6, "row {y}: {found_px} px, not {moved_px} px");
        assert!((edge_px(&global, y) - 160.0).abs() < 0.6, "a global shutter shears nothing");
    }
}

/// Returns balls at several depths in front of a wall of splats. Those of the wall are at different depths, and have
/// similar colours, because rotation of the camera must not change which of two overlapping splats is visible.
fn balls() -> Splats {
    let mut splats = Splats::default();
    for i in 0..8000u32 {
        let spread = |k: f64| (f64::from(i) * k).fract() as f32 * 2.0 - 1.0;
        let is_ball = i % 100 == 0;
        let z = if is_ball { 1.5 } else { 4.0 } + 0.4 * spread(0.302_776);
        let at = Vec3::new(spread(0.618_034) * z, spread(0.414_214) * z, z);
        splats.means_m.push(at);
        splats.scales_m.push(Vec3::splat(0.025 * z));
        splats.rotations.push(Quat::IDENTITY);
        splats.opacities.push(0.98);
        let wave = |k: f32| 1.5 * libm::sinf(k * (at.x + 0.7 * at.y));
        splats.sh.extend(if is_ball { [1.5, -1.5, 0.0] } else { [3.0, 2.5, 2.0].map(wave) });
    }
    splats
}

fn alike_db(a: &[u8], b: &[u8]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    10.0 * libm::log10(255.0 * 255.0 * a.len() as f64 / sum.max(1e-9))
}

/// Compares the result from one image with rows that are each rendered at eight instants of their own exposure:
/// rotating, and passing balls that hide the background.
#[test]
fn rolling_shutter_and_blur_match_renderings_of_every_instant() {
    let k = lens(160, 120);
    let (width, height) = (160usize, 120usize);
    let splats = balls();
    let mut renderer = CpuRenderer::new(&splats);
    // A row begins every third of a millisecond and is exposed for 64 times that, so that rows share instants.
    let row_s = 0.04 / height as f64;
    let shutter_s = 64.0 * row_s;
    let exposure = ExposureControl::Fixed(Exposure { shutter_s, gain: 1.0 });
    let electrons_per_s = IDEAL.full_well_e / shutter_s;
    let sensor = Sensor { readout_s: 0.04, exposure, electrons_per_s, ..IDEAL };
    for (v_mps, better_db) in [(DVec3::ZERO, 12.0), (DVec3::new(1.5, 0.0, 0.5), 8.0)] {
        let path = move |at_s: f64| -> Pose<World, Cam> {
            let turn = DQuat::from_rotation_y(0.9 * at_s) * DQuat::from_rotation_x(0.4 * at_s);
            Pose::new(v_mps * at_s, turn)
        };
        let mut render = |at_s: f64| {
            let camera = Camera::new(k, path(at_s), 0.01);
            let mut images = [RgbdImage::default()];
            renderer.render(&[], &[camera], &mut images).unwrap();
            let [image] = images;
            (camera, image)
        };
        let (camera, image) = render(0.0);
        let taken = take(&model(sensor), &camera, &path, image.clone());
        // The n-th instant of row y is the (y + 8 n)-th of all.
        let mut sum = vec![0f32; 3 * width * height];
        for instant in 0..height + 56 {
            let at_s = (instant as f64 + 0.5 - 28.0 - 0.5 * height as f64) * row_s;
            let (_, image) = render(at_s);
            let rows = (0..8).filter_map(|n| instant.checked_sub(8 * n)).filter(|&y| y < height);
            for at in rows.map(|y| 3 * width * y) {
                let seen = &image.rgb[at..at + 3 * width];
                for (sum, &shown) in sum[at..].iter_mut().zip(seen) {
                    *sum += tone().linear(shown) / 8.0;
                }
            }
        }
        let plain: Vec<u8> = sum.iter().map(|&light| tone().shown(light)).collect();
        let (mut bytes, mut unmoved) = (Vec::new(), Vec::new());
        taken.write_rgb8(&mut bytes);
        image.write_rgb8(&mut unmoved);
        let (db, unmoved_db) = (alike_db(&bytes, &plain), alike_db(&unmoved, &plain));
        assert!(db > unmoved_db + better_db, "{v_mps}: {db} dB, unmoved {unmoved_db} dB");
    }
}

/// Results are bit-identical on one thread and on four; noise differs between images.
#[test]
fn images_do_not_depend_on_the_number_of_threads() {
    let k = Intrinsics { width_px: 75, height_px: 51, ..lens(75, 51) };
    let path = |at_s: f64| -> Pose<World, Cam> {
        Pose::new(DVec3::X * at_s, DQuat::from_rotation_y(0.9 * at_s))
    };
    let camera = Camera::new(k, path(0.0), 0.01);
    let mut images = [RgbdImage::default()];
    CpuRenderer::new(&balls()).render(&[], &[camera], &mut images).unwrap();
    let depths = [
        DepthModel::Perfect,
        DepthModel::Stereo(Stereo {
            baseline_m: 0.05,
            focal_px: 446.8,
            subpixel_px: 0.08,
            most_disparity_px: 126.0,
            most_m: 10.0,
            fattening_px: 3.0,
            least_texture: 0.01,
        }),
        DepthModel::Tof(Tof {
            modulation_hz: 20e6,
            unambiguous_m: 7.49,
            least_m: 0.1,
            most_m: 7.0,
            signal_e_1m: 40_000.0,
            background_e: 100.0,
            contrast: 0.8,
            least_signal_e: 10.0,
            multipath: true,
        }),
    ];
    for (depth, filter) in
        depths.into_iter().zip([ColorFilter::Rgb, ColorFilter::Bayer, ColorFilter::Mono])
    {
        let sensor = Sensor {
            filter,
            denoise: true,
            noise: true,
            read_noise_e: 3.0,
            readout_s: 0.02,
            ..IDEAL
        };
        let model = CameraModel { sensor: Some(sensor), depth };
        let on = |threads: usize, seq: u64| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut image = images[0].clone();
            let shot =
                Shot { camera: &camera, path: &path, at_s: 0.0, key: NoiseKey::new(1, 0, seq) };
            pool.install(|| Imager::default().apply(&model, &shot, &mut image));
            image
        };
        let one = on(1, 1);
        assert_eq!(on(4, 1), one);
        assert_ne!(on(1, 2).rgb, one.rgb);
        assert!(one.rgb.iter().all(|v| (0.0..=1.0).contains(v)));
    }
}

#[test]
fn nan_and_infinity_become_valid_colours_and_depths() {
    let k = lens(16, 12);
    let camera = Camera::new(k, Pose::IDENTITY, 0.01);
    let path = |at_s: f64| -> Pose<World, Cam> {
        Pose::new(DVec3::X * at_s, DQuat::from_rotation_z(at_s))
    };
    let poison = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e-40, -1.0, 0.0, 3e38];
    let mut image = flat(&k, 0.5, 1.0);
    for (n, &value) in poison.iter().cycle().take(60).enumerate() {
        image.rgb[7 * n % 576] = value;
        image.depth_median_m[3 * n % 192] = value;
        image.alpha[5 * n % 192] = value;
    }
    let stereo = Stereo {
        baseline_m: 0.05,
        focal_px: 400.0,
        subpixel_px: 0.1,
        most_disparity_px: 126.0,
        most_m: 10.0,
        fattening_px: 40.0,
        least_texture: 0.01,
    };
    let tof = Tof {
        modulation_hz: 100e6,
        unambiguous_m: 1.5,
        least_m: 0.1,
        most_m: 1.5,
        signal_e_1m: 100.0,
        background_e: 100.0,
        contrast: 0.5,
        least_signal_e: 1.0,
        multipath: true,
    };
    for depth in [DepthModel::Stereo(stereo), DepthModel::Tof(tof)] {
        for filter in [ColorFilter::Rgb, ColorFilter::Bayer, ColorFilter::Mono] {
            let sensor = Sensor { filter, denoise: true, noise: true, readout_s: 0.1, ..IDEAL };
            let model = CameraModel { sensor: Some(sensor), depth };
            let taken = take(&model, &camera, &path, image.clone());
            assert!(taken.rgb.iter().all(|v| (0.0..=1.0).contains(v)), "{filter:?}");
            assert!(taken.depth_median_m.iter().all(|&z| z == 0.0 || (0.01..=10.0).contains(&z)));
        }
    }
    // Images of a single row, column, and pixel.
    for (width, height) in [(5, 1), (1, 5), (1, 1), (2, 2)] {
        let k = lens(width, height);
        let camera = Camera::new(k, Pose::IDENTITY, 0.01);
        for depth in [DepthModel::Stereo(stereo), DepthModel::Tof(tof)] {
            let sensor = Sensor { filter: ColorFilter::Bayer, denoise: true, ..IDEAL };
            let model = CameraModel { sensor: Some(sensor), depth };
            let taken = take(&model, &camera, &path, flat(&k, 0.5, 1.0));
            assert!((linear(&taken, 0) - 0.214).abs() < 0.01);
        }
    }
}

#[test]
fn automatic_exposure_keeps_its_state_between_images() {
    let k = lens(32, 24);
    let camera = Camera::new(k, Pose::IDENTITY, 0.01);
    let auto = ExposureControl::Auto {
        aim: 0.2,
        lag_s: 0.5,
        least_shutter_s: 1e-5,
        most_shutter_s: 0.01,
        most_gain: 16.0,
    };
    let model = model(Sensor { exposure: auto, ..IDEAL });
    let mut imager = Imager::default();
    let mut at = |at_s: f64, shown: f32| {
        let path = still(&camera);
        let shot = Shot { camera: &camera, path: &path, at_s, key: NoiseKey::new(0, 0, 0) };
        let mut image = flat(&k, shown, 2.0);
        imager.apply(&model, &shot, &mut image);
        linear(&image, 0)
    };
    assert!((at(100.0, 0.5) - 0.2).abs() < 0.003, "the first is right");
    // Light falls to a quarter: two stops; half a second later, 1 - 1/e of them are compensated.
    let quarter = f32::from(tone().shown(0.25 * tone().linear(0.5))) / 255.0;
    let expected = 0.2 * libm::exp2(-2.0 * libm::exp(-1.0));
    let found = at(100.5, quarter);
    assert!((found - expected).abs() < 0.003, "{found}, not {expected}");
}
