//! Renders images of tags and writes detected and true corners, for comparison with other detectors:
//!
//! `cargo run --release -p vizflyt-tags --example detections -- FOLDER`
//!
//! writes `N.pgm`, `found.csv` and `true.csv`. Columns: image, family, id, then x and y of the four corners in pixels,
//! in the order of [`vizflyt_tags::layout::CORNERS`]; (0, 0) is the image's outer corner.

use std::fmt::Write;
use std::path::Path;

use glam::{DQuat, DVec2, DVec3, EulerRot};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_tags::camera::{Mounting, TagCamera};
use vizflyt_tags::detect::{Detector, DetectorSettings};
use vizflyt_tags::family::TagFamily;
use vizflyt_tags::layout::{CORNERS, TagLayout};
use vizflyt_tags::simulated::{Sensor, cube, over_mat, webcams};
use vizflyt_tags::synth::{Placed, Renderer, SyntheticExposure};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::args_os().nth(1).ok_or("give a folder to write to")?;
    let folder = Path::new(&folder);
    std::fs::create_dir_all(folder)?;
    let (cube, floor) = (cube(), over_mat::floor(Vec::new()).print()?.layout);
    let west = webcams(1).remove(0);
    let (mut found, mut truth) = (String::new(), String::new());
    for index in 0..IMAGES {
        let n = f64::from(index);
        let turn = DQuat::from_euler(EulerRot::ZYX, 0.7 * n, 0.2 * n.sin(), 0.2 * (2.0 * n).sin());
        // The cube at distances from 2 to 6.5 m, then the mat from 0.6 to 1.5 m.
        let above = index >= IMAGES / 2;
        let (camera, layout, p_m) = if above {
            let z_m = 0.6 + 0.06 * (n - f64::from(IMAGES / 2));
            (over_mat::camera(), &floor, DVec3::new(5.5, 0.3 * n.sin(), z_m))
        } else {
            (west.clone(), &cube, DVec3::new(1.5 + 0.28 * n, 0.5 * n.sin(), 1.4))
        };
        let pose: Pose<World, Body> = Pose::new(p_m, turn);
        let placed =
            if above { Placed::fixed(layout) } else { Placed::on_vehicle(layout, [pose; 2]) };
        let world_from_cam = match camera.mounting {
            Mounting::Body(body_from_cam) => pose * body_from_cam,
            Mounting::World(world_from_cam) => world_from_cam,
            Mounting::Unknown => return Err("a simulated camera has no pose".into()),
        };
        let Sensor { light, blur_px, noise, .. } = Sensor::default();
        let image = Renderer::new(camera.intrinsics).render(&SyntheticExposure {
            light,
            blur_px,
            noise,
            seed: index.into(),
            ..SyntheticExposure::still(&[placed], world_from_cam)
        });
        let mut bytes =
            format!("P5\n{} {}\n255\n", image.width_px(), image.height_px()).into_bytes();
        bytes.extend_from_slice(image.pixels());
        std::fs::write(folder.join(format!("{index}.pgm")), bytes)?;
        let mut detector = Detector::new(&[TagFamily::Tag36h11], DetectorSettings::default());
        for tag in detector.search(&image, &camera.intrinsics, true) {
            line(&mut found, index, tag.family, tag.id, &tag.corners_px)?;
        }
        tell_truth(&mut truth, index, &camera, layout, &pose)?;
    }
    std::fs::write(folder.join("found.csv"), found)?;
    std::fs::write(folder.join("true.csv"), truth)?;
    Ok(())
}

fn tell_truth(
    out: &mut String,
    index: u32,
    camera: &TagCamera,
    layout: &TagLayout,
    world_from_body: &Pose<World, Body>,
) -> std::fmt::Result {
    for tag in &layout.tags {
        let (rotation, at) = match camera.mounting {
            Mounting::Body(body_from_cam) => {
                let cam_from_world = (*world_from_body * body_from_cam).inverse();
                (cam_from_world.rotation, cam_from_world.translation_m)
            }
            Mounting::World(world_from_cam) => {
                let cam_from_body = world_from_cam.inverse() * *world_from_body;
                (cam_from_body.rotation, cam_from_body.translation_m)
            }
            Mounting::Unknown => return Ok(()),
        };
        if (rotation * tag.normal()).dot(rotation * tag.position_m + at) >= 0.0 {
            continue;
        }
        let corners = CORNERS.map(|c| {
            let p = tag.position_m + tag.rotation_xyzw * (c * tag.size_m).extend(0.0);
            camera.intrinsics.project(rotation * p + at).unwrap_or(DVec2::NAN)
        });
        line(out, index, tag.family, tag.id, &corners)?;
    }
    Ok(())
}

fn line(
    out: &mut String,
    image: u32,
    family: TagFamily,
    id: u32,
    corners_px: &[DVec2; 4],
) -> std::fmt::Result {
    write!(out, "{image},{family},{id}")?;
    for corner in corners_px {
        write!(out, ",{},{}", corner.x, corner.y)?;
    }
    writeln!(out)
}

const IMAGES: u32 = 32;
