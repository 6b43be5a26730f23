//! Small test scenes and cameras.

use std::path::Path;

use glam::{DMat3, DQuat, DVec3, Quat, Vec3};
use serde::Deserialize;
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};
use vizflyt_splat::{Camera, Splats};

/// Knuth's MMIX generator; returns its upper 24 bits, scaled from `low` to `high`.
pub(crate) fn random(state: &mut u64, low: f32, high: f32) -> f32 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    low + (*state >> 40) as f32 / (1u64 << 24) as f32 * (high - low)
}

fn add(splats: &mut Splats, state: &mut u64, mean: Vec3, scale: f32) {
    splats.means_m.push(mean);
    let mut side = || scale * (random(state, -1.0, 0.7)).exp();
    splats.scales_m.push(Vec3::new(side(), side(), side() * 0.3));
    let q = Quat::from_array([(); 4].map(|()| random(state, -1.0, 1.0)));
    splats.rotations.push(if q.length() > 0.1 { q.normalize() } else { Quat::IDENTITY });
    splats.opacities.push(random(state, 0.0, 1.0));
    for k in 0..splats.sh_coefficients() * 3 {
        splats.sh.push(random(state, -0.9, 0.9) / if k < 3 { 1.0 } else { 4.0 });
    }
}

/// Returns a wall at 3 m, clutter in front of it, and some of it behind the camera at the origin.
pub(crate) fn cloud(count: usize, sh_degree: u8, seed: u64) -> Splats {
    let mut splats = Splats { sh_degree, ..Splats::default() };
    let state = &mut seed.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    for i in 0..count {
        let mut r = |low, high| random(state, low, high);
        let mean = match i % 4 {
            0 | 1 => Vec3::new(r(-4.0, 4.0), r(-3.0, 3.0), 3.0 + r(-0.02, 0.02)),
            2 => Vec3::new(r(-2.0, 2.0), r(-1.5, 1.5), r(0.5, 3.0)),
            _ => Vec3::new(r(-6.0, 6.0), r(-6.0, 6.0), r(-6.0, 6.0)),
        };
        add(&mut splats, state, mean, 0.08);
    }
    splats
}

/// Returns a sphere around the origin.
pub(crate) fn ball(count: usize, radius_m: f32, sh_degree: u8) -> Splats {
    let mut splats = Splats { sh_degree, ..Splats::default() };
    let state = &mut 77;
    for _ in 0..count {
        let direction = Vec3::from([(); 3].map(|()| random(state, -1.0, 1.0)));
        add(&mut splats, state, direction.normalize_or(Vec3::X) * radius_m, radius_m * 0.15);
        *splats.opacities.last_mut().expect("one was added") = 0.95;
    }
    splats
}

/// Returns a camera at the origin that looks along z, slightly off its middle.
pub(crate) fn camera(width_px: u32, height_px: u32, fov_deg: f64) -> Camera {
    let k = Intrinsics::from_horizontal_fov(width_px, height_px, fov_deg.to_radians());
    Camera {
        background: [0.2, 0.4, 0.6],
        ..Camera::new(
            Intrinsics { cx_px: k.cx_px + 1.3, cy_px: k.cy_px - 0.4, ..k },
            Pose::new(DVec3::new(0.05, -0.02, -0.1), DQuat::from_rotation_z(0.1)),
            0.05,
        )
    }
}

/// Reads a camera in the oracle's format: rows of world to camera.
pub(crate) fn oracle_camera(path: &Path) -> Camera {
    #[derive(Deserialize)]
    struct File {
        fx: f64,
        fy: f64,
        cx: f64,
        cy: f64,
        w: u32,
        h: u32,
        bg: [f32; 3],
        w2c: [[f64; 4]; 4],
    }
    let text = std::fs::read_to_string(path).expect("a camera file");
    let c: File = serde_json::from_str(&text).expect("a camera");
    let row = |i: usize| DVec3::new(c.w2c[i][0], c.w2c[i][1], c.w2c[i][2]);
    let rotation = DMat3::from_cols(row(0), row(1), row(2));
    let translation = DVec3::new(c.w2c[0][3], c.w2c[1][3], c.w2c[2][3]);
    Camera {
        background: c.bg,
        ..Camera::new(
            Intrinsics {
                width_px: c.w,
                height_px: c.h,
                fx_px: c.fx,
                fy_px: c.fy,
                cx_px: c.cx,
                cy_px: c.cy,
                distortion: Distortion::None,
            },
            Pose::new(-(rotation * translation), DQuat::from_mat3(&rotation)),
            0.01,
        )
    }
}
