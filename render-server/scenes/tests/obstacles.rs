//! Compares obstacles baked from the splats of generated scenes with their true geometry, by voxel size: no miss beyond
//! one voxel, and at most 1 % false alarms beyond 1.5 voxels.

mod judge;

use judge::{FLOWN_M, Places, bake};
use vizflyt_scenes::{SceneKind, generate};

#[test]
fn misses_no_obstacle_beyond_a_voxel_with_few_false_alarms() {
    for (kind, seed) in [(SceneKind::Forest, 7), (SceneKind::Race, 7), (SceneKind::Race, 3)] {
        let scene = generate(kind, seed);
        let places = Places::draw(&scene, &FLOWN_M, 10_000, seed);
        for voxel_m in [0.05, 0.1] {
            let field = bake(&scene, voxel_m);
            let touches = |p| !(field.obstacle_distance_m(p) > judge::BODY_M);
            let score = places.judge(voxel_m, 1.5 * voxel_m, touches);
            println!("{kind} {seed}, {voxel_m} m: {score:?}");
            assert!(score.touching > 50 && score.clear > 1000, "{kind}: {score:?}");
            assert_eq!(score.missed, 0, "{kind} {seed}, {voxel_m} m: {score:?}");
            assert!(score.alarm_percent() <= 1.0, "{kind} {seed}, {voxel_m} m: {score:?}");
        }
    }
}
