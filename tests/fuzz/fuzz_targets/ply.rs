//! Untrusted splat PLY: an error or splats valid for a renderer; bounded memory.
#![no_main]
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(loaded) = vizflyt_splat::ply::parse(bytes) {
        let splats = &loaded.splats;
        let n = splats.len();
        assert!(n <= bytes.len());
        assert_eq!(splats.sh.len(), n * 3 * splats.sh_coefficients());
        assert!(splats.means_m.iter().all(|mean| mean.is_finite()));
        assert!(splats.scales_m.iter().all(|scale| scale.is_finite()));
        assert!(splats.rotations.iter().all(|q| (q.length() - 1.0).abs() < 1e-3));
        assert!(splats.opacities.iter().all(|opacity| (0.0..=1.0).contains(opacity)));
        assert!(splats.sh.iter().all(|value| value.is_finite()));
    }
});
