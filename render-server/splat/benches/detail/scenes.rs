//! Generated scenes and their camera views.

use glam::{DMat3, DQuat, DVec3, Quat, Vec3};
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::{Camera, Splats};

#[path = "city.rs"]
pub(crate) mod city;
use city::{Random, city};

pub(crate) fn look(from: DVec3, to: DVec3) -> Camera {
    let z = (to - from).normalize();
    let x = z.cross(DVec3::Z).normalize();
    Camera {
        background: [0.5, 0.6, 0.8],
        ..Camera::new(
            Intrinsics::from_horizontal_fov(640, 480, 90f64.to_radians()),
            Pose::new(from, DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z))),
            0.05,
        )
    }
}

/// Returns views of a city of 8 x 8 blocks.
pub(crate) fn views() -> Vec<(&'static str, Camera)> {
    vec![
        ("street", look(DVec3::new(-100.0, -20.0, 1.6), DVec3::new(0.0, -18.0, 3.0))),
        ("park", look(DVec3::new(-60.0, -58.0, 6.0), DVec3::new(20.0, 10.0, 4.0))),
        ("roofs", look(DVec3::new(-140.0, -140.0, 60.0), DVec3::new(0.0, 0.0, 10.0))),
        ("from above", from_above()),
    ]
}

pub(crate) fn from_above() -> Camera {
    look(DVec3::new(-10.0, -150.0, 160.0), DVec3::new(0.0, -10.0, 0.0))
}

/// Returns a camera at the origin that looks along x.
pub(crate) fn ahead() -> Camera {
    look(DVec3::ZERO, DVec3::X)
}

/// Returns foliage that fills the view along x: splats of one or two pixels, many layers deep, none far away.
pub(crate) fn thicket(count: usize) -> Splats {
    let random = &mut Random::new(3);
    let mut splats = Splats::default();
    for _ in 0..count {
        let mut within = |low, high| random.range(low, high);
        splats.means_m.push(Vec3::new(within(3.0, 9.0), within(-9.0, 9.0), within(-7.0, 7.0)));
        splats.scales_m.push(Vec3::new(0.02, 0.012, 0.003) * within(0.5, 1.5));
        let q = Quat::from_array([(); 4].map(|()| within(-1.0, 1.0)));
        splats.rotations.push(if q.length() > 0.1 { q.normalize() } else { Quat::IDENTITY });
        splats.opacities.push(within(0.1, 1.0));
        splats.sh.extend([(); 3].map(|()| within(-1.0, 1.0)));
    }
    splats
}

/// Returns a quarter of 200,000 splats in front of [`quarter_camera`], and the rest of `count` behind it.
pub(crate) fn quarter_and_elsewhere(count: usize) -> Splats {
    const AHEAD: usize = 200_000;
    let mut splats = city(AHEAD.min(count), 3, 0);
    let mut elsewhere = city(count.saturating_sub(AHEAD), 8, 0);
    for mean_m in &mut elsewhere.means_m {
        mean_m.x -= 300.0;
    }
    splats.means_m.append(&mut elsewhere.means_m);
    splats.scales_m.append(&mut elsewhere.scales_m);
    splats.rotations.append(&mut elsewhere.rotations);
    splats.opacities.append(&mut elsewhere.opacities);
    splats.sh.append(&mut elsewhere.sh);
    splats
}

pub(crate) fn quarter_camera() -> Camera {
    look(DVec3::new(-100.0, -20.0, 30.0), DVec3::new(0.0, -10.0, 5.0))
}
