use glam::DQuat;
use proptest::prelude::*;

use super::*;

fn blob() -> impl Strategy<Value = Blob> {
    (
        prop::array::uniform3(-50.0..50.0f64),
        // Logarithms of the scales: 10 um to 7 m, which includes flat and thin splats.
        prop::array::uniform3(-11.0..2.0f64),
        prop::array::uniform4(-1.0..1.0f64),
        0.004..=1.0f64,
    )
        .prop_map(|(mean, log_scale, q, opacity)| {
            let q = DQuat::from_array(q);
            let q = if q.length() > 1e-3 { q.normalize() } else { DQuat::IDENTITY };
            let scale = DVec3::from(log_scale.map(f64::exp));
            let axes = DMat3::from_quat(q) * DMat3::from_diagonal(scale);
            Blob::new(mean.into(), axes, opacity)
        })
}

fn close(a: &DMat3, b: &DMat3) -> bool {
    let size = trace(a).max(trace(b));
    a.to_cols_array().iter().zip(b.to_cols_array()).all(|(a, b)| (a - b).abs() <= 1e-6 * size)
}

/// Computes mean and second moment about a point of the mixture from the definition.
fn moments(blobs: &[Blob], about: DVec3, blur_m2: f64) -> (DVec3, DMat3) {
    let total: f64 = blobs.iter().map(|blob| blob.mass(blur_m2)).sum();
    let mut mean = DVec3::ZERO;
    let mut second = DMat3::ZERO;
    for blob in blobs {
        let weight = blob.mass(blur_m2) / total;
        mean += blob.mean_m * weight;
        let d = blob.mean_m - about;
        second += (blob.covariance_m2 + DMat3::from_cols(d * d.x, d * d.y, d * d.z)) * weight;
    }
    (mean, second)
}

proptest! {
    #[test]
    fn merging_keeps_mean_and_covariance_of_the_mixture(
        blobs in prop::collection::vec(blob(), 1..12), blur_m2 in 0.0..0.1f64,
    ) {
        let merged = merge(blobs.iter().copied(), blur_m2);
        let (mean, covariance) = moments(&blobs, merged.mean_m, blur_m2);
        prop_assert!(merged.mean_m.distance(mean) < 1e-9 * 100.0);
        prop_assert!(close(&merged.covariance_m2, &covariance));
        // Covered areas add up, and so do counts.
        let mass: f64 = blobs.iter().map(|blob| blob.mass(blur_m2)).sum();
        prop_assert!((merged.mass(blur_m2) / mass - 1.0).abs() < 1e-5);
        prop_assert_eq!(merged.origin.count, blobs.len() as f32);
    }

    /// Merging level by level gives the same result as merging all at once.
    #[test]
    fn merging_in_two_steps_equals_merging_in_one(
        blobs in prop::collection::vec(blob(), 4..12), blur_m2 in 0.0..0.1f64,
    ) {
        let once = merge(blobs.iter().copied(), blur_m2);
        let halves = [&blobs[..2], &blobs[2..]].map(|half| merge(half.iter().copied(), blur_m2));
        let twice = merge(halves.into_iter(), blur_m2);
        prop_assert!(once.mean_m.distance(twice.mean_m) < 1e-4);
        let size = trace(&once.covariance_m2);
        let off = (once.covariance_m2 - twice.covariance_m2).to_cols_array();
        prop_assert!(off.iter().all(|v| v.abs() < 1e-4 * size + 1e-6));
        let (a, b) = (once.origin.spread_m2, twice.origin.spread_m2);
        prop_assert!((a - b).abs() < 1e-4 * a + 1e-6, "{} and {}", a, b);
    }

    #[test]
    fn one_splat_is_unchanged(blob in blob(), blur_m2 in 0.0..0.1f64) {
        let merged = merge([blob].into_iter(), blur_m2);
        let (covariance, opacity) = merged.rendered(blur_m2);
        prop_assert!(close(&covariance, &blob.covariance_m2));
        prop_assert!((opacity - f64::from(blob.origin.opacity)).abs() < 1e-5);
        prop_assert_eq!(merged.error_m2(), 0.0);
    }

    #[test]
    fn merged_splats_are_at_most_opaque_and_cover_no_more_than_their_parts(
        blobs in prop::collection::vec(blob(), 2..40), blur_m2 in 1e-6..0.1f64,
    ) {
        let merged = merge(blobs.iter().copied(), blur_m2);
        let (covariance, opacity) = merged.rendered(blur_m2);
        prop_assert!((0.0..=1.0).contains(&opacity));
        let covers = opacity * (area(&covariance) + blur_m2);
        prop_assert!(covers <= merged.mass(blur_m2) * (1.0 + 1e-6));
        prop_assert!(trace(&covariance) >= trace(&merged.covariance_m2) * (1.0 - 1e-9));
        prop_assert!(merged.error_m2() > 0.0);
    }

    #[test]
    fn square_root_times_its_transpose_is_the_covariance(blob in blob()) {
        let root = square_root(&blob.covariance_m2);
        prop_assert!(close(&(root * root.transpose()), &blob.covariance_m2));
    }
}

#[test]
fn area_is_the_mean_projected_area() {
    let of = |x: f64, y: f64, z: f64| area(&DMat3::from_diagonal(DVec3::new(x, y, z)));
    assert!((of(4.0, 4.0, 4.0) - 4.0).abs() < 1e-12);
    // A disc: its own area from the front, 0 from the side.
    assert!((of(9.0, 9.0, 0.0) - 9.0 / 3f64.sqrt()).abs() < 1e-12);
    assert_eq!(of(5.0, 0.0, 0.0), 0.0);
    assert_eq!(of(0.0, 0.0, 0.0), 0.0);
}

#[test]
fn two_distant_splats_cover_no_more_than_two() {
    // 22 m apart, with deviations of 0.3 mm, seen at a distance at which a pixel is 30 cm.
    let points =
        [0.0, 22.0].map(|z| Blob::new(DVec3::new(0.0, 0.0, z), DMat3::IDENTITY * 3e-4, 0.7));
    let merged = merge(points.into_iter(), 0.09);
    let (covariance, opacity) = merged.rendered(0.09);
    assert_eq!(opacity, 1.0);
    assert!(area(&covariance) + 0.09 <= merged.mass(0.09) * (1.0 + 1e-9));
}

#[test]
fn thickness_gives_the_requested_area() {
    for diagonal in [[1.0, 1.0, 1.0], [100.0, 1e-9, 1e-9], [4.0, 9.0, 0.0]] {
        let covariance = DMat3::from_diagonal(diagonal.into());
        for wanted in [5.0, 70.0] {
            let side = DMat3::from_diagonal(DVec3::splat(thickness(&covariance, wanted)));
            let got = area(&(covariance + side));
            assert!((got / wanted.max(area(&covariance)) - 1.0).abs() < 1e-12, "{got} {wanted}");
        }
    }
}

#[test]
fn overlapping_splats_cover_less_than_their_sum() {
    assert!((covered(0.7, 1.0) - 0.7).abs() < 1e-12);
    // Two of opacity 1/2 at the same place: 1/2 + (1 - 1/4) / 2 of a Gaussian.
    assert!((covered(1.0, 2.0) - 0.875).abs() < 1e-12);
    // Very small opacities add up; many splats approach the exponential integral Ein(2) = 1.3193.
    assert!((covered(1e-6, 9.0) / 1e-6 - 1.0).abs() < 1e-5);
    assert!((covered(2.0, 1e9) - 1.3193).abs() < 0.02);
    assert_eq!(covered(0.0, 5.0), 0.0);
}

#[test]
fn flat_covariance_has_a_square_root() {
    for diagonal in
        [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0], [0.0; 3], [1e12, 1e-12, 0.0]]
    {
        let covariance = DMat3::from_diagonal(diagonal.into());
        let root = square_root(&covariance);
        assert!(close(&(root * root.transpose()), &covariance), "{diagonal:?}");
    }
}
