use glam::DVec3;

use super::*;
use crate::imaging::shutter;

/// Camera with one frequency of 20 MHz.
const CAMERA: Tof = Tof {
    modulation_hz: 20e6,
    unambiguous_m: LIGHT_MPS / 40e6,
    least_m: 0.1,
    most_m: 7.5,
    signal_e_1m: 40_000.0,
    background_e: 0.0,
    contrast: 0.8,
    least_signal_e: 0.0,
    multipath: false,
};

/// Measures a scene of uniform reflectivity; `depth_m` returns the depth for a slope.
fn measured(
    tof: &Tof,
    size: (u32, u32),
    white: f32,
    depth_m: impl Fn(Vec2) -> f32,
) -> (Vec<Pixel>, Vec<f32>) {
    let k = Intrinsics::from_horizontal_fov(size.0, size.1, 75f64.to_radians());
    let pixels = shutter::pixels(&k);
    let mut image = RgbdImage::default();
    image.resize(size.0, size.1);
    image.alpha.fill(1.0);
    for (z, pixel) in image.depth_median_m.iter_mut().zip(&pixels) {
        *z = depth_m(pixel.slope());
    }
    let (light, mut out) = (vec![white; 3 * k.pixels()], vec![0.0; k.pixels()]);
    let key = NoiseKey::new(4, 0, 0);
    tof.measure(&k, &image, (&pixels, &light), key, &mut Scratch::default(), &mut out);
    (pixels, out)
}

/// Returns the depth of a sphere around the camera, `distance_m` along every ray.
fn sphere(distance_m: f32) -> impl Fn(Vec2) -> f32 {
    move |slope| distance_m / slope.extend(1.0).length()
}

/// Returns mean and standard deviation of distances along the ray.
fn moments(pixels: &[Pixel], out: &[f32]) -> (f64, f64) {
    let distances =
        pixels.iter().zip(out).map(|(pixel, z)| f64::from(z * pixel.slope().extend(1.0).length()));
    let count = out.len() as f64;
    let mean = distances.clone().sum::<f64>() / count;
    (mean, (distances.map(|d| (d - mean).powi(2)).sum::<f64>() / count).sqrt())
}

/// Checks the formula, also against counted photons in buckets.
#[test]
fn noise_matches_photons_in_four_buckets() {
    for (distance_m, background_e) in [(1.0, 0.0), (2.0, 0.0), (4.0, 0.0), (4.0, 5000.0)] {
        let tof = Tof { background_e, ..CAMERA };
        let (pixels, out) = measured(&tof, (160, 120), 0.5, sphere(distance_m));
        let (mean, sigma) = moments(&pixels, &out);
        let signal_e = tof.signal_e(0.5, f64::from(distance_m));
        assert!((signal_e - 20_000.0 / f64::from(distance_m).powi(2)).abs() < 1e-6);
        let expected = tof.sigma_m(signal_e);
        assert!((sigma / expected - 1.0).abs() < 0.03, "{distance_m} m: {sigma}, not {expected}");
        assert!((mean - f64::from(distance_m)).abs() < 5.0 * expected / 138.0 + 1e-4);

        // Four buckets a quarter of a period apart, each with normal noise of its number of photons.
        let (key, table) = (NoiseKey::new(9, 9, 9), Normals::table());
        let phase = f64::from(distance_m) / tof.metres_per_rad();
        let mean_e = (signal_e + background_e) / 4.0;
        let measured = (0..20_000).map(|n| {
            let bits = key.bits(n);
            let buckets = [0, 1, 2, 3].map(|k| {
                let turn = phase + f64::from(k) * core::f64::consts::FRAC_PI_2;
                let expected = mean_e + signal_e / 4.0 * tof.contrast * libm::cos(turn);
                expected + expected.sqrt() * f64::from(table.of(bits, k))
            });
            let measured = libm::atan2(buckets[3] - buckets[1], buckets[0] - buckets[2]);
            let turn = core::f64::consts::TAU;
            let off = (measured - phase + 0.5 * turn).rem_euclid(turn) - 0.5 * turn;
            off * tof.metres_per_rad()
        });
        let counted = (measured.map(|off| off * off).sum::<f64>() / 20_000.0).sqrt();
        assert!((counted / expected - 1.0).abs() < 0.03, "{distance_m} m: {counted}");
    }
    // Without background light, the deviation grows with distance; with strong background light, with its square.
    let at = |tof: &Tof, z: f64| tof.sigma_m(tof.signal_e(0.5, z));
    assert!((at(&CAMERA, 4.0) / at(&CAMERA, 2.0) - 2.0).abs() < 1e-9);
    let sunny = Tof { background_e: 1e9, ..CAMERA };
    assert!((at(&sunny, 4.0) / at(&sunny, 2.0) - 4.0).abs() < 1e-3);
}

#[test]
fn distances_alias_after_half_a_wavelength() {
    let quiet = Tof { signal_e_1m: 1e12, ..CAMERA };
    // c / (2 * 20 MHz) = 7.4948 m.
    assert!((quiet.unambiguous_m - 7.494_811_45).abs() < 1e-9);
    for (true_m, shown_m) in [(3.0, 3.0), (7.4, 7.4), (9.0, 1.505_19), (16.0, 1.010_38)] {
        let (pixels, out) = measured(&quiet, (32, 24), 0.8, sphere(true_m));
        let (mean, sigma) = moments(&pixels, &out);
        assert!((mean - shown_m).abs() < 1e-3 && sigma < 1e-3, "{true_m} m: {mean}");
    }
    // Out of range, without a return: too near, and aliased to too near.
    for true_m in [0.05, 7.55] {
        assert!(measured(&quiet, (32, 24), 0.8, sphere(true_m)).1.iter().all(|&z| z == 0.0));
    }
    let dim = Tof { least_signal_e: 1000.0, ..CAMERA };
    assert!(measured(&dim, (32, 24), 0.5, sphere(5.0)).1.iter().all(|&z| z == 0.0));
    assert!(measured(&dim, (32, 24), 0.5, sphere(4.0)).1.iter().all(|&z| z > 0.0));
}

/// Depth of a corner of two white walls at 90 degrees, with a vertical edge 2 m ahead.
fn corner(slope: Vec2) -> f32 {
    // x = +-(2 - z): walls on both sides that meet at z = 2.
    2.0 / (1.0 + slope.x.abs())
}

/// Cells along each side of the image in the summation.
const FINE: i32 = 240;

/// Indirect light of the corner, summed finely in f64 from the geometry.
fn integrated_m(tof: &Tof, slope: DVec3, white: f64) -> f64 {
    let s = core::f64::consts::FRAC_1_SQRT_2;
    let wall = |x: f64| if x > 0.0 { DVec3::new(-s, 0.0, -s) } else { DVec3::new(s, 0.0, -s) };
    let point = |slope: DVec3| slope * (2.0 / (1.0 + slope.x.abs()));
    let p = point(slope);
    let (normal, d) = (wall(p.x), p.length());
    let direct = -normal.dot(p) / d / (d * d);
    let (half_x, half_y) =
        (libm::tan(37.5f64.to_radians()), libm::tan(37.5f64.to_radians()) * 0.75);
    let (mut re, mut im) = (direct, 0.0);
    for ny in 0..FINE {
        for nx in 0..FINE {
            let u = (2.0 * (f64::from(nx) + 0.5) / f64::from(FINE) - 1.0) * half_x;
            let v = (2.0 * (f64::from(ny) + 0.5) / f64::from(FINE) - 1.0) * half_y;
            let q = point(DVec3::new(u, v, 1.0));
            let other = wall(q.x);
            if other == normal {
                continue;
            }
            let (dq, way) = (q.length(), q - p);
            // Solid angle of the cell, projected onto the wall.
            let cell = 4.0 * half_x * half_y / f64::from(FINE * FINE);
            let area = cell * q.z * q.z * q.z / -other.dot(q);
            let falls = -other.dot(q) / dq / (dq * dq);
            let r = way.length();
            let form = normal.dot(way) * -other.dot(way) / (core::f64::consts::PI * r.powi(4));
            let sent = white * falls * area * form;
            let phase = 0.5 * (dq + r - d) / tof.metres_per_rad();
            re += sent * libm::cos(phase);
            im += sent * libm::sin(phase);
        }
    }
    libm::atan2(im, re) * tof.metres_per_rad()
}

#[test]
fn single_bounces_make_corners_appear_further_away() {
    let tof = Tof { signal_e_1m: 1e12, multipath: true, ..CAMERA };
    let (pixels, out) = measured(&tof, (320, 240), 0.8, corner);
    for x in [60usize, 100, 130, 190, 220, 260] {
        let n = 120 * 320 + x;
        let slope = pixels[n].slope();
        let along = slope.extend(1.0).length();
        let off_m = f64::from(out[n] * along - corner(slope) * along);
        let expected_m = integrated_m(&tof, slope.extend(1.0).as_dvec3(), 0.8);
        assert!(expected_m > 0.01, "column {x}: {expected_m} m");
        assert!(
            (off_m / expected_m - 1.0).abs() < 0.15,
            "column {x}: {off_m} m, not {expected_m} m"
        );
    }
    // A flat wall does not illuminate itself.
    let (pixels, out) = measured(&tof, (320, 240), 0.8, |_| 2.0);
    let worst = pixels.iter().zip(&out).map(|(_, z)| (z - 2.0).abs()).fold(0.0, f32::max);
    assert!(worst < 2e-3, "{worst} m");
}
