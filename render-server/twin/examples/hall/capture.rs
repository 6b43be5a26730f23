//! A walk through a generated room: photos, their poses, and points as structure from motion finds them. True depths
//! are kept separately, for the evaluation.

use glam::{DQuat, DVec3, Vec3};
use vizflyt_protocol::geometry::{Body, Cam, Intrinsics, Pose, World, body_from_forward_cam};
use vizflyt_scenes::walk::Walk;
use vizflyt_splat::{Camera, CpuRenderer, DepthKind, Rasterizer, RgbdImage, Splats};
use vizflyt_twin::random::Random;

/// A synthetic capture.
pub(crate) struct Capture {
    pub(crate) intrinsics: Intrinsics,
    pub(crate) photos: Vec<Photo>,
    pub(crate) points: Vec<Point>,
}

pub(crate) struct Photo {
    pub(crate) world_from_cam: Pose<World, Cam>,
    pub(crate) rgb: Vec<u8>,
    /// Median camera-z depth, 0 if there is no return. [m]
    pub(crate) true_depth_m: Vec<f32>,
}

pub(crate) struct Point {
    pub(crate) p_world_m: Vec3,
    pub(crate) rgb: [u8; 3],
    /// Photos that saw the point, with its pixel. [px]
    pub(crate) seen: Vec<(usize, [f32; 2])>,
}

const WIDTH: u32 = 320;
const HEIGHT: u32 = 240;
/// Focal length of a phone's wide camera.
const FOCAL_PX: f64 = 200.0;
/// Number of corners per photo.
const CORNERS: usize = 150;
/// Noise of a point's position after structure from motion. [m]
const POINT_NOISE_M: f32 = 0.01;
/// Noise of the photos. [8-bit steps]
const PIXEL_NOISE: f32 = 2.0;

/// Returns the poses of a walk as people film: over free floor, at eye level, looking to both sides.
pub(crate) fn walked(walk: &Walk, photos: usize) -> Vec<Pose<World, Cam>> {
    (0..photos).map(|i| walk.world_from_cam(walk.seconds() * i as f64 / photos as f64)).collect()
}

/// Returns the poses of a more difficult walk around an 11 x 4.5 m room: a loop, with the camera swaying far sideways
/// and up and down.
pub(crate) fn looped(photos: usize) -> Vec<Pose<World, Cam>> {
    (0..photos).map(|i| pose(i as f64 / photos as f64)).collect()
}

fn pose(turn: f64) -> Pose<World, Cam> {
    let t = turn * std::f64::consts::TAU;
    let position = DVec3::new(5.5 + 4.3 * t.cos(), 1.2 * t.sin(), 1.5 + 0.5 * (3.0 * t).sin());
    let ahead = (1.2 * t.cos()).atan2(-4.3 * t.sin());
    let yaw = ahead + 1.1 * (10.0 * t).sin();
    let tilt = 0.05 + 0.6 * (7.0 * t).sin();
    let world_from_body: Pose<World, Body> = Pose::new(position, DQuat::from_rotation_z(yaw));
    world_from_body * body_from_forward_cam(DVec3::ZERO, tilt)
}

/// Renders one view of splats.
pub(crate) fn render(
    renderer: &mut CpuRenderer,
    intrinsics: Intrinsics,
    pose: Pose<World, Cam>,
) -> RgbdImage {
    let mut images = [RgbdImage::default()];
    let camera = Camera::new(intrinsics, pose, 0.05);
    renderer.render(&[], &[camera], &mut images).expect("the camera is valid");
    let [image] = images;
    image
}

/// Returns median depths, 0 where there is no return. [m]
pub(crate) fn depth_m(image: &RgbdImage) -> Vec<f32> {
    let mut mm = Vec::new();
    image.write_depth_mm(DepthKind::Median, &mut mm);
    mm.into_iter().map(|mm| f32::from(mm) / 1e3).collect()
}

/// Captures a scene.
pub(crate) fn capture(splats: &Splats, poses: &[Pose<World, Cam>], seed: u64) -> Capture {
    let mut random = Random::new(seed);
    let mut intrinsics = Intrinsics::from_horizontal_fov(WIDTH, HEIGHT, 1.0);
    (intrinsics.fx_px, intrinsics.fy_px) = (FOCAL_PX, FOCAL_PX);
    let mut renderer = CpuRenderer::new(splats);
    let photos: Vec<Photo> = poses
        .iter()
        .map(|&world_from_cam| {
            let image = render(&mut renderer, intrinsics, world_from_cam);
            let noisy = |v: &f32| (v * 255.0 + PIXEL_NOISE * random.normal()).round() as u8;
            Photo {
                world_from_cam,
                rgb: image.rgb.iter().map(noisy).collect(),
                true_depth_m: depth_m(&image),
            }
        })
        .collect();
    let points = points(&intrinsics, &photos, &mut random);
    Capture { intrinsics, photos, points }
}

/// Detects the strongest corner of each neighbourhood, and projects it into the other photos.
fn points(k: &Intrinsics, photos: &[Photo], random: &mut Random) -> Vec<Point> {
    let (width, height) = (k.width_px as usize, k.height_px as usize);
    let mut points = Vec::new();
    for (i, photo) in photos.iter().enumerate() {
        let grey = |x: usize, y: usize| {
            let at = 3 * (y * width + x);
            photo.rgb[at..at + 3].iter().map(|&v| f32::from(v)).sum::<f32>() / 3.0
        };
        let mut corners: Vec<(f32, usize, usize)> = Vec::new();
        for cell_y in (8..height - 16).step_by(12) {
            for cell_x in (8..width - 16).step_by(12) {
                let strength = |x: usize, y: usize| {
                    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
                    for (dx, dy) in (0..9).map(|n| (n % 3, n / 3)) {
                        let (u, v) = (x + dx - 1, y + dy - 1);
                        let gx = grey(u + 1, v) - grey(u - 1, v);
                        let gy = grey(u, v + 1) - grey(u, v - 1);
                        (xx, xy, yy) = (xx + gx * gx, xy + gx * gy, yy + gy * gy);
                    }
                    // The smaller eigenvalue (Shi and Tomasi 1994).
                    0.5 * (xx + yy) - (0.25f32 * (xx - yy) * (xx - yy) + xy * xy).sqrt()
                };
                let places = (0..144).map(|n| (cell_x + n % 12, cell_y + n / 12));
                let best = places
                    .filter(|&(x, y)| x < width - 8 && y < height - 8)
                    .map(|(x, y)| (strength(x, y), x, y))
                    .max_by(|a, b| a.0.total_cmp(&b.0));
                corners.extend(best);
            }
        }
        corners.sort_by(|a, b| b.0.total_cmp(&a.0));
        for &(_, x, y) in corners.iter().take(CORNERS) {
            let depth_m = photo.true_depth_m[y * width + x];
            let pixel = glam::DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let Some(p_cam) = k.unproject(pixel, f64::from(depth_m)).filter(|_| depth_m > 0.0)
            else {
                continue;
            };
            let p_world = photo.world_from_cam.transform_point(p_cam);
            let mut seen = vec![(i, [pixel.x as f32, pixel.y as f32])];
            for (j, other) in photos.iter().enumerate().filter(|(j, _)| *j != i) {
                let p_cam = other.world_from_cam.inverse().transform_point(p_world);
                let Some(pixel) = k.project(p_cam) else { continue };
                if pixel.x < 0.0
                    || pixel.y < 0.0
                    || pixel.x >= f64::from(k.width_px)
                    || pixel.y >= f64::from(k.height_px)
                {
                    continue;
                }
                let depth_m = other.true_depth_m[pixel.y as usize * width + pixel.x as usize];
                // Feature matchers lose points seen from other positions: limit the distance in the sequence.
                if (f64::from(depth_m) - p_cam.z).abs() < 0.02 * p_cam.z && j.abs_diff(i) <= 6 {
                    seen.push((j, [pixel.x as f32, pixel.y as f32]));
                }
            }
            if seen.len() < 3 {
                continue;
            }
            let noise = Vec3::new(random.normal(), random.normal(), random.normal());
            let at = 3 * (y * width + x);
            points.push(Point {
                p_world_m: p_world.as_vec3() + noise * POINT_NOISE_M,
                rgb: [photo.rgb[at], photo.rgb[at + 1], photo.rgb[at + 2]],
                seen,
            });
        }
    }
    points
}
