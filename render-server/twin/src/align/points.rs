//! Alignment by points with known positions in both frames.
//!
//! The rotation is the unit quaternion that is the eigenvector of a 4 x 4 matrix with the largest eigenvalue (B. Horn,
//! "Closed-form solution of absolute orientation using unit quaternions", JOSA A 4(4), 1987). The scale minimises the
//! squared error in the world (S. Umeyama, "Least-squares estimation of transformation parameters between two point
//! patterns", PAMI 13(4), 1991).

use glam::{DMat3, DQuat, DVec3};

use super::eigen::symmetric;
use super::{AlignError, Fit, Similarity};
use crate::random::Random;

/// A point in both frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Position in the scene.
    pub scene: DVec3,
    /// Position in the world. [m, world]
    pub world_m: DVec3,
}

/// Aligns a scene by at least three pairs with a claimed accuracy of `sigma_m` in the world. Sigmas of the result use
/// the actual residuals if those are larger. Pairs that contradict the others are rejected.
///
/// # Errors
/// Too few pairs, pairs on one line, values that are not finite, or more contradicting than agreeing pairs.
pub fn fit(pairs: &[Pair], sigma_m: f64) -> Result<Fit, AlignError> {
    check(pairs, sigma_m)?;
    let mut similarity = closest(pairs)?;
    let fits = pairs.iter().all(|pair| distance_m(&similarity, pair) <= OUTLIER_SIGMAS * sigma_m);
    if !fits && pairs.len() >= NEEDED_TO_DOUBT {
        similarity = most_agreed(pairs).unwrap_or(similarity);
    }
    let mut used = Vec::new();
    for _ in 0..ROUNDS {
        let limit_m = OUTLIER_SIGMAS * spread_m(&similarity, pairs).max(sigma_m);
        let is_good = |pair: &&Pair| distance_m(&similarity, pair) <= limit_m;
        let next: Vec<Pair> = pairs.iter().filter(is_good).copied().collect();
        let left_out = pairs.len() - next.len();
        // Of five pairs, one may be wrong: the other four still agree with each other and contradict it.
        if next.len() * 2 <= pairs.len() || (left_out > 0 && pairs.len() < NEEDED_TO_DOUBT) {
            return Err(AlignError::Contradictory { left_out, given: pairs.len() });
        }
        if next == used {
            break;
        }
        similarity = closest(&next)?;
        used = next;
    }
    Ok(describe(&similarity, &used, pairs.len() - used.len(), sigma_m))
}

/// Returns the standard deviation per axis, estimated from the better half of the pairs. [m]
fn spread_m(similarity: &Similarity, pairs: &[Pair]) -> f64 {
    let mut off_m: Vec<f64> = pairs.iter().map(|pair| distance_m(similarity, pair)).collect();
    off_m.sort_by(f64::total_cmp);
    // The median length of a vector of three standard normal numbers is 1.54.
    off_m[off_m.len() / 2] / 1.54
}

/// Returns the alignment that half of the pairs fit best: the least median over alignments from three random pairs (P.
/// Rousseeuw, "Least median of squares regression", JASA 79, 1984).
fn most_agreed(pairs: &[Pair]) -> Option<Similarity> {
    let mut random = Random::new(pairs.len() as u64);
    let mut places = (0..TRIALS).filter_map(|_| {
        let three = std::array::from_fn::<_, 3, _>(|_| pairs[random.below(pairs.len())]);
        // A pair drawn twice counts as on one line.
        closest(&three).ok()
    });
    let first = places.next()?;
    let spread_of = |place: Similarity| (spread_m(&place, pairs), place);
    let best = places
        .map(spread_of)
        .fold(spread_of(first), |best, next| if next.0 < best.0 { next } else { best });
    Some(best.1)
}

/// Aligns like [`fit`], without rejecting pairs: for searches.
pub(super) fn fit_all(pairs: &[Pair], sigma_m: f64) -> Result<Fit, AlignError> {
    check(pairs, sigma_m)?;
    Ok(describe(&closest(pairs)?, pairs, 0, sigma_m))
}

fn check(pairs: &[Pair], sigma_m: f64) -> Result<(), AlignError> {
    if !(sigma_m > 0.0 && sigma_m.is_finite()) {
        return Err(AlignError::BadNumber("the points' accuracy"));
    }
    if pairs.iter().any(|pair| !(pair.scene.is_finite() && pair.world_m.is_finite())) {
        return Err(AlignError::BadNumber("a point's coordinate"));
    }
    Ok(())
}

fn distance_m(similarity: &Similarity, pair: &Pair) -> f64 {
    similarity.transform_point(pair.scene).distance(pair.world_m)
}

/// Returns the least-squares similarity transform of all pairs.
///
/// # Errors
/// Too few pairs, or pairs on one line.
pub fn closest(pairs: &[Pair]) -> Result<Similarity, AlignError> {
    if pairs.len() < NEEDED {
        return Err(AlignError::TooFew { given: pairs.len(), needed: NEEDED });
    }
    let count = pairs.len() as f64;
    let from = pairs.iter().map(|pair| pair.scene).sum::<DVec3>() / count;
    let to = pairs.iter().map(|pair| pair.world_m).sum::<DVec3>() / count;
    check_spread(pairs.iter().map(|pair| pair.scene - from))?;
    check_spread(pairs.iter().map(|pair| pair.world_m - to))?;
    // m.col(k) is the sum of scene position times the world's component k.
    let mut m = DMat3::ZERO;
    let mut scene2 = 0.0;
    for pair in pairs {
        let (x, y) = (pair.scene - from, pair.world_m - to);
        m += DMat3::from_cols(x * y.x, x * y.y, x * y.z);
        scene2 += x.length_squared();
    }
    let s = |row: usize, column: usize| m.col(column)[row];
    let (yz, zx, xy) = (s(1, 2) - s(2, 1), s(2, 0) - s(0, 2), s(0, 1) - s(1, 0));
    let horn = [
        [s(0, 0) + s(1, 1) + s(2, 2), yz, zx, xy],
        [yz, s(0, 0) - s(1, 1) - s(2, 2), s(0, 1) + s(1, 0), s(2, 0) + s(0, 2)],
        [zx, s(0, 1) + s(1, 0), s(1, 1) - s(0, 0) - s(2, 2), s(1, 2) + s(2, 1)],
        [xy, s(2, 0) + s(0, 2), s(1, 2) + s(2, 1), s(2, 2) - s(0, 0) - s(1, 1)],
    ];
    let [.., (greatest, [w, x, y, z])] = symmetric(horn);
    let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
    let scale = greatest / scene2;
    Ok(Similarity { scale, rotation, translation_m: to - rotation * from * scale })
}

/// Rejects points on a line, about which the scene could rotate.
fn check_spread(centred: impl Iterator<Item = DVec3>) -> Result<(), AlignError> {
    let mut scatter = [[0.0; 3]; 3];
    for p in centred {
        for (row, value) in scatter.iter_mut().enumerate() {
            for (column, sum) in value.iter_mut().enumerate() {
                *sum += p[row] * p[column];
            }
        }
    }
    let [_, (second, _), (first, _)] = symmetric(scatter);
    if second > (LINE_SHARE * LINE_SHARE) * first { Ok(()) } else { Err(AlignError::OnOneLine) }
}

fn describe(similarity: &Similarity, used: &[Pair], left_out: usize, sigma_m: f64) -> Fit {
    let count = used.len() as f64;
    let middle_m = used.iter().map(|pair| pair.world_m).sum::<DVec3>() / count;
    let off_m: Vec<f64> = used.iter().map(|pair| distance_m(similarity, pair)).collect();
    let squares: f64 = off_m.iter().map(|off_m| off_m * off_m).sum();
    // Seven parameters are fitted.
    let found_m = (squares / (3.0 * count - 7.0)).sqrt();
    let sigma_m = sigma_m.max(found_m);
    // Information about a small rotation, from how it moves the points.
    let mut information = DMat3::ZERO;
    let mut reach2 = 0.0;
    for pair in used {
        let y = similarity.transform_point(pair.scene) - middle_m;
        let outer = DMat3::from_cols(y * y.x, y * y.y, y * y.z);
        information += DMat3::from_diagonal(DVec3::splat(y.length_squared())) - outer;
        reach2 += y.length_squared();
    }
    let turn = information.inverse() * sigma_m.powi(2);
    let (a, b, c) = (turn.x_axis.x, turn.x_axis.y, turn.y_axis.y);
    let worse = 0.5 * (a + c) + (0.25 * (a - c).powi(2) + b * b).sqrt();
    Fit {
        world_from_scene: *similarity,
        rms_m: (squares / count).sqrt(),
        worst_m: off_m.iter().copied().fold(0.0, f64::max),
        used: used.len(),
        left_out,
        scale_sigma: sigma_m / reach2.sqrt(),
        tilt_sigma_rad: worse.sqrt(),
        yaw_sigma_rad: turn.z_axis.z.sqrt(),
        place_sigma_m: sigma_m / count.sqrt(),
        middle_m,
    }
}

/// A similarity transform needs three points.
const NEEDED: usize = 3;
/// Maximum residual in sigmas, over all axes together: it rejects one in 10,000 good pairs.
const OUTLIER_SIGMAS: f64 = 4.6;
const ROUNDS: usize = 8;
/// Minimum number of pairs to identify a wrong one.
const NEEDED_TO_DOUBT: usize = 5;
/// With a third of the pairs wrong, the probability that every trial contains a wrong pair is 10^-46.
const TRIALS: usize = 300;
/// Points are on one line if the second extent is less than this fraction of the first.
const LINE_SHARE: f64 = 0.02;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::tests_support::{gauss, similarity, spread};
    use proptest::prelude::*;

    fn pairs(truth: &Similarity, scene: &[DVec3]) -> Vec<Pair> {
        let pair = |&scene: &DVec3| Pair { scene, world_m: truth.transform_point(scene) };
        scene.iter().map(pair).collect()
    }

    proptest! {
        #[test]
        fn exact_points_give_the_exact_alignment(truth in similarity(), scene in spread(3..20)) {
            prop_assume!(closest(&pairs(&truth, &scene)).is_ok());
            let fit = fit(&pairs(&truth, &scene), 1e-3).unwrap();
            for p in scene {
                let off_m = fit.world_from_scene.transform_point(p) - truth.transform_point(p);
                prop_assert!(off_m.length() < 1e-7 * truth.scale.max(1.0), "{off_m}");
            }
            prop_assert!((fit.world_from_scene.scale / truth.scale - 1.0).abs() < 1e-9);
        }

        #[test]
        fn rejects_a_wrong_pair(
            truth in similarity(), scene in spread(8..20), wrong in 0usize..8, off in 1.0..4.0f64
        ) {
            let mut pairs = pairs(&truth, &scene);
            pairs[wrong].world_m += DVec3::new(off, -off, 0.5 * off);
            let fit = fit(&pairs, 0.02).unwrap();
            prop_assert_eq!(fit.left_out, 1);
            prop_assert!(fit.rms_m < 1e-6);
        }
    }

    const ROOMS: usize = 500;

    #[test]
    fn sigmas_match_the_actual_errors() {
        // 500 rooms with points off by 1 cm: the squared error in sigmas has a mean of 1.
        let (mut tilt2, mut scale2, mut yaw2, mut outside) = (0.0, 0.0, 0.0, 0);
        let mut random = Random::new(5);
        for _ in 0..ROOMS {
            let truth = Similarity {
                scale: 0.3,
                rotation: DQuat::from_scaled_axis(gauss(&mut random)),
                translation_m: gauss(&mut random),
            };
            let scene: Vec<DVec3> = (0..12).map(|_| gauss(&mut random) * 8.0).collect();
            let mut pairs = pairs(&truth, &scene);
            for pair in &mut pairs {
                pair.world_m += gauss(&mut random) * 0.01;
            }
            let fit = fit(&pairs, 0.001).unwrap();
            let found = fit.world_from_scene;
            let turn = found.rotation * truth.rotation.conjugate();
            let turn = 2.0 * turn.xyz() * turn.w.signum();
            // The sigma is that of the worse of two directions: compare with both.
            tilt2 += 0.5 * (turn.x.powi(2) + turn.y.powi(2)) / fit.tilt_sigma_rad.powi(2);
            yaw2 += (turn.z / fit.yaw_sigma_rad).powi(2);
            scale2 += ((found.scale / truth.scale - 1.0) / fit.scale_sigma).powi(2);
            let corner = gauss(&mut random) * 3.0;
            let p = truth.rotation.conjugate() * (corner - truth.translation_m) / truth.scale;
            outside += usize::from(found.transform_point(p).distance(corner) > fit.bound_m(corner));
        }
        let mean = |sum: f64| sum / ROOMS as f64;
        let means = (mean(tilt2), mean(yaw2), mean(scale2));
        assert!((0.5..1.4).contains(&means.0), "{means:?}");
        assert!((0.7..1.5).contains(&means.1), "{means:?}");
        assert!((0.7..1.5).contains(&means.2), "{means:?}");
        assert!(outside <= ROOMS / 50, "{outside} of {ROOMS} outside three sigmas");
    }

    #[test]
    fn rejects_undetermined_alignments() {
        let line: Vec<DVec3> = (0..9).map(|k| DVec3::new(f64::from(k), 0.0, 0.0)).collect();
        let still =
            Similarity { scale: 1.0, rotation: DQuat::IDENTITY, translation_m: DVec3::ZERO };
        assert_eq!(fit(&pairs(&still, &line), 0.01), Err(AlignError::OnOneLine));
        let two = AlignError::TooFew { given: 2, needed: 3 };
        assert_eq!(fit(&pairs(&still, &line[..2]), 0.01), Err(two));
        let nan = [Pair { scene: DVec3::NAN, world_m: DVec3::ZERO }; 4];
        assert!(matches!(fit(&nan, 0.01), Err(AlignError::BadNumber(_))));
    }
}
