//! Test of the detector on one image; also run on other processors (`tests/arm/run`).

use glam::{DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_tags::camera::Mounting;
use vizflyt_tags::detect::{Detector, DetectorSettings, Region};
use vizflyt_tags::family::TagFamily;
use vizflyt_tags::layout::CORNERS;
use vizflyt_tags::simulated::{cube, webcams};
use vizflyt_tags::synth::{Placed, Renderer, SyntheticExposure};

#[test]
fn finds_tags_of_the_cube_at_their_positions() {
    let (cube, camera) = (cube(), webcams(1).remove(0));
    let Mounting::World(world_from_cam) = camera.mounting else {
        panic!("the camera is fixed in the room")
    };
    let pose: Pose<World, Body> = Pose::new(DVec3::new(3.0, 0.2, 1.4), DQuat::from_rotation_z(0.6));
    let placed = [Placed::on_vehicle(&cube, [pose; 2])];
    let image = Renderer::new(camera.intrinsics).render(&SyntheticExposure {
        blur_px: 0.5,
        ..SyntheticExposure::still(&placed, world_from_cam)
    });
    let cam_from_body = world_from_cam.inverse() * pose;
    let mut detector = Detector::new(&[TagFamily::Tag36h11], DetectorSettings::default());
    let everywhere =
        Region { least_px: DVec2::ZERO, most_px: DVec2::splat(1e4), tag_edge_px: Some(20.0) };
    let searched = detector.search(&image, &camera.intrinsics, false);
    let looked = detector.look(&image, &everywhere, &camera.intrinsics);
    for (found, most_px) in [(searched, 0.5), (looked, 0.4)] {
        assert!(!found.is_empty());
        for seen in found {
            let tag = cube.tags.iter().find(|tag| tag.id == seen.id);
            let tag = tag.unwrap_or_else(|| panic!("{} is not on the cube", seen.id));
            for (seen_px, corner) in seen.corners_px.iter().zip(CORNERS) {
                let p_body = tag.position_m + tag.rotation_xyzw * (corner * tag.size_m).extend(0.0);
                let true_px =
                    camera.intrinsics.project(cam_from_body.transform_point(p_body)).unwrap();
                let off_px = seen_px.distance(true_px);
                assert!(off_px < most_px, "tag {}: {off_px} px at {true_px}", seen.id);
            }
        }
    }
}
