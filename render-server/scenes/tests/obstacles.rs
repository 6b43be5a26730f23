//! Obstacles baked from the splats of generated scenes against their true geometry, by size of
//! voxel: nothing missed beyond one voxel, hardly anything reported that is free by one and a half.

mod judge;

use judge::{FLOWN_M, Places, bake};
use vizflyt_scenes::{SceneKind, generate};

#[test]
fn no_obstacle_is_missed_beyond_a_voxel_and_few_are_made_up() {
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
