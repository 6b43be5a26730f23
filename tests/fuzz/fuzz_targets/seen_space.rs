//! Untrusted file of seen space: an error, or valid and written as the same bytes.
#![no_main]
use glam::DVec3;
use libfuzzer_sys::fuzz_target;
use vizflyt_arena::SeenSpace;
use vizflyt_arena::config::SceneConfig;
use vizflyt_arena::seen::ScenePlace;

fuzz_target!(|bytes: &[u8]| {
    let Ok(space) = SeenSpace::from_bytes(bytes) else { return };
    assert_eq!(space.to_bytes(), bytes);
    let seen = space.at(&ScenePlace::of(&SceneConfig::in_world("scene.ply")));
    let grid = space.grid();
    assert!(space.seen_voxels() <= grid.voxels());
    for p_m in [grid.min_m, grid.max_m(), DVec3::ZERO, DVec3::splat(1e300), DVec3::splat(-1e9)] {
        seen.is_seen(p_m);
    }
    assert!(!seen.is_seen(DVec3::NAN));
});
