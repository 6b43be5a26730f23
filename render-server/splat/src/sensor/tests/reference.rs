//! Plain reference for one ray: every splat in f64, sorted, blended. The tree and its kernels are
//! compared with it.

use glam::{DMat3, DVec3};

use super::*;
use crate::limits::ALPHA_MAX;
use crate::sensor::cast::{Beam, Hits, echoes};
use crate::sensor::tree;

/// Returns (range, alpha) of every splat that a beam meets before it ends, nearest first.
fn hits(splats: &Splats, beam: &Beam) -> Vec<(f64, f64)> {
    let d = beam.direction;
    let mut hits = Vec::new();
    for i in crate::blocks::order(splats) {
        let i = i as usize;
        let rotation = DMat3::from_quat(splats.rotations[i].as_dquat().normalize());
        let from = beam.origin_m - splats.means_m[i].as_dvec3();
        let blur = (from.dot(d) * f64::from(beam.spread)).powi(2);
        let of = |add: f64| {
            let variance =
                tree::clamped(splats.scales_m[i]).as_dvec3().powf(2.0) + DVec3::splat(add);
            rotation * DMat3::from_diagonal(variance) * rotation.transpose()
        };
        let (thin, wide) = (of(0.0), of(blur));
        let weight = wide.inverse();
        let range = -from.dot(weight * d) / d.dot(weight * d);
        let p = from + d * range;
        // The projection across the ray: a 2x2 determinant in any two directions orthogonal to it.
        let (u, v) = d.any_orthonormal_pair();
        let area = |m: DMat3| u.dot(m * u) * v.dot(m * v) - u.dot(m * v).powi(2);
        let dimmed = (area(thin) / area(wide)).sqrt();
        let seen = f64::from(splats.opacities[i]) * (-0.5 * p.dot(weight * p)).exp();
        if range > 0.0 && range < f64::from(beam.max_m) && seen > f64::from(tree::LEAST_ALPHA) {
            hits.push((range, (seen * dimmed).min(ALPHA_MAX)));
        }
    }
    hits.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut left = 1.0;
    let end = hits.iter().position(|(_, alpha)| {
        left *= 1.0 - alpha;
        left < 0.25
    });
    hits.truncate(end.map_or(hits.len(), |end| end + 1));
    hits
}

#[test]
fn hits_match_the_plain_reference() {
    let mut splats = Splats::default();
    let mut draws = Draws::new(11, 0, 0);
    for _ in 0..3000 {
        let mut uniform = |from: f32, to: f32| from + (to - from) * draws.uniform();
        splats.means_m.push(Vec3::new(uniform(-6.0, 6.0), uniform(-6.0, 6.0), uniform(-2.0, 2.0)));
        splats.scales_m.push(Vec3::new(
            uniform(0.01, 0.3),
            uniform(0.01, 0.3),
            uniform(0.002, 0.05),
        ));
        let turn = [uniform(-1.0, 1.0), uniform(-1.0, 1.0), uniform(-1.0, 1.0), uniform(0.1, 1.0)];
        splats.rotations.push(Quat::from_array(turn).normalize());
        splats.opacities.push(uniform(0.05, 0.99));
        splats.sh.extend([0.5; 3]);
    }
    for set in InstructionSet::available().into_iter().filter(|set| set.lanes() == tree::WIDTH) {
        let scene = SensorScene::with_instructions(Scene::from(&splats), set);
        let motion = SensorMotion::standing(at(DVec3::ZERO, 0.0));
        let (mut compared, mut sum_off) = (0, 0.0);
        for n in 0..400 {
            let turn = DQuat::from_rotation_z(0.05 * f64::from(n))
                * DQuat::from_rotation_y(0.3 * f64::from(n % 5) - 0.6);
            let beam = Beam {
                origin_m: DVec3::new(0.1, -0.2, 0.05),
                direction: turn * DVec3::X,
                spread: [0.0, 0.001, 0.01][n as usize % 3],
                max_m: 20.0,
            };
            let truth = hits(&splats, &beam);
            let mut met = Hits::new();
            scene.cast(&motion, &[(0.0, beam)], std::slice::from_mut(&mut met));
            let met = met.weigh();
            // Compared up to the end of the shorter one: beyond, rounding decides how much light is
            // left.
            let ends_m = [truth.last().map(|h| h.0), met.last().map(|h| f64::from(h.range_m))];
            let end_m = ends_m.map(|m| m.unwrap_or(f64::MAX)).into_iter().fold(f64::MAX, f64::min);
            let (mut left, mut expected) = (1.0, (0.0, 0.0));
            for (range, alpha) in truth.iter().filter(|(range, _)| *range < end_m - 2e-3) {
                expected = (expected.0 + alpha * left, expected.1 + range * alpha * left);
                left *= 1.0 - alpha;
            }
            let before = met.iter().filter(|hit| f64::from(hit.range_m) < end_m - 2e-3);
            let found = before.fold((0.0, 0.0), |sum, hit| {
                (sum.0 + f64::from(hit.weight), sum.1 + f64::from(hit.weight * hit.range_m))
            });
            // Tolerance for half precision, the footprint outside a splat's box, and splats near
            // the minimum alpha.
            let off = (found.0 - expected.0).abs();
            assert!(off < 0.1, "{} {n}: {found:?} {expected:?}", set.name());
            assert!(
                (found.1 - expected.1).abs() < 0.5,
                "{} {n}: {found:?} {expected:?}",
                set.name()
            );
            sum_off += off;
            compared += usize::from(expected.0 > 0.2);
            let weight: f64 = met.iter().map(|h| f64::from(h.weight)).sum();
            assert!(met.windows(2).all(|w| w[0].range_m <= w[1].range_m));
            let mut total = 0.0;
            echoes(met, 0.3, |echo| total += echo.weight);
            assert!((f64::from(total) - weight).abs() < 1e-4);
        }
        assert!(compared > 100 && sum_off / 400.0 < 0.004, "{}: {compared}, {sum_off}", set.name());
    }
}

#[test]
fn grouped_beams_have_the_same_hits_as_single_beams() {
    let mut splats = wall(Vec3::new(4.0, 0.3, 0.0), Vec3::new(-1.0, 0.2, 0.1), 2.0, 0.07);
    // In front of it a board that ends some of the close beams, so that only the rest continue.
    let board = wall(Vec3::new(2.0, -0.25, 0.0), -Vec3::X, 0.09, 0.02);
    splats.means_m.extend(board.means_m);
    splats.scales_m.extend(board.scales_m);
    splats.rotations.extend(board.rotations);
    splats.opacities.extend(board.opacities);
    splats.sh.extend(board.sh);
    let scene = SensorScene::new(&splats);
    let motion = SensorMotion::standing(at(DVec3::ZERO, 0.0));
    // Eight close beams, and eight in all directions.
    for step_rad in [0.006, std::f64::consts::FRAC_PI_4] {
        let beams: Vec<(f64, Beam)> = (0..8)
            .map(|n| {
                let turn = DQuat::from_rotation_z(step_rad * f64::from(n) - 0.1);
                let origin_m = DVec3::Y * (0.01 * f64::from(n));
                let (direction, spread, max_m) = (turn * DVec3::X, 0.001, 50.0);
                (0.0, Beam { origin_m, direction, spread, max_m })
            })
            .collect();
        let mut together = [Hits::new(); 8];
        scene.cast(&motion, &beams, &mut together);
        let (mut met, mut near, mut far) = (0, 0, 0);
        for (beam, together) in beams.iter().zip(&mut together) {
            let mut alone = Hits::new();
            scene.cast(&motion, std::slice::from_ref(beam), std::slice::from_mut(&mut alone));
            let ranges = |hits: &mut Hits| -> Vec<f32> {
                hits.weigh().iter().map(|hit| hit.range_m).collect()
            };
            let (together, alone) = (ranges(together), ranges(&mut alone));
            assert_eq!(together, alone);
            met += usize::from(!alone.is_empty());
            near += usize::from(alone.last().is_some_and(|&last_m| last_m < 3.0));
            far += usize::from(alone.last().is_some_and(|&last_m| last_m > 3.0));
        }
        assert!(met >= 1);
        assert!(step_rad > 0.1 || (near >= 2 && far >= 2), "{near} {far}");
    }
}
