//! A synthetic hall: points and tags on its walls, a camera that walks a loop, and the result of structure from motion.

use std::f64::consts::TAU;

use glam::{DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Distortion, Intrinsics, Pose, World};

use super::{Capture, Image, Sighting, Tag, TagSighting};
use crate::align::Similarity;
use crate::random::Random;

/// True poses and the capture.
#[derive(Clone, Debug)]
pub(crate) struct Hall {
    pub(crate) poses: Vec<Pose<World, Cam>>,
    pub(crate) lens: Intrinsics,
    pub(crate) capture: Capture,
}

/// Half the extents of the hall. [m]
const HALF: DVec3 = DVec3::new(5.0, 3.0, 1.6);
const EDGE_M: f64 = 0.3;
const IMAGE_S: f64 = 0.5;
const STEP_HZ: f64 = 1.8;

/// Returns a hall. `noise_px` is the noise of the sightings.
pub(crate) fn hall(seed: u64, images: usize, points: usize, noise_px: f64) -> Hall {
    filmed(seed, images, points, noise_px, Shutter { readout_s: 0.0, hand_rad: 0.0 })
}

/// Shutter of a hall's camera.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shutter {
    pub(crate) readout_s: f64,
    /// Pitch and roll of the hand at each step, faster than the image rate.
    pub(crate) hand_rad: f64,
}

/// Returns a hall filmed with a rolling shutter, two images per second.
pub(crate) fn filmed(
    seed: u64,
    images: usize,
    points: usize,
    noise_px: f64,
    shutter: Shutter,
) -> Hall {
    let mut random = Random::new(seed);
    let lens = Intrinsics {
        distortion: Distortion::BrownConrady { k1: -0.06, k2: 0.02, p1: 0.0, p2: 0.0, k3: 0.0 },
        ..Intrinsics::from_horizontal_fov(640, 480, 1.2)
    };
    let wander: Vec<f64> = (0..images).map(|_| 0.05 * f64::from(random.normal())).collect();
    let pose_at = |image: usize, after_s: f64| {
        let at_s = IMAGE_S * image as f64 + after_s;
        let around = TAU * at_s / (IMAGE_S * images as f64);
        let at_m = DVec3::new(1.8 * around.cos(), 0.9 * around.sin(), 0.1 * (5.0 * around).sin());
        // Outwards and a little ahead; x right, y down, z forward.
        let yaw = around + 0.3 + wander[image];
        let ahead = DVec3::new(yaw.cos(), yaw.sin(), 0.1 * (3.0 * around).cos()).normalize();
        let right = ahead.cross(DVec3::Z).normalize();
        let axes = glam::DMat3::from_cols(right, ahead.cross(right), ahead);
        let step = shutter.hand_rad * (TAU * STEP_HZ * at_s).sin();
        let hand = DQuat::from_scaled_axis(DVec3::new(step, 0.0, -0.5 * step));
        Pose::<World, Cam>::new(at_m, (DQuat::from_mat3(&axes) * hand).normalize())
    };
    let poses: Vec<Pose<World, Cam>> = (0..images).map(|image| pose_at(image, 0.0)).collect();
    // The row that exposes a point depends on the point's position in the image: iterate.
    let see = |image: usize, p: DVec3| {
        let mut pixel = see(&lens, &poses[image], p)?;
        for _ in 0..if shutter.readout_s == 0.0 { 0 } else { 5 } {
            let share = pixel.y / f64::from(lens.height_px) - 0.5;
            pixel = see(&lens, &pose_at(image, share * shutter.readout_s), p)?;
        }
        Some(pixel)
    };
    let on_wall = |random: &mut Random| {
        let mut p = DVec3::from_array(std::array::from_fn(|k| {
            f64::from(random.within(-1.0, 1.0)) * HALF[k]
        }));
        let wall = random.below(3);
        p[wall] = HALF[wall].copysign(p[wall]);
        p
    };
    let points: Vec<DVec3> = (0..points).map(|_| on_wall(&mut random)).collect();
    let tags: Vec<[DVec3; 4]> = (0..12)
        .map(|tag| {
            let around = TAU * (f64::from(tag) + 0.3) / 12.0;
            let out = DVec3::new(around.cos(), around.sin(), 0.0);
            let reach = (HALF.x / out.x.abs()).min(HALF.y / out.y.abs());
            // Tags face inwards.
            let (x, y) = (out.cross(DVec3::Z), DVec3::Z);
            let middle = out * (reach - 0.1) + DVec3::Z * (0.5 * (3.0 * around).sin());
            [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
                .map(|(a, b)| middle + (x * a + y * b) * (EDGE_M / 2.0))
        })
        .collect();
    let mut capture = Capture {
        lens,
        images: Vec::new(),
        points: points.clone(),
        tags: tags
            .iter()
            .enumerate()
            .map(|(tag, corners)| Tag {
                name: format!("tag36h11 {tag}"),
                size_m: EDGE_M,
                corners_m: Some(*corners),
            })
            .collect(),
        tracked_in_cam_m: DVec3::ZERO,
    };
    for (number, pose) in poses.iter().enumerate() {
        let noisy = |pixel: DVec2, random: &mut Random, noise_px: f64| {
            let off = DVec2::new(f64::from(random.normal()), f64::from(random.normal()));
            pixel + off * noise_px
        };
        let mut image = Image {
            name: format!("{number:03}.jpg"),
            at_s: IMAGE_S * number as f64,
            scene_from_cam: *pose,
            seen: Vec::new(),
            tags: Vec::new(),
            place: None,
            up: None,
        };
        for (point, &p) in points.iter().enumerate() {
            if let Some(pixel) = see(number, p)
                && random.unit() < 0.8
            {
                image.seen.push(Sighting { point, pixel: noisy(pixel, &mut random, noise_px) });
            }
        }
        for (tag, corners) in tags.iter().enumerate() {
            let seen = corners.map(|corner| see(number, corner));
            if let [Some(a), Some(b), Some(c), Some(d)] = seen
                && a.distance(c) > 25.0
            {
                let corners_px =
                    [a, b, c, d].map(|pixel| noisy(pixel, &mut random, 0.5 * noise_px));
                image.tags.push(TagSighting { tag, corners_px });
            }
        }
        capture.images.push(image);
    }
    Hall { poses, lens, capture }
}

fn see(lens: &Intrinsics, pose: &Pose<World, Cam>, p: DVec3) -> Option<DVec2> {
    let p_cam = pose.inverse().transform_point(p);
    let pixel = lens.project(p_cam)?;
    let inside = pixel.x > 0.0 && pixel.y > 0.0 && pixel.x < 640.0 && pixel.y < 480.0;
    (inside && p_cam.z > 0.3 && p_cam.z < 6.0).then_some(pixel)
}

impl Hall {
    /// Returns the hall as structure from motion does: in an arbitrary frame, with small errors and a wrong focal
    /// length.
    pub(crate) fn found(mut self, seed: u64, off_m: f64) -> Self {
        let mut random = Random::new(seed);
        let mut gauss = |sigma: f64| {
            DVec3::from_array(std::array::from_fn(|_| sigma * f64::from(random.normal())))
        };
        let to = Similarity {
            scale: 0.37,
            rotation: DQuat::from_scaled_axis(DVec3::new(1.1, -0.4, 2.0)),
            translation_m: DVec3::new(3.0, -1.0, 0.5),
        };
        for image in &mut self.capture.images {
            let pose = &image.scene_from_cam;
            let at = to.transform_point(pose.translation_m + gauss(off_m));
            let q = to.rotation * pose.rotation * DQuat::from_scaled_axis(gauss(0.3 * off_m));
            image.scene_from_cam = Pose::new(at, q.normalize());
        }
        for point in &mut self.capture.points {
            *point = to.transform_point(*point + gauss(off_m));
        }
        self.capture.lens.fx_px *= 1.0 + 0.2 * off_m;
        self.capture.lens.fy_px *= 1.0 + 0.2 * off_m;
        self
    }
}
