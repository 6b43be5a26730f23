//! Forest floor: a trodden path, soil, moss and leaf litter, boulders and twigs.
//!
//! The true floor is the plane z = 0. Patches lie 1 to 3 cm below it, and litter is at most 2 cm above it.

use glam::{DVec2, DVec3};

use super::light::Light;
use super::site::{Rock, Site};
use crate::canvas::{Canvas, Patch, paint};
use crate::random::{Rng, fractal2, noise, noise2, polar, smoothstep};

/// Ground cover at a point.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cover {
    /// Share of trodden path, 0 to 1.
    pub(crate) path: f64,
    /// Share of moss or grass, 0 to 1.
    pub(crate) green: f64,
    /// Share of litter, 0 to 1.
    pub(crate) litter: f64,
}

/// Returns the ground cover at a point. [m, world]
pub(crate) fn cover(seed: u64, p: DVec2) -> Cover {
    let centre_m = 1.5 * (noise2(seed ^ 0x29, DVec2::new(p.x / 9.0, 0.0)) - 0.5)
        + 0.5 * (noise2(seed ^ 0x2a, DVec2::new(p.x / 3.0, 4.0)) - 0.5);
    let off_m = (p.y - centre_m).abs() + 0.5 * (fractal2(seed ^ 0x2b, p / 0.8, 2) - 0.5);
    let path = smoothstep(1.0, 0.35, off_m) * smoothstep(45.0, 40.0, p.x);
    let green = smoothstep(0.46, 0.64, fractal2(seed ^ 0x2c, p / 2.3, 4)) * (1.0 - 0.85 * path);
    let litter = smoothstep(0.36, 0.6, fractal2(seed ^ 0x2d, p / 1.7, 3)) * (1.0 - 0.55 * path);
    Cover { path, green, litter }
}

/// Paints the floor, litter and boulders.
pub(crate) fn paint_ground(canvas: &mut Canvas, site: &Site, light: &Light) {
    let mut rng = Rng::new(site.seed, 3);
    paint_bed(canvas, &mut rng, site, light);
    paint_near(canvas, &mut rng, site, light);
    paint_far(canvas, &mut rng, site, light);
    paint_litter(canvas, &mut rng, site, light);
    for (n, rock) in site.rocks.iter().enumerate() {
        paint_rock(canvas, &mut rng, rock, site.seed ^ (n as u64 + 500), light);
    }
}

fn albedo(seed: u64, p: DVec2, rng: &mut Rng) -> DVec3 {
    let cover = cover(seed, p);
    let fine = fractal2(seed ^ 0x2e, p / 0.28, 3);
    let soil = paint(0x4a3826).lerp(paint(0x7b6145), fine);
    let path = paint(0x75604a).lerp(paint(0xa58d6c), fine);
    let mut colour = soil.lerp(path, cover.path);
    if rng.chance(0.15 + 0.75 * cover.litter) {
        colour = colour.lerp(leaf_litter(rng), 0.85);
    }
    let moss = paint(0x3d4f1c).lerp(paint(0x82913c), fine * 0.7 + 0.3 * rng.unit());
    colour = colour.lerp(moss, cover.green * rng.range(0.55, 1.0));
    colour * (1.0 + 0.16 * rng.normal()).clamp(0.55, 1.5)
}

fn leaf_litter(rng: &mut Rng) -> DVec3 {
    const FALLEN: [u32; 8] =
        [0x8a5a2b, 0xa8703a, 0x6b4526, 0xb98a4e, 0x7d5233, 0x9c6a35, 0x5a3d24, 0xc29a58];
    paint(FALLEN[rng.below(FALLEN.len())])
}

fn add_ground(
    canvas: &mut Canvas,
    rng: &mut Rng,
    site: &Site,
    light: &Light,
    p: DVec2,
    size_m: f64,
) {
    let bump = |q: DVec2| fractal2(site.seed ^ 0x2f, q / 0.22, 2);
    let step_m = 0.03;
    let slope = DVec2::new(
        bump(p + DVec2::X * step_m) - bump(p - DVec2::X * step_m),
        bump(p + DVec2::Y * step_m) - bump(p - DVec2::Y * step_m),
    );
    let lit_normal = (DVec3::Z - slope.extend(0.0) * 1.6 + rng.direction() * 0.16).normalize();
    let normal = DVec3::Z + rng.direction() * 0.05;
    let stretch = rng.range(1.0, 1.35);
    let surface_m = p.extend(0.0);
    canvas.add(Patch {
        // At a grazing angle, a pixel has the depth of the nearest patch that covers it. With patches 2 cm below, the
        // rendered floor is at its true height.
        center_m: p.extend(-rng.range(0.022, 0.032)),
        normal,
        along: polar(rng.angle()).extend(0.0),
        sigma_m: DVec3::new(0.53 * size_m * stretch, 0.53 * size_m / stretch.sqrt(), 0.003),
        opacity: 0.98,
        radiance: light.matt(surface_m, lit_normal, albedo(site.seed, p, rng)),
    });
}

/// Paints large patches well below the floor, which close the seams between the fine ones. They are so deep that they
/// are behind the floor on any line of sight from above, and never blur it.
fn paint_bed(canvas: &mut Canvas, rng: &mut Rng, site: &Site, light: &Light) {
    let side_m = 0.46;
    let columns = ((FAR_X_M - NEAR_X_M) / side_m) as usize;
    let rows = (2.0 * NEAR_Y_M / side_m) as usize;
    for row in 0..rows {
        for column in 0..columns {
            let p = DVec2::new(
                NEAR_X_M + (column as f64 + 0.5) * side_m,
                (row as f64 + 0.5) * side_m - NEAR_Y_M,
            );
            let here = cover(site.seed, p);
            let colour =
                paint(0x5d4731).lerp(paint(0x8a7456), here.path).lerp(paint(0x5f6e2a), here.green);
            canvas.add(Patch {
                center_m: p.extend(-0.45),
                normal: DVec3::Z,
                along: polar(rng.angle()).extend(0.0),
                sigma_m: DVec3::new(0.55 * side_m, 0.55 * side_m, 0.003),
                opacity: 0.99,
                radiance: light.matt(p.extend(0.0), DVec3::Z, colour),
            });
        }
    }
}

/// Paints the arena and its border, finest along its middle.
fn paint_near(canvas: &mut Canvas, rng: &mut Rng, site: &Site, light: &Light) {
    for side in [-1.0, 1.0] {
        let mut y = 0.0;
        while y < NEAR_Y_M {
            let size_m = 0.099 + 0.037 * (y - 1.3f64).max(0.0);
            let count = ((FAR_X_M - NEAR_X_M) / size_m) as usize;
            let shift = rng.unit();
            for n in 0..count {
                let x = NEAR_X_M + (n as f64 + shift + rng.spread(0.3)) * size_m;
                let p = DVec2::new(x, side * (y + size_m * (0.5 + rng.spread(0.3))));
                add_ground(canvas, rng, site, light, p, size_m);
            }
            y += size_m;
        }
    }
}

/// Paints the surroundings up to the horizon, with squares that grow with distance.
fn paint_far(canvas: &mut Canvas, rng: &mut Rng, site: &Site, light: &Light) {
    let mut open = Vec::new();
    for i in -5..5 {
        for j in -5..5 {
            let corner = DVec2::new(20.0 + 8.0 * f64::from(i), 8.0 * f64::from(j));
            open.push((corner, 8.0));
        }
    }
    while let Some((corner, side_m)) = open.pop() {
        let middle = corner + DVec2::splat(side_m / 2.0);
        let outside = |p: DVec2| (NEAR_X_M - p.x).max(p.x - FAR_X_M).max(p.y.abs() - NEAR_Y_M);
        let away_m = outside(middle);
        if away_m < -0.75 * side_m {
            continue;
        }
        if side_m > 0.34 + 0.17 * away_m.max(0.0) {
            let half_m = side_m / 2.0;
            for shift in [DVec2::ZERO, DVec2::X, DVec2::Y, DVec2::ONE] {
                open.push((corner + shift * half_m, half_m));
            }
        } else if away_m > -0.05 {
            let p = middle + DVec2::new(rng.spread(0.2), rng.spread(0.2)) * side_m;
            add_ground(canvas, rng, site, light, p, side_m);
        }
    }
}

/// Paints fallen leaves and twigs, denser near the middle.
fn paint_litter(canvas: &mut Canvas, rng: &mut Rng, site: &Site, light: &Light) {
    let mut leaves = 0;
    while leaves < 5200 {
        let p = DVec2::new(rng.range(-2.0, 42.0), 2.1 * rng.normal());
        // The floor is bare at start and goal.
        if p.y.abs() > 7.0
            || site.is_near_ends(p, 0.7)
            || !rng.chance(0.12 + 0.88 * cover(site.seed, p).litter)
        {
            continue;
        }
        leaves += 1;
        let normal = DVec3::Z * 1.5 + rng.direction();
        let size_m = rng.range(0.016, 0.032);
        let p_m = p.extend(rng.range(0.006, 0.018));
        let colour = leaf_litter(rng) * rng.range(0.8, 1.5);
        canvas.add(Patch {
            center_m: p_m,
            normal,
            along: polar(rng.angle()).extend(0.0),
            sigma_m: DVec3::new(size_m * 1.25, size_m * 0.7, 0.002),
            opacity: 0.95,
            radiance: light.matt(p_m, normal.normalize(), colour),
        });
    }
    for _ in 0..300 {
        let p = DVec2::new(rng.range(-1.0, 41.0), rng.spread(6.5));
        let along = polar(rng.angle());
        let length_m = rng.range(0.06, 0.22);
        let colour = paint(0x4d3b2a).lerp(paint(0x8c7a62), rng.unit());
        for n in 0..2 {
            let p_m = (p + along * (length_m * f64::from(n))).extend(0.012);
            canvas.add(Patch {
                center_m: p_m,
                normal: DVec3::Z,
                along: along.extend(rng.spread(0.05)),
                sigma_m: DVec3::new(length_m * 0.5, 0.007, 0.006),
                opacity: 0.95,
                radiance: light.matt(p_m, DVec3::Z, colour),
            });
        }
    }
}

fn paint_rock(canvas: &mut Canvas, rng: &mut Rng, rock: &Rock, key: u64, light: &Light) {
    let spacing_m = 0.055;
    let area_m2 = 4.0 * core::f64::consts::PI * rock.radius_m * rock.radius_m;
    let count = (area_m2 / (spacing_m * spacing_m)) as usize;
    for n in 0..count {
        // Fibonacci sphere: even, and easy to jitter.
        let z = 1.0 - 2.0 * (n as f64 + 0.5) / count as f64;
        let turn = n as f64 * 2.399_963_229_728_653;
        let ring = (1.0 - z * z).max(0.0).sqrt();
        let normal = ((polar(turn) * ring).extend(z) + rng.direction() * 0.04).normalize();
        let p_m = rock.center_m + normal * rock.radius_m;
        if p_m.z < 0.004 {
            continue;
        }
        let vein = noise(key, p_m / 0.11);
        let grain = noise(key ^ 0x1, p_m / 0.035);
        let stone = paint(0x5d5b55).lerp(paint(0xa29c8e), 0.6 * vein + 0.4 * grain);
        let crack = smoothstep(0.08, 0.0, (noise(key ^ 0x2, p_m / 0.24) - 0.5).abs());
        let lump = DVec3::new(
            noise(key ^ 0x3, p_m / 0.15) - 0.5,
            noise(key ^ 0x4, p_m / 0.15) - 0.5,
            noise(key ^ 0x5, p_m / 0.15) - 0.5,
        );
        let lit = (normal + lump * 1.1).normalize();
        let mossy =
            smoothstep(0.55, 0.8, 0.5 * normal.z + 0.75 * noise(key ^ 0x6, p_m / 0.2) - 0.05);
        let green = paint(0x46591f).lerp(paint(0x8a9a40), rng.unit());
        let colour = stone.lerp(paint(0x35332f), 0.6 * crack).lerp(green, 0.9 * mossy);
        canvas.add(Patch {
            center_m: p_m - normal * 0.006,
            normal,
            along: rng.direction(),
            sigma_m: DVec3::new(0.62 * spacing_m, 0.55 * spacing_m, 0.004),
            opacity: 0.98,
            radiance: light.matt(p_m, lit, colour),
        });
    }
}

/// Bounds of the finely painted floor. [m, world]
const NEAR_X_M: f64 = -3.0;
const FAR_X_M: f64 = 43.0;
const NEAR_Y_M: f64 = 8.0;
