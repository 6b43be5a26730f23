//! Checks for several targets.

use vizflyt_splat::format::{FormatError, Loaded};

/// Panics if a parsed scene is not valid for a renderer, or if it has more than `most` splats.
pub fn check_scene(result: Result<Loaded, FormatError>, most: usize) {
    let Ok(loaded) = result else { return };
    let splats = &loaded.splats;
    let n = splats.len();
    assert!(n <= most, "{n} splats of at most {most}");
    assert_eq!(splats.sh.len(), n * 3 * splats.sh_coefficients());
    assert!(splats.means_m.iter().all(|mean| mean.is_finite()));
    assert!(splats.scales_m.iter().all(|scale| scale.is_finite()));
    assert!(splats.rotations.iter().all(|q| (q.length() - 1.0).abs() < 1e-3));
    assert!(splats.opacities.iter().all(|opacity| (0.0..=1.0).contains(opacity)));
    assert!(splats.sh.iter().all(|value| value.is_finite()));
}
