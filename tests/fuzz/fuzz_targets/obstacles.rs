//! Baked obstacles from an untrusted cache: an error or a valid field.
#![no_main]
use glam::DVec3;
use libfuzzer_sys::fuzz_target;
use vizflyt_arena::DistanceField;
use vizflyt_server::scene::parse_kept;

fuzz_target!(|bytes: &[u8]| {
    // With the checksum, and without it, because a fuzzer does not find hashes.
    let _ = parse_kept(bytes);
    let Ok(field) = DistanceField::from_bytes(bytes) else { return };
    let (header, codes, unseen) = field.as_bytes();
    assert_eq!([&header[..], codes, unseen].concat(), bytes);
    let grid = field.grid();
    for p_m in [grid.min_m, grid.max_m(), DVec3::ZERO, DVec3::splat(1e9), DVec3::splat(-1e300)] {
        assert!(field.distance_m(p_m).is_finite());
        assert!(field.obstacle_distance_m(p_m) <= field.max_distance_m() + 1e-9);
    }
    assert!(field.distance_m(DVec3::NAN).is_nan());
    field.is_unseen_nearest(DVec3::ZERO, 0.3);
    assert!(!field.is_unseen_nearest(DVec3::NAN, 0.3));
    let slice = field.obstacle_slice(0.5);
    assert_eq!((slice.columns, slice.rows), (grid.size[0], grid.size[1]));
});
