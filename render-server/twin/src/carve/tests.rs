use glam::{DQuat, DVec3, Quat, Vec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};
use vizflyt_splat::Splats;

use super::*;
use crate::dataset::Photo;
use crate::loss::{SeenPoint, Target};
use crate::view::View;

const SIDE_M: f64 = 0.1;

/// Adds a disc with a radius of 0.1, facing z.
fn push(splats: &mut Splats, at: Vec3, opacity: f32) {
    splats.means_m.push(at);
    splats.scales_m.push(Vec3::new(0.1, 0.1, 0.005));
    splats.rotations.push(Quat::IDENTITY);
    splats.opacities.push(opacity);
    splats.sh.extend([0.5; 3]);
}

/// Returns a wall at z = 3, 4 wide and 3 high.
fn wall() -> Splats {
    let mut splats = Splats::default();
    for n in 0..41 * 31 {
        let (x, y) = ((n % 41) as f32 * 0.1 - 2.0, (n / 41) as f32 * 0.1 - 1.5);
        push(&mut splats, Vec3::new(x, y, 3.0), 0.95);
    }
    splats
}

/// Returns photos from a line along x at z = 0, looking along z.
fn dataset() -> Dataset {
    let intrinsics = Intrinsics::from_horizontal_fov(96, 72, 1.2);
    let photo = |n: usize| {
        let pose: Pose<World, Cam> =
            Pose::new(DVec3::new(0.15 * n as f64 - 0.6, 0.0, 0.0), DQuat::IDENTITY);
        let view = View::new(&intrinsics, &pose, 0.02);
        let rgb = vec![128; 3 * 96 * 72];
        let target = Target { width: 96, height: 72, rgb, ..Target::default() };
        Photo { name: n.to_string(), view, target }
    };
    Dataset { photos: (0..9).map(photo).collect(), ..Dataset::default() }
}

/// Returns a region from behind the cameras to behind the wall, in the frame of the photos.
fn region() -> Voxels {
    Voxels { min_m: DVec3::new(-1.5, -1.0, -0.5), side_m: SIDE_M, size: [30, 20, 45] }
}

const SAME: Similarity =
    Similarity { scale: 1.0, rotation: DQuat::IDENTITY, translation_m: DVec3::ZERO };

fn carved(splats: &Splats, dataset: &Dataset) -> Carved {
    carve(dataset, splats, &SAME, region(), &CarveOptions::default())
}

fn is_seen(seen: &Seen, p_m: DVec3) -> bool {
    let at = ((p_m - seen.voxels.min_m) / seen.voxels.side_m).floor();
    seen.is_seen([at.x as usize, at.y as usize, at.z as usize])
}

#[test]
fn space_in_front_of_a_wall_is_seen_and_behind_it_is_not() {
    let carved = carved(&wall(), &dataset());
    let seen = |x: f64, y: f64, z: f64| is_seen(&carved.seen, DVec3::new(x, y, z));
    assert!(seen(0.05, 0.05, 1.05) && seen(0.05, 0.05, 2.65) && seen(-1.05, 0.55, 2.55));
    assert!(!seen(0.05, 0.05, 3.15) && !seen(0.05, 0.05, 3.75), "behind the wall");
    assert!(!seen(0.05, 0.05, -0.35), "behind the camera");
    assert!(!seen(1.35, 0.95, 0.35), "outside the photos");
    assert!(seen(0.31, 0.01, 0.01) && seen(0.38, 0.01, -0.04), "where the camera was");
    assert_eq!((carved.counts.looked_through, carved.counts.on_path), (0, 0));
    assert_eq!(carved.counts.seen, carved.seen.count());
}

#[test]
fn prunes_faint_floaters_and_splats_on_the_path() {
    let mut splats = wall();
    let wall = splats.len();
    // It stops less than half of the light, so every photo looks through it.
    push(&mut splats, Vec3::new(0.0, 0.0, 1.5), 0.4);
    push(&mut splats, Vec3::new(0.3, 0.12, 0.0), 0.9);
    let carved = carved(&splats, &dataset());
    assert_eq!((carved.counts.looked_through, carved.counts.on_path), (1, 1));
    assert!(!carved.kept[wall] && !carved.kept[wall + 1]);
    let left = carved.kept.iter().filter(|kept| **kept).count();
    assert_eq!(left, carved.splats.len());
    assert!(left + carved.counts.hidden >= wall);
}

#[test]
fn prunes_splats_that_no_photo_shows() {
    let mut splats = wall();
    let wall = splats.len();
    push(&mut splats, Vec3::new(0.0, 0.0, 3.4), 0.9);
    let carved = carved(&splats, &dataset());
    assert!(!carved.kept[wall], "behind the wall");
    assert!(carved.kept[20 * 41..].iter().take(41).any(|kept| *kept), "the wall stays");
}

#[test]
fn opaque_obstacle_stays_and_hides_space_behind_it() {
    let mut splats = wall();
    let wall = splats.len();
    for n in 0..25 {
        let (x, y) = ((n % 5) as f32 * 0.1 - 0.2, (n / 5) as f32 * 0.1 - 0.2);
        push(&mut splats, Vec3::new(x, y, 1.0), 0.95);
    }
    let carved = carved(&splats, &dataset());
    assert!(carved.kept[wall..].iter().all(|kept| *kept));
    assert!(!is_seen(&carved.seen, DVec3::new(0.05, 0.05, 1.15)));
    assert!(is_seen(&carved.seen, DVec3::new(0.05, 0.05, 0.85)));
}

#[test]
fn points_end_rays_through_holes_of_the_twin() {
    // An empty twin: rays have no end, and only points prove free space.
    let mut dataset = dataset();
    let p = Vec3::new(0.05, 0.05, 2.0);
    for photo in &mut dataset.photos {
        let ([x, y], z) = photo.view.project(p).unwrap();
        photo.target.points.push(SeenPoint { pixel: y as u32 * 96 + x as u32, z });
    }
    let nothing = carved(&Splats::default(), &dataset);
    assert!(is_seen(&nothing.seen, DVec3::new(0.05, 0.05, 1.85)));
    assert!(!is_seen(&nothing.seen, DVec3::new(0.05, 0.05, 2.05)));
    assert!(!is_seen(&nothing.seen, DVec3::new(0.45, 0.45, 1.85)));
    // With the wall behind it, rays to the point end at the point.
    let walled = carved(&wall(), &dataset);
    assert!(!is_seen(&walled.seen, DVec3::new(0.05, 0.05, 2.05)));
    assert!(is_seen(&walled.seen, DVec3::new(0.55, 0.55, 2.15)));
}

#[test]
fn masked_pixels_prove_no_free_space() {
    let mut dataset = dataset();
    for photo in &mut dataset.photos {
        photo.target.mask = vec![0; 96 * 72];
    }
    let carved = carved(&wall(), &dataset);
    assert!(!is_seen(&carved.seen, DVec3::new(0.05, 0.05, 2.0)));
    assert!(is_seen(&carved.seen, DVec3::new(0.01, 0.01, 0.01)), "the camera's path");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(8))]
    /// Seen space does not depend on the frame and unit of a capture.
    #[test]
    fn result_does_not_depend_on_the_frame_of_the_capture(
        axis in prop::array::uniform3(-1.0..1.0f64), shift in prop::array::uniform3(-5.0..5.0f64),
        scale in 0.2..5.0f64,
    ) {
        let world = Similarity {
            scale,
            rotation: DQuat::from_scaled_axis(DVec3::from(axis)),
            translation_m: DVec3::from(shift),
        };
        let back = |p: DVec3| world.rotation.inverse() * (p - world.translation_m) / scale;
        let (mut splats, mut dataset) = (wall(), dataset());
        let turn = world.rotation.inverse();
        for i in 0..splats.len() {
            splats.means_m[i] = back(splats.means_m[i].as_dvec3()).as_vec3();
            splats.scales_m[i] /= scale as f32;
            splats.rotations[i] = (turn.as_quat() * splats.rotations[i]).normalize();
        }
        for photo in &mut dataset.photos {
            let pose: Pose<World, Cam> = Pose::new(back(photo.view.position.as_dvec3()), turn);
            photo.view = View::new(&photo.view.intrinsics(), &pose, photo.view.near / scale as f32);
        }
        let plain = carved(&wall(), &self::dataset());
        let moved = carve(&dataset, &splats, &world, region(), &CarveOptions::default());
        let pairs = plain.seen.bits.iter().zip(&moved.seen.bits);
        let differ: u32 = pairs.map(|(a, b)| (a ^ b).count_ones()).sum();
        // Centres on the border of a pixel may differ.
        prop_assert!(differ as usize <= region().len() / 200, "{differ} of {}", region().len());
    }
}
