//! Properties of boards: free of obstacles, visible from the walk, and rendered at their true positions.

use vizflyt_splat::{CpuRenderer, Rasterizer, RgbdImage, Scene};

use super::*;
use crate::film::{Film, Phone};
use crate::{SceneKind, film_set, generate};

#[test]
fn boards_touch_nothing_and_leave_the_course_free() {
    for kind in SceneKind::ALL {
        for seed in [3, 8] {
            let set = film_set(kind, seed, 50.0, true).unwrap();
            let plain = generate(kind, seed);
            assert!(set.prints.len() >= 8, "{kind} {seed}: {} boards", set.prints.len());
            // All previous solids are still there; boards follow after them.
            let (before, boards) = set.scene.truth.split_at(plain.truth.len());
            assert_eq!(before, plain.truth);
            assert_eq!(set.scene.splats.sh_degree, 0);
            assert!(set.scene.splats.len() > plain.splats.len());
            let standing = boards.len() - set.prints.len();
            assert!(standing <= set.prints.len());
            for (n, print) in set.prints.iter().enumerate() {
                let pose = print.world_from_print;
                let half = print.side_m / 2.0;
                for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (0.0, 0.0)] {
                    // In front of the sheet, and inside of the board.
                    for z in [0.05, -0.5 * THICK_M] {
                        let p_m = pose.transform_point(DVec3::new(x * half, y * half, z));
                        let free = before.iter().map(|volume| volume.signed_distance_m(p_m));
                        let free_m = free.fold(f64::MAX, f64::min);
                        assert!(free_m > 0.005, "{kind} {seed}: board {n}, {free_m} m at {p_m}");
                    }
                }
                for other in &set.prints[n + 1..] {
                    let apart = other.world_from_print.translation_m - pose.translation_m;
                    assert!(apart.length() > APART_M, "{kind} {seed}");
                }
                let fence = set.scene.arena.geofence();
                if kind != SceneKind::Forest {
                    assert!(fence.signed_distance_m(pose.translation_m) > 0.0, "{kind} {seed}");
                }
            }
        }
    }
}

/// In pixels of a board, the rendered depth must be that of the board, so that neither net nor plants hide it.
#[test]
fn the_walk_sees_the_boards_at_their_true_positions() {
    for kind in [SceneKind::Room, SceneKind::Forest, SceneKind::Race] {
        let set = film_set(kind, 3, 50.0, true).unwrap();
        let film = Film::new(Phone::draw(kind, 3, 320, 240));
        let k = film.phone().intrinsics;
        let mut renderer =
            CpuRenderer::new(Scene { splats: &set.scene.splats, objects: &set.scene.objects });
        let placements = vec![None; set.scene.objects.len()];
        let solids = Solids::new(generate(kind, 3).truth);
        let mut seen = vec![0u32; set.prints.len()];
        let (mut alike, mut hidden) = (0u32, 0u32);
        for glimpse in sight::glimpses(&set.walk) {
            let of: Vec<usize> =
                (0..set.prints.len()).filter(|&n| glimpse.sees(&set.prints[n], &solids)).collect();
            if of.is_empty() {
                continue;
            }
            let world_from_cam = glimpse.world_from_cam;
            let camera = vizflyt_splat::Camera::new(k, world_from_cam, 0.05);
            let mut images = [RgbdImage::default()];
            renderer.render(&placements, &[camera], &mut images).unwrap();
            for n in of {
                seen[n] += 1;
                // Points within the black square, because edges are soft.
                for (x, y) in [(-0.6, -0.6), (0.6, -0.6), (0.6, 0.6), (-0.6, 0.6), (0.0, 0.0)] {
                    let half = set.prints[n].side_m / 2.0;
                    let p = DVec3::new(x * half, y * half, 0.0);
                    let p_m = set.prints[n].world_from_print.transform_point(p);
                    let p_cam = world_from_cam.inverse().transform_point(p_m);
                    let pixel = k.project(p_cam).unwrap();
                    let at = pixel.y as usize * 320 + pixel.x as usize;
                    let off_m = f64::from(images[0].depth_median_m[at]) - p_cam.z;
                    if off_m.abs() < 0.04 { alike += 1 } else { hidden += 1 }
                }
            }
        }
        assert!(seen.iter().all(|&count| count >= 2), "{kind}: {seen:?}");
        assert!(hidden * 12 < alike, "{kind}: {hidden} hidden, {alike} seen");
    }
}
