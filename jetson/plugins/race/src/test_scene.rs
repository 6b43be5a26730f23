//! Test images of coloured boxes, rendered with one ray per sample.

use vizflyt_sdk::glam::{DQuat, DVec2, DVec3};
use vizflyt_sdk::protocol::geometry::body_from_forward_cam;
use vizflyt_sdk::{Intrinsics, Volume};

use crate::sampling::{PixelGrid, RgbdView};

/// A box of one colour. [m, home]
#[derive(Clone, Copy, Debug)]
pub(crate) struct Brick {
    pub(crate) min_m: DVec3,
    pub(crate) max_m: DVec3,
    pub(crate) rgb: [u8; 3],
}

/// Returns a room of 12 x 6 x 4 m with its floor at z = 0 and x forward.
pub(crate) fn room() -> Vec<Brick> {
    let grey = [150, 150, 150];
    let wall = |min_m, max_m| Brick { min_m, max_m, rgb: grey };
    vec![
        wall(DVec3::new(-3.0, -3.0, -0.2), DVec3::new(9.0, 3.0, 0.0)),
        wall(DVec3::new(-3.0, -3.2, 0.0), DVec3::new(9.0, -3.0, 4.0)),
        wall(DVec3::new(-3.0, 3.0, 0.0), DVec3::new(9.0, 3.2, 4.0)),
        wall(DVec3::new(9.0, -3.0, 0.0), DVec3::new(9.2, 3.0, 4.0)),
        wall(DVec3::new(-3.0, -3.0, 4.0), DVec3::new(9.0, 3.0, 4.2)),
    ]
}

/// Returns a square frame with legs, perpendicular to x; bars are 0.16 m wide.
pub(crate) fn window(middle_m: DVec3, half_m: f64, rgb: [u8; 3]) -> Vec<Brick> {
    let bar = |low: DVec2, high: DVec2, rgb| Brick {
        min_m: middle_m + DVec3::new(-0.045, low.x, low.y),
        max_m: middle_m + DVec3::new(0.045, high.x, high.y),
        rgb,
    };
    let outer_m = half_m + 0.16;
    let leg = |y: f64| {
        bar(DVec2::new(y - 0.025, -middle_m.z), DVec2::new(y + 0.025, -outer_m), [140, 142, 147])
    };
    vec![
        bar(DVec2::new(-outer_m, -outer_m), DVec2::new(-half_m, outer_m), rgb),
        bar(DVec2::new(half_m, -outer_m), DVec2::new(outer_m, outer_m), rgb),
        bar(DVec2::new(-half_m, half_m), DVec2::new(half_m, outer_m), rgb),
        bar(DVec2::new(-half_m, -outer_m), DVec2::new(half_m, -half_m), rgb),
        leg(half_m + 0.08),
        leg(-half_m - 0.08),
    ]
}

/// Returns the samples of a level camera at a position [m, home], with its heading from x [rad].
pub(crate) fn picture(bricks: &[Brick], camera_m: DVec3, yaw_rad: f64) -> PixelGrid {
    let intrinsics = Intrinsics::from_horizontal_fov(160, 120, 90_f64.to_radians());
    let home_from_cam =
        DQuat::from_rotation_z(yaw_rad) * body_from_forward_cam(DVec3::ZERO, 0.0).rotation;
    let (mut rgb, mut depth_mm) = (Vec::new(), Vec::new());
    for row in 0..intrinsics.height_px {
        for column in 0..intrinsics.width_px {
            let pixel = DVec2::new(f64::from(column), f64::from(row)) + 0.5;
            let slope = intrinsics.slope(pixel).expect("a pinhole sees everywhere");
            let ray = home_from_cam * slope.extend(1.0);
            let nearest = bricks
                .iter()
                .filter_map(|brick| Some((hit(brick, camera_m, ray)?, brick.rgb)))
                .min_by(|a, b| a.0.total_cmp(&b.0));
            let (depth_m, colour) = nearest.unwrap_or((0.0, [0; 3]));
            rgb.extend(colour);
            depth_mm.push((depth_m * 1e3).round() as u16);
        }
    }
    let mut grid = PixelGrid::default();
    grid.update(&RgbdView { rgb: &rgb, depth_mm: &depth_mm, intrinsics, home_from_cam });
    grid
}

/// Returns the first intersection of a ray with a box, in lengths of the ray.
fn hit(brick: &Brick, from_m: DVec3, ray: DVec3) -> Option<f64> {
    let (t1, t2) = ((brick.min_m - from_m) / ray, (brick.max_m - from_m) / ray);
    let (enter, leave) = (t1.min(t2).max_element(), t1.max(t2).min_element());
    (enter < leave && enter > 0.0).then_some(enter)
}

/// Returns the distance from a point to the nearest box. [m]
pub(crate) fn clearance_m(bricks: &[Brick], p_m: DVec3) -> f64 {
    let distance_m = |brick: &Brick| Volume::aabb(brick.min_m, brick.max_m).signed_distance_m(p_m);
    bricks.iter().map(distance_m).fold(f64::INFINITY, f64::min)
}
