//! Distant surroundings: a sky that is brightest around the sun, hazy hills, and belts of distant trunks and foliage
//! that fade into the haze.

use core::f64::consts::{PI, TAU};

use glam::{DVec2, DVec3};

use super::site::Site;
use crate::canvas::{Canvas, Patch, paint};
use crate::random::{Rng, fractal2, polar, smoothstep};

/// Paints the surroundings out to the sky.
pub(crate) fn paint_backdrop(canvas: &mut Canvas, site: &Site) {
    let mut rng = Rng::new(site.seed, 5);
    paint_sky(canvas, &mut rng, site);
    // (Distance beyond the middle ellipse, haze, splat size).
    for (away_m, haze, size_m) in [(11.0, 0.16, 0.9), (17.0, 0.5, 1.4)] {
        paint_belt(canvas, &mut rng, site, away_m, haze, size_m);
    }
}

/// Returns the light of the sky in a direction.
fn sky(site: &Site, direction: DVec3) -> DVec3 {
    let up = direction.z.clamp(0.0, 1.0);
    let blue = paint(0xc9dbe6).lerp(paint(0x86b0dc), smoothstep(0.05, 0.8, up));
    let near = direction.dot(site.sun).max(0.0);
    let glow = DVec3::new(1.5, 1.15, 0.7) * (0.35 * libm::pow(near, 5.0) + libm::pow(near, 40.0));
    let cloud =
        fractal2(site.seed ^ 0x47, DVec2::new(direction.x, direction.y) * 2.6 / (0.35 + up), 4);
    let white = smoothstep(0.5, 0.75, cloud) * smoothstep(0.02, 0.3, up);
    (blue * 0.95 + HAZE * (0.35 * (1.0 - up) * (1.0 - up))).lerp(DVec3::splat(1.05), 0.6 * white)
        + glow
}

fn paint_sky(canvas: &mut Canvas, rng: &mut Rng, site: &Site) {
    let rings = 15;
    for ring in 0..rings {
        let elevation = -0.10 + (PI / 2.0 + 0.10) * (f64::from(ring) + 0.5) / f64::from(rings);
        let flat = libm::cos(elevation);
        let step = (PI / 2.0 + 0.10) / f64::from(rings);
        let count = ((TAU * flat / step).ceil() as usize).max(4);
        let turn = rng.angle();
        for n in 0..count {
            let direction =
                (polar(turn + TAU * n as f64 / count as f64) * flat).extend(libm::sin(elevation));
            let p_m = MIDDLE_M + direction * DVec3::new(SKY_X_M, SKY_X_M, SKY_Z_M);
            let sigma_m = 0.62 * step * SKY_X_M;
            canvas.add(Patch {
                center_m: p_m,
                normal: -direction,
                along: DVec3::Z,
                sigma_m: DVec3::new(sigma_m, sigma_m, 0.3),
                opacity: 0.99,
                radiance: sky(site, direction),
            });
        }
    }
}

fn paint_belt(
    canvas: &mut Canvas,
    rng: &mut Rng,
    site: &Site,
    away_m: f64,
    haze: f64,
    size_m: f64,
) {
    let (long_m, wide_m) = (21.0 + away_m, 8.0 + away_m);
    let perimeter_m =
        PI * (3.0 * (long_m + wide_m) - ((3.0 * long_m + wide_m) * (long_m + 3.0 * wide_m)).sqrt());
    let place = |angle: f64| {
        let out = polar(angle);
        MIDDLE_M.truncate() + DVec2::new(long_m * out.x, wide_m * out.y)
    };
    let lit = |p: DVec2| {
        let towards = (p - MIDDLE_M.truncate())
            .normalize_or_zero()
            .dot(site.sun.truncate().normalize_or_zero());
        // The haze is bright and golden towards the sun, and cool away from it.
        HAZE.lerp(DVec3::new(1.25, 1.0, 0.66), 0.6 * towards.max(0.0))
    };
    let key = site.seed ^ (away_m as u64);
    // Foliage with a varying height.
    let columns = (perimeter_m / size_m) as usize;
    for column in 0..columns {
        let angle = TAU * (column as f64 + rng.spread(0.5)) / columns as f64;
        let p = place(angle);
        let top_m = 3.5 + 0.28 * away_m + 5.0 * fractal2(key, p / 7.0, 2) + 1.5 * rng.unit();
        let mut z_m = 0.25 * size_m;
        while z_m < top_m {
            let jitter = polar(rng.angle()) * rng.range(0.0, 1.3);
            let green = paint(0x2e4420).lerp(paint(0x6f8a3c), rng.unit());
            let clump = fractal2(key ^ 0x1, DVec2::new(angle * 9.0, z_m / 2.2), 3);
            let light = 0.10
                + 0.45 * smoothstep(0.0, top_m, z_m)
                + 0.8 * smoothstep(0.4, 0.62, clump)
                + 0.3 * rng.unit();
            canvas.add(Patch {
                center_m: (p + jitter).extend(z_m),
                normal: rng.direction(),
                along: rng.direction(),
                sigma_m: DVec3::new(0.8 * size_m, 0.5 * size_m, 0.4 * size_m),
                opacity: 0.93,
                radiance: (green * light * 1.3).lerp(lit(p) * (0.6 + 0.5 * haze), haze),
            });
            z_m += 0.85 * size_m * rng.range(0.8, 1.2);
        }
    }
    // Trunks in front of the foliage.
    for _ in 0..(perimeter_m / 1.3) as usize {
        let p = place(rng.angle()) + polar(rng.angle()) * 1.2;
        let p = p + (MIDDLE_M.truncate() - p).normalize_or_zero() * 1.6;
        // Their tops end within the foliage.
        let height_m = 3.0 + 0.28 * away_m + 4.0 * fractal2(key, p / 7.0, 2);
        let radius_m = rng.range(0.12, 0.26);
        let wood = paint(0x4a3e32).lerp(paint(0x8a7c6a), rng.unit());
        let shade = rng.range(0.2, 0.9);
        for n in 0..4 {
            let z_m = height_m * (f64::from(n) + 0.5) / 4.0;
            canvas.add(Patch {
                center_m: p.extend(z_m),
                normal: DVec3::X,
                along: DVec3::Z,
                sigma_m: DVec3::new(0.13 * height_m, radius_m * 0.7, radius_m * 0.7),
                opacity: 0.96,
                radiance: (wood * shade).lerp(lit(p) * (0.6 + 0.5 * haze), haze * 0.8),
            });
        }
    }
}

/// Light of distant air.
const HAZE: DVec3 = DVec3::new(0.62, 0.72, 0.62);
/// Middle of the arena, on the ground. [m, world]
const MIDDLE_M: DVec3 = DVec3::new(20.0, 0.0, 0.0);
/// Half axes of the sky. Its far end is within 65 m of the arena, the limit of 16-bit millimetres. [m]
const SKY_X_M: f64 = 43.0;
const SKY_Z_M: f64 = 34.0;
