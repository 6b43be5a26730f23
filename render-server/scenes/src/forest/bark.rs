//! Trunks, roots, branches and fallen logs: ridged, cracked or smooth bark with moss.

use core::f64::consts::TAU;

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::Volume;

use super::light::Light;
use super::site::{Limb, Site, Species, Tree};
use crate::canvas::{Canvas, Patch, paint};
use crate::random::{Rng, fractal2, noise, polar, smoothstep};

/// Paints all wood of the site.
pub(crate) fn paint_wood(canvas: &mut Canvas, site: &Site, light: &Light) {
    let mut rng = Rng::new(site.seed, 2);
    for tree in &site.trees {
        paint_trunk(canvas, &mut rng, tree, light);
        for root in &tree.roots {
            if tree.within {
                paint_limb(canvas, &mut rng, tree, root, light, 0.07);
            }
        }
        for branch in &tree.branches {
            paint_branch(canvas, &mut rng, tree, branch, light);
        }
    }
    for log in &site.logs {
        paint_log(canvas, &mut rng, log, light);
    }
}

/// Returns the albedo and the relief [m] of bark: `around` is the direction from the axis.
fn bark(species: Species, key: u64, around: DVec3, radius_m: f64, z_m: f64) -> (DVec3, f64) {
    // The noise is wrapped onto a circle, so that there is no seam; 1 unit is 1 m of circumference.
    let on = |across_m: f64, along_m: f64| {
        DVec3::new(around.x * radius_m / across_m, around.y * radius_m / across_m, z_m / along_m)
    };
    let large = noise(key ^ 0x1, on(0.5, 1.3));
    match species {
        Species::Pine => {
            let sway = noise(key ^ 0x2, on(0.12, 0.22)) - 0.5;
            let ridge = noise(key ^ 0x3, on(0.05, 0.42) + DVec3::splat(1.4 * sway));
            let plate = noise(key ^ 0x4, on(0.06, 0.09));
            let height = smoothstep(0.33, 0.62, ridge);
            // Redder towards the crown.
            let red = smoothstep(1.5, 6.0, z_m + 3.0 * (large - 0.5));
            let face = paint(0x8a7360).lerp(paint(0xa8714a), red) * (0.72 + 0.65 * plate);
            (paint(0x2b2019).lerp(face, height), 0.012 * (1.0 - height))
        }
        Species::Beech => {
            let blotch = noise(key ^ 0x5, on(0.17, 0.2));
            let fine = noise(key ^ 0x6, on(0.05, 0.035));
            let grey = paint(0x77756a).lerp(paint(0xa5a393), smoothstep(0.3, 0.75, blotch));
            let lichen = smoothstep(0.66, 0.74, noise(key ^ 0x7, on(0.11, 0.13)));
            let crack = smoothstep(0.72, 0.8, noise(key ^ 0x8, on(0.3, 0.05)));
            let albedo = grey.lerp(paint(0xb9c4a8), 0.7 * lichen) * (0.75 + 0.4 * fine);
            (albedo.lerp(paint(0x3c3a34), 0.65 * crack), 0.003 * crack)
        }
        Species::Birch => {
            let fine = noise(key ^ 0x9, on(0.09, 0.05));
            let white = paint(0xcfc8ba).lerp(paint(0xe9e4d8), fine);
            // Short dark dashes across, and black rough bark at the foot.
            let dash = smoothstep(0.66, 0.73, noise(key ^ 0xa, on(0.20, 0.032)));
            let rough = noise(key ^ 0xb, on(0.06, 0.16));
            let foot = smoothstep(0.75, 0.1, z_m + 0.9 * (rough - 0.5));
            let diamond = smoothstep(0.73, 0.78, noise(key ^ 0xc, on(0.14, 0.22)));
            let dark = dash.max(foot * smoothstep(0.25, 0.6, rough)).max(diamond);
            (white.lerp(paint(0x25211d), 0.88 * dark), 0.006 * foot)
        }
    }
}

/// Adds moss on the side away from the sun and at the base.
fn moss(key: u64, light: &Light, p_m: DVec3, normal: DVec3, albedo: DVec3, rng: &mut Rng) -> DVec3 {
    let away = -normal.truncate().dot(light.sun.truncate().normalize_or_zero());
    let patch = noise(key ^ 0x14, p_m / 0.3) + 0.4 * noise(key ^ 0x15, p_m / 0.08) - 0.2;
    let low = smoothstep(1.5, 0.0, p_m.z);
    let cover = smoothstep(0.62, 0.8, patch + 0.22 * away + 0.32 * low + 0.25 * normal.z.max(0.0));
    let green = paint(0x4c5f22).lerp(paint(0x7c8a35), rng.unit());
    albedo.lerp(green, 0.85 * cover)
}

fn paint_trunk(canvas: &mut Canvas, rng: &mut Rng, tree: &Tree, light: &Light) {
    let (middle, _) = tree.at_height(1.5);
    let distant = !tree.within;
    let aside = middle.y.abs() > 3.6;
    let mut z_m = 0.02;
    while z_m < tree.top_m() - 0.2 {
        let (_, radius_m) = tree.at_height(z_m);
        // Patch spacing (across, along): fine where vehicles pass, coarse in the crown.
        let (across_m, along_m) = match (distant, z_m) {
            (false, z) if z < 3.0 && !aside => (0.046, 0.17),
            (false, z) if z < 3.2 => (0.052, 0.19),
            (false, z) if z < 5.0 => (0.07, 0.32),
            (true, z) if z < 4.0 => (0.19, 1.2),
            _ => (0.16, 0.8),
        };
        let columns = ((TAU * radius_m / across_m).round() as usize).max(6);
        let across_m = TAU * radius_m / columns as f64;
        let turn = rng.angle();
        for column in 0..columns {
            let angle = turn + TAU * (column as f64 + rng.spread(0.3)) / columns as f64;
            let z = z_m + rng.spread(0.35) * along_m;
            let around = polar(angle).extend(0.0);
            let (center, _) = tree.at_height(z);
            let Some((p_m, normal)) = surface(&tree.trunk, center, around) else { continue };
            if p_m.z < 0.004 {
                continue;
            }
            let (albedo, relief_m) = bark(tree.species, tree.key, around, radius_m, z);
            let albedo = moss(tree.key, light, p_m, normal, albedo, rng);
            // Furrows receive less light; ridges tilt the surface randomly.
            let tilted = (normal + rng.direction() * 0.22).normalize_or(normal);
            let crevice = 1.0 - 18.0 * relief_m;
            let grain = (0.13 * rng.normal()).clamp(-0.3, 0.3) + 1.0;
            canvas.add(Patch {
                center_m: p_m - normal * (0.006 + 0.5 * relief_m),
                normal,
                along: DVec3::Z + rng.direction() * 0.1,
                sigma_m: DVec3::new(0.52 * along_m, 0.56 * across_m, 0.004),
                opacity: 0.97,
                radiance: light.matt(p_m, tilted, albedo) * (grain * crevice),
            });
        }
        z_m += along_m;
    }
    if tree.within && !aside {
        paint_strokes(canvas, rng, tree, light);
    }
}

/// Paints narrow strokes on the trunk where vehicles pass: details that a camera resolves at a distance of about 0.7 m.
fn paint_strokes(canvas: &mut Canvas, rng: &mut Rng, tree: &Tree, light: &Light) {
    let (_, radius_m) = tree.at_height(1.5);
    let count = (TAU * radius_m * STROKES_TOP_M * STROKES_PER_M2) as usize;
    // Birch bark has horizontal marks, the others vertical ones.
    let across = tree.species == Species::Birch;
    for _ in 0..count {
        let around = polar(rng.angle()).extend(0.0);
        let z = STROKES_TOP_M * rng.unit();
        let (center, _) = tree.at_height(z);
        let Some((p_m, normal)) = surface(&tree.trunk, center, around) else { continue };
        if p_m.z < 0.03 {
            continue;
        }
        let (albedo, relief_m) = bark(tree.species, tree.key, around, radius_m, z);
        let albedo = moss(tree.key, light, p_m, normal, albedo, rng);
        let dark = rng.chance(if relief_m > 0.004 { 0.8 } else { 0.38 });
        let tone = if dark { rng.range(0.25, 0.6) } else { rng.range(1.05, 1.5) };
        let width_m = rng.range(0.0035, 0.008);
        let length_m = rng.range(0.025, 0.075);
        let (along, length_m) = if across {
            (DVec3::Z.cross(normal) + rng.direction() * 0.12, 0.55 * length_m)
        } else {
            (DVec3::Z + rng.direction() * 0.16, length_m)
        };
        canvas.add(Patch {
            center_m: p_m + normal * 0.002,
            normal,
            along,
            sigma_m: DVec3::new(length_m, width_m, 0.002),
            opacity: 0.9,
            radiance: light.matt(p_m, normal, albedo) * tone,
        });
    }
}

/// Returns the surface point of a ray from outside towards the axis, and its normal. [m, world]
fn surface(parts: &[Volume], center_m: DVec3, around: DVec3) -> Option<(DVec3, DVec3)> {
    let distance = |p: DVec3| parts.iter().map(|v| v.signed_distance_m(p)).fold(f64::MAX, f64::min);
    let mut p_m = center_m + around * 0.75;
    for _ in 0..24 {
        let d = distance(p_m);
        if d < 1e-3 {
            let slope = |axis: DVec3| distance(p_m + axis * 1e-3) - distance(p_m - axis * 1e-3);
            let normal =
                DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z)).normalize_or(around);
            return Some((p_m, normal));
        }
        p_m -= around * d;
    }
    None
}

fn paint_limb(
    canvas: &mut Canvas,
    rng: &mut Rng,
    tree: &Tree,
    limb: &Limb,
    light: &Light,
    spacing_m: f64,
) {
    let axis = limb.to_m - limb.from_m;
    let length_m = axis.length();
    let along = axis / length_m;
    let side = along.cross(DVec3::Z).normalize_or(DVec3::X);
    let other = side.cross(along);
    let rows = (length_m / spacing_m).ceil() as usize;
    let columns = ((TAU * limb.radius_m / spacing_m) as usize).max(5);
    for row in 0..rows {
        for column in 0..columns {
            let turn = polar(TAU * (column as f64 + rng.unit()) / columns as f64);
            let normal = side * turn.x + other * turn.y;
            let t = (row as f64 + rng.unit()) / rows as f64;
            let p_m = limb.from_m + axis * t + normal * limb.radius_m;
            let hidden = tree.trunk.iter().any(|v| v.signed_distance_m(p_m) < -2e-3);
            if hidden || p_m.z < 0.004 {
                continue;
            }
            let (albedo, _) = bark(tree.species, tree.key ^ 0x4d, normal, limb.radius_m, t);
            let albedo = moss(tree.key, light, p_m, normal, albedo, rng);
            canvas.add(Patch {
                center_m: p_m - normal * 0.004,
                normal,
                along,
                sigma_m: DVec3::new(0.75 * spacing_m, 0.55 * spacing_m, 0.004),
                opacity: 0.96,
                radiance: light.matt(p_m, normal, albedo) * rng.range(0.8, 1.15),
            });
        }
    }
}

fn paint_branch(canvas: &mut Canvas, rng: &mut Rng, tree: &Tree, branch: &Limb, light: &Light) {
    let axis = branch.to_m - branch.from_m;
    let length_m = axis.length();
    let pieces = if tree.within { (length_m / 0.28).ceil() } else { (length_m / 1.3).ceil() };
    for n in 0..pieces as usize {
        let t = (n as f64 + 0.5) / pieces;
        let p_m = branch.from_m + axis * t;
        let radius_m = branch.radius_m * (1.1 - 0.75 * t);
        let (albedo, _) = bark(tree.species, tree.key ^ 0x63, DVec3::X, 0.1, t * 3.0);
        let sun = light.sunlight(p_m);
        let radiance =
            albedo * 0.7 * (light.ambient(DVec3::Z * 0.2) + super::light::SUN * (0.35 * sun));
        canvas.add(Patch {
            center_m: p_m + rng.direction() * 0.01,
            normal: rng.direction(),
            along: axis,
            sigma_m: DVec3::new(length_m / pieces * 0.55, radius_m * 0.62, radius_m * 0.62),
            opacity: 0.97,
            radiance,
        });
    }
}

fn paint_log(canvas: &mut Canvas, rng: &mut Rng, log: &Limb, light: &Light) {
    let axis = log.to_m - log.from_m;
    let length_m = axis.length();
    let along = axis / length_m;
    let side = along.cross(DVec3::Z).normalize_or(DVec3::X);
    let other = side.cross(along);
    let key = (length_m * 1e6) as u64;
    // The cylinder and both round ends.
    let (across_m, step_m) = (0.04, 0.075);
    let columns = (TAU * log.radius_m / across_m).ceil() as usize;
    let end = log.radius_m;
    let rows = ((length_m + 2.0 * end) / step_m).ceil() as usize;
    for row in 0..rows {
        for column in 0..columns {
            let s_m = (row as f64 + rng.unit()) * step_m - end;
            let turn = polar(TAU * (column as f64 + rng.unit()) / columns as f64);
            let around = side * turn.x + other * turn.y;
            let over = if s_m < 0.0 { s_m } else { (s_m - length_m).max(0.0) };
            let normal = (around * (end * end - over * over).max(0.0).sqrt() + along * over) / end;
            let p_m = log.from_m + along * s_m.clamp(0.0, length_m) + normal * end;
            if p_m.z < 0.01 {
                continue;
            }
            let crack = fractal2(key, DVec2::new(s_m / 0.35, 4.0 * turn.x + turn.y), 3);
            let albedo = paint(0x3b2f25).lerp(paint(0x8d7a63), smoothstep(0.3, 0.7, crack));
            let cover = smoothstep(0.35, 0.75, normal.z * 0.7 + 0.6 * noise(key, p_m / 0.2) - 0.1);
            let green = paint(0x4a5c20).lerp(paint(0x839038), rng.unit());
            canvas.add(Patch {
                center_m: p_m - normal * 0.004,
                normal,
                along,
                sigma_m: DVec3::new(0.62 * step_m, 0.6 * across_m, 0.004),
                opacity: 0.97,
                radiance: light.matt(p_m, normal, albedo.lerp(green, 0.8 * cover))
                    * rng.range(0.8, 1.2),
            });
        }
    }
}

/// Strokes per square metre of bark, from the budget of splats and about thirty near trees.
const STROKES_PER_M2: f64 = 130.0;
/// Maximum height of strokes. [m, world]
const STROKES_TOP_M: f64 = 3.0;
