//! Renders a contact sheet of a generated scene: colour and depth from poses along the flight.
//!
//! ```text
//! cargo run --release -p vizflyt-scenes --example render -- forest 7 sheet.png
//! cargo run --release -p vizflyt-scenes --example render -- race 3 sheet.png 2 5,0,1.2,90,-10
//! ```
//! Optional arguments after the file: scale of the size 320x240, then poses as `x,y,z,yaw_deg,pitch_deg`.

use std::error::Error;
use std::time::Instant;

use glam::{DQuat, DVec3};
use image::{Rgb, RgbImage};
use vizflyt_protocol::geometry::{Body, Intrinsics, Pose, World, body_from_forward_cam};
use vizflyt_scenes::{SceneKind, generate};
use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, RgbdImage};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [kind, seed, file, rest @ ..] = args.as_slice() else {
        return Err(
            "usage: render forest|race|room|moving SEED FILE.png [SCALE] [x,y,z,yaw,pitch]..."
                .into(),
        );
    };
    let kind: SceneKind = kind.parse()?;
    let scale: u32 = rest.first().map_or(Ok(1), |text| text.parse())?;
    let mut poses = rest
        .iter()
        .skip(1)
        .map(|text| text.split(',').map(str::parse).collect())
        .collect::<Result<Vec<Vec<f64>>, _>>()?;
    if poses.is_empty() {
        poses = default_poses(kind);
    }

    let start = Instant::now();
    let scene = generate(kind, seed.parse()?);
    println!("{} splats in {:.2} s", scene.splats.len(), start.elapsed().as_secs_f64());
    let mut renderer = CpuRenderer::new(&scene.splats);

    let (width, height) = (320 * scale, 240 * scale);
    let mut sheet = RgbImage::new(2 * width, height * poses.len() as u32);
    for (row, pose) in poses.iter().enumerate() {
        let [x, y, z, yaw_deg, pitch_deg] = pose.as_slice() else {
            return Err("a pose is x,y,z,yaw_deg,pitch_deg".into());
        };
        let world_from_body: Pose<World, Body> =
            Pose::new(DVec3::new(*x, *y, *z), DQuat::from_rotation_z(yaw_deg.to_radians()));
        let camera = Camera::new(
            Intrinsics::from_horizontal_fov(width, height, 90f64.to_radians()),
            world_from_body * body_from_forward_cam(DVec3::ZERO, pitch_deg.to_radians()),
            0.05,
        );
        let mut images = [RgbdImage::default()];
        let start = Instant::now();
        renderer.render(&[], std::slice::from_ref(&camera), &mut images)?;
        let [seen] = images;
        let thin = seen.alpha.iter().filter(|alpha| **alpha < 0.98).count() as f64;
        println!(
            "pose {row}: {:.1} ms, {:.2} % of pixels not solid",
            start.elapsed().as_secs_f64() * 1e3,
            100.0 * thin / seen.alpha.len() as f64
        );
        for (i, (rgb, depth_m)) in seen.rgb.chunks(3).zip(&seen.depth_median_m).enumerate() {
            let (u, v) = (i as u32 % width, i as u32 / width + row as u32 * height);
            let colour = [rgb[0], rgb[1], rgb[2]].map(|c| (c.clamp(0.0, 1.0) * 255.0) as u8);
            sheet.put_pixel(u, v, Rgb(colour));
            sheet.put_pixel(u + width, v, Rgb(depth_colour(*depth_m)));
        }
    }
    sheet.save(file)?;
    Ok(())
}

/// Returns the colour of a depth: near is red, far is blue, no depth is black.
fn depth_colour(depth_m: f32) -> [u8; 3] {
    if depth_m <= 0.0 {
        return [0; 3];
    }
    let near = 1.0 / (1.0 + 0.25 * depth_m);
    let band = 1.0 - (2.0 * near - 1.0).abs();
    [near, band, 1.0 - near].map(|c| (c * 255.0) as u8)
}

fn default_poses(kind: SceneKind) -> Vec<Vec<f64>> {
    let poses: [[f64; 5]; 8] = match kind {
        SceneKind::Forest => [
            [1.0, 0.0, 1.2, 0.0, 0.0],
            [8.0, 1.0, 1.2, 0.0, 0.0],
            [16.0, -1.0, 1.5, 20.0, 5.0],
            [24.0, 0.5, 1.2, -90.0, 0.0],
            [28.0, 2.0, 1.2, 180.0, -15.0],
            [12.0, 0.0, 1.8, 60.0, -35.0],
            [32.0, -1.0, 1.2, 0.0, 40.0],
            [36.0, 0.0, 1.2, 0.0, 0.0],
        ],
        SceneKind::Race | SceneKind::Room | SceneKind::Moving => [
            [0.9, 0.0, 1.2, 0.0, 0.0],
            [3.2, 0.6, 1.4, 0.0, 0.0],
            [5.0, -0.5, 1.5, 30.0, 0.0],
            [6.2, 0.5, 1.2, -60.0, 0.0],
            [10.2, 0.0, 1.2, 180.0, -10.0],
            [5.0, 0.0, 1.2, 90.0, 0.0],
            [8.0, 0.0, 1.5, 0.0, 40.0],
            [2.0, 0.0, 2.0, 0.0, -40.0],
        ],
    };
    poses.iter().map(|pose| pose.to_vec()).collect()
}
