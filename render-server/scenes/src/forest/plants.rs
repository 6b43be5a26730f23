//! Crowns, bushes, ferns and grass, made of single leaves.
//!
//! Within the fence, crowns are above [`CROWN_FLOOR_M`]. Ferns and grass are not solid and are below 0.4 m. Bushes are
//! outside of the fence.

use glam::{DVec2, DVec3};

use super::ground::cover;
use super::light::Light;
use super::site::{CLEAR_M, FENCE_Y_M, Site, Species};
use crate::canvas::{Canvas, Patch, paint};
use crate::random::{Rng, noise2, polar, smoothstep};

/// Paints all leaves.
pub(crate) fn paint_plants(canvas: &mut Canvas, site: &Site, light: &Light) {
    let mut rng = Rng::new(site.seed, 4);
    paint_crowns(canvas, &mut rng, site, light);
    paint_bushes(canvas, &mut rng, site, light);
    paint_ferns(canvas, &mut rng, site, light);
    paint_grass(canvas, &mut rng, site, light);
}

/// Spherical clump of leaves.
struct Clump {
    center_m: DVec3,
    radius_m: f64,
    leaves: usize,
    leaf_m: f64,
    /// Minimum height of leaves. [m]
    floor_m: f64,
    dark: DVec3,
    bright: DVec3,
}

fn paint_clump(canvas: &mut Canvas, rng: &mut Rng, clump: &Clump, light: &Light) {
    for _ in 0..clump.leaves {
        // More leaves near the surface of the clump than inside.
        let out = rng.direction();
        let reach = libm::cbrt(rng.range(0.12, 1.0));
        let offset = DVec3::new(out.x, out.y, out.z * 0.72) * reach;
        let size_m = clump.leaf_m * rng.range(0.7, 1.35);
        let mut p_m = clump.center_m + offset * clump.radius_m;
        p_m.z = p_m.z.max(clump.floor_m + 2.2 * size_m);
        let normal = (offset * 0.9 + DVec3::Z * 0.5 + rng.direction() * 0.9).normalize_or(DVec3::Z);
        // Sun that reaches this leaf through its clump.
        let depth = offset.dot(light.sun);
        let shade = smoothstep(-0.9, 0.75, depth + 0.3 * offset.z) * 0.9 + 0.08;
        let albedo = clump.dark.lerp(clump.bright, rng.unit()) * (0.72 + 0.4 * reach);
        canvas.add(Patch {
            center_m: p_m,
            normal,
            along: rng.direction() + out.truncate().extend(-0.3),
            sigma_m: DVec3::new(size_m, size_m * rng.range(0.42, 0.62), size_m * 0.12),
            opacity: rng.range(0.86, 0.97),
            radiance: light.leaf(p_m, normal, albedo, shade),
        });
    }
}

fn paint_crowns(canvas: &mut Canvas, rng: &mut Rng, site: &Site, light: &Light) {
    for tree in &site.trees {
        let autumn = rng.chance(0.14);
        let (dark, bright) = match (tree.species, autumn) {
            (Species::Pine, _) => (paint(0x2a4022), paint(0x5d7a3c)),
            (Species::Beech, false) => (paint(0x3f5c1f), paint(0x86a23a)),
            (Species::Birch, false) => (paint(0x55702a), paint(0xa3b548)),
            (_, true) => (paint(0x8a6a20), paint(0xd0a23a)),
        };
        let (leaves, leaf_m) = if tree.within { (13, 0.135) } else { (4, 0.30) };
        let floor_m = if tree.within { CROWN_FLOOR_M } else { 2.2 };
        let mut clumps: Vec<(DVec3, f64)> = Vec::new();
        for branch in &tree.branches {
            for t in [0.62, 1.0].into_iter().skip(usize::from(!tree.within)) {
                let p_m = branch.from_m.lerp(branch.to_m, t) + rng.direction() * 0.2;
                clumps.push((p_m, rng.range(0.45, 0.72)));
            }
        }
        let (top, _) = tree.axis[tree.axis.len() - 1];
        for _ in 0..3 {
            clumps.push((top + rng.direction() * 0.5, rng.range(0.6, 0.9)));
        }
        for (center_m, radius_m) in clumps {
            let lift_m = (floor_m + 0.75 * radius_m - center_m.z).max(0.0);
            let clump = Clump {
                center_m: center_m + DVec3::Z * lift_m,
                radius_m: if tree.within { radius_m } else { radius_m * 1.35 },
                leaves,
                leaf_m,
                floor_m,
                dark,
                bright,
            };
            paint_clump(canvas, rng, &clump, light);
        }
    }
}

/// Paints a belt of bushes and young trees around the fence, so that all views end in green.
fn paint_bushes(canvas: &mut Canvas, rng: &mut Rng, site: &Site, light: &Light) {
    let mut placed = 0;
    while placed < 250 {
        let p = DVec2::new(rng.range(-12.0, 53.0), rng.spread(17.0));
        let out_m = (p.y.abs() - FENCE_Y_M).max(-1.0 - p.x).max(p.x - 41.0);
        if !(1.5..9.5).contains(&out_m) {
            continue;
        }
        // In groups with gaps between them, denser farther out.
        let group = noise2(site.seed ^ 0x3d, p / 3.0);
        if group < 0.56 - 0.04 * out_m {
            continue;
        }
        placed += 1;
        let radius_m = rng.range(0.45, 0.8) + 0.05 * out_m;
        let (dark, bright) = match rng.below(3) {
            0 => (paint(0x33501f), paint(0x7c9a3c)),
            1 => (paint(0x2c4523), paint(0x5f8038)),
            _ => (paint(0x4a5a22), paint(0x9aa544)),
        };
        let height_m = rng.range(0.4, 1.0) * radius_m + (rng.unit() - 0.4).max(0.0) * 1.8;
        let clump = Clump {
            center_m: p.extend(height_m),
            radius_m,
            leaves: 18,
            leaf_m: 0.105 + 0.016 * out_m,
            floor_m: 0.0,
            dark,
            bright,
        };
        paint_clump(canvas, rng, &clump, light);
    }
}

fn paint_ferns(canvas: &mut Canvas, rng: &mut Rng, site: &Site, light: &Light) {
    let mut placed = 0;
    while placed < 135 {
        let p = DVec2::new(rng.range(-2.5, 42.5), rng.spread(7.8));
        let here = cover(site.seed, p);
        if here.path > 0.15 || site.is_near_ends(p, CLEAR_M) || rng.chance(0.75 - 0.6 * here.green)
        {
            continue;
        }
        placed += 1;
        let size_m = rng.range(0.24, 0.4);
        let fronds = 5 + rng.below(3);
        let turn = rng.angle();
        for frond in 0..fronds {
            let angle = turn + core::f64::consts::TAU * frond as f64 / fronds as f64;
            let out = polar(angle + rng.spread(0.3));
            let reach_m = size_m * rng.range(0.8, 1.2);
            // Each frond is an arch.
            for n in 1..=5 {
                let t = f64::from(n) / 5.0;
                let rise = (1.9 * t - 1.45 * t * t) * size_m * 1.25;
                let p_m = (p + out * (reach_m * t)).extend(rise.min(0.36) + 0.02);
                let lean = 1.9 - 2.9 * t;
                let along = (out * reach_m).extend(lean * size_m * 1.25);
                let normal = (out * -lean * 0.6).extend(1.0).normalize();
                let colour = paint(0x3d6020).lerp(paint(0x93b045), 0.25 + 0.6 * rng.unit());
                canvas.add(Patch {
                    center_m: p_m,
                    normal: normal + rng.direction() * 0.2,
                    along,
                    sigma_m: DVec3::new(0.14 * reach_m, (0.05 - 0.034 * t) * reach_m * 2.6, 0.004),
                    opacity: 0.94,
                    radiance: light.leaf(p_m, normal, colour, 0.35 + 0.6 * t),
                });
            }
        }
    }
}

fn paint_grass(canvas: &mut Canvas, rng: &mut Rng, site: &Site, light: &Light) {
    let mut placed = 0;
    while placed < 300 {
        let p = DVec2::new(rng.range(-2.5, 42.5), rng.spread(7.6));
        let here = cover(site.seed, p);
        if here.path > 0.5 || site.is_near_ends(p, 1.2) || rng.chance(0.85 - 0.8 * here.green) {
            continue;
        }
        placed += 1;
        let tall_m = rng.range(0.08, 0.2);
        let base = paint(0x47591f).lerp(paint(0x8d9a40), rng.unit());
        for _ in 0..8 {
            let lean = polar(rng.angle()) * rng.range(0.1, 0.7);
            let along = lean.extend(1.0).normalize();
            let height_m = tall_m * rng.range(0.6, 1.2);
            let foot = p + polar(rng.angle()) * (0.09 * rng.unit());
            let p_m = foot.extend(0.0) + along * (height_m * 0.45);
            let colour = base.lerp(paint(0xb5ab5c), 0.4 * rng.unit());
            canvas.add(Patch {
                center_m: p_m,
                normal: polar(rng.angle()).extend(0.2),
                along,
                sigma_m: DVec3::new(height_m * 0.36, 0.007, 0.003),
                opacity: 0.93,
                radiance: light.leaf(p_m, DVec3::Z, colour, 0.75),
            });
        }
    }
}

/// Minimum height of leaves of a crown within the fence. [m, world]
pub(crate) const CROWN_FLOOR_M: f64 = 3.05;
