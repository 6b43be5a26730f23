//! Detects tags repeatedly in one image of the cube and prints them. Used to count instructions where time measurements
//! are unreliable.
//!
//! - `cargo run --release -p vizflyt-tags --example detect -- search 20`: in the whole image, 1280x720
//! - `cargo run --release -p vizflyt-tags --example detect -- look 20`: in the region of the cube, as in tracking

use glam::{DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_tags::camera::Mounting;
use vizflyt_tags::detect::{Detector, DetectorSettings, Region};
use vizflyt_tags::family::TagFamily;
use vizflyt_tags::simulated::{cube, webcams};
use vizflyt_tags::synth::{Placed, Renderer, SyntheticExposure};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let is_search = match arguments.next().as_deref() {
        Some("search") => true,
        Some("look") => false,
        _ => return Err("give search or look, then the number of repetitions".into()),
    };
    let times: usize = arguments.next().ok_or("give the number of repetitions")?.parse()?;
    let (cube, camera) = (cube(), webcams(1).remove(0));
    let Mounting::World(world_from_cam) = camera.mounting else {
        return Err("the simulated webcam has no pose".into());
    };
    let pose: Pose<World, Body> = Pose::new(DVec3::new(3.0, 0.2, 1.4), DQuat::from_rotation_z(0.6));
    let placed = [Placed::on_vehicle(&cube, [pose; 2])];
    let scene = SyntheticExposure::still(&placed, world_from_cam);
    let image = Renderer::new(camera.intrinsics).render(&scene);
    let mut detector = Detector::new(&[TagFamily::Tag36h11], DetectorSettings::default());
    let mut found = detector.search(&image, &camera.intrinsics, false);
    let corners = found.iter().flat_map(|tag| tag.corners_px);
    let (least_px, most_px) = corners.fold((DVec2::MAX, DVec2::MIN), |(least, most), corner| {
        (least.min(corner), most.max(corner))
    });
    let tag_edge_px =
        found.iter().map(|tag| tag.corners_px[0].distance(tag.corners_px[1])).reduce(f64::min);
    let region =
        Region { least_px: least_px - MARGIN_PX, most_px: most_px + MARGIN_PX, tag_edge_px };
    for _ in 0..times {
        found = if is_search {
            detector.search(&image, &camera.intrinsics, false)
        } else {
            detector.look(&image, &region, &camera.intrinsics)
        };
    }
    for tag in &found {
        println!("{} {} {:?}", tag.family, tag.id, tag.corners_px.map(|corner| corner.to_array()));
    }
    if found.is_empty() { Err("no tag found".into()) } else { Ok(()) }
}

/// Margin of a tracker around the expected tags. [px]
const MARGIN_PX: f64 = 30.0;
