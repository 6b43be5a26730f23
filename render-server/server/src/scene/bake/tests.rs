use std::fs;
use std::sync::Mutex;

use glam::{DVec3, Quat, Vec3};
use vizflyt_arena::grid::Grid;

use super::*;

/// A post of small splats, 1 m high, at x = 1 m.
fn scene(opacity: f32) -> (Splats, BakeSpec) {
    let n = 200;
    let splats = Splats {
        means_m: (0..n).map(|k| Vec3::new(1.0, 1.0, k as f32 * 0.005)).collect(),
        scales_m: vec![Vec3::splat(0.05); n],
        rotations: vec![Quat::IDENTITY; n],
        opacities: vec![opacity; n],
        sh_degree: 0,
        sh: vec![0.5; 3 * n],
        antialiased: false,
    };
    let grid = Grid::covering(DVec3::ZERO, DVec3::splat(2.0), 0.05);
    (splats, BakeSpec { grid, min_opacity: 0.3, floor_z_m: 0.0, min_splats_per_m3: 30.0 })
}

#[test]
fn a_bake_is_cached_by_its_inputs_and_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let cache = BakeCache::at(folder.path().join("a/b"));
    let (splats, spec) = scene(0.9);
    let reported = Mutex::new(Vec::new());
    let first = bake_with(&splats, &spec, None, Some(&cache), &|share| {
        reported.lock().unwrap().push(share);
    });
    assert!(first.counts.unwrap().occupied > 0);
    assert!(first.field.obstacle_distance_m(DVec3::new(1.0, 1.0, 0.5)) < 0.0);
    let mut reported = reported.into_inner().unwrap();
    assert_eq!(reported.last(), Some(&1.0));
    reported.sort_by(f64::total_cmp);
    assert!(reported.len() > 3 && reported[0] >= 0.0, "{reported:?}");

    let again = bake_with(&splats, &spec, None, Some(&cache), &|_| ());
    assert_eq!((again.counts, &again.field), (None, &first.field));
    assert_eq!(again.kept_at, first.kept_at);
    // Another scene, and other settings, are other files.
    let (fainter, _) = scene(0.8);
    assert_ne!(BakeKey::of(&fainter, &spec, None), BakeKey::of(&splats, &spec, None));
    let coarse = BakeSpec { min_opacity: 0.4, ..spec };
    assert_ne!(BakeKey::of(&splats, &coarse, None), BakeKey::of(&splats, &spec, None));
    assert!(bake_with(&splats, &coarse, None, Some(&cache), &|_| ()).counts.is_some());
    let names = fs::read_dir(folder.path().join("a/b")).unwrap();
    assert!(
        names.map(|entry| entry.unwrap().path()).all(|path| path.extension().unwrap() == "field")
    );
}

#[test]
fn damaged_cache_file_is_baked_again() {
    let folder = tempfile::tempdir().unwrap();
    let cache = BakeCache::at(folder.path());
    let (splats, spec) = scene(0.9);
    let first = bake_with(&splats, &spec, None, Some(&cache), &|_| ());
    let path = first.kept_at.unwrap();
    let good = fs::read(&path).unwrap();
    let mut flipped = good.clone();
    flipped[good.len() / 2] ^= 1;
    for bad in [&good[..good.len() - 1], &good[..20], &[], &flipped, &[0; 200]] {
        fs::write(&path, bad).unwrap();
        let again = bake_with(&splats, &spec, None, Some(&cache), &|_| ());
        assert!(again.counts.is_some(), "baked, not read");
        assert_eq!(again.field, first.field);
        assert_eq!(fs::read(&path).unwrap(), good, "and mended");
    }
}

#[test]
fn bakes_without_a_usable_cache() {
    let (splats, spec) = scene(0.9);
    let bare = bake_with(&splats, &spec, None, None, &|_| ());
    assert!(bare.kept_at.is_none() && bare.counts.is_some());
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("file"), "in the way").unwrap();
    let cache = BakeCache::at(folder.path().join("file/below"));
    let baked = bake_with(&splats, &spec, None, Some(&cache), &|_| ());
    assert_eq!((baked.kept_at, &baked.field), (None, &bare.field));
}
