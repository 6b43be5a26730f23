//! Detects vertical planes in an image: bars by their colour, walls by their size.

use vizflyt_sdk::glam::{DVec2, DVec3};

use crate::color_class::ColorClass;
use crate::planar_obstacle::Plane;
use crate::sampling::PixelGrid;

/// A plane detected in one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DetectedPlane {
    /// Vertical plane.
    pub plane: Plane,
    /// Distance from the camera to the middle of its visible points. [m]
    pub range_m: f64,
    /// Whether the complete width of a frame is visible, with an empty middle.
    pub framed: bool,
}

/// Returns the nearest vertical plane with enough points of a colour. `camera_m` [m, home].
pub fn window(grid: &PixelGrid, camera_m: DVec3, color: ColorClass) -> Option<DetectedPlane> {
    let mut points_m: Vec<DVec3> = grid
        .samples
        .iter()
        .filter(|sample| sample.color == Some(color) && sample.is_seen())
        .filter(|sample| sample.offset_m.length_squared() < FAR_M * FAR_M)
        .map(|sample| camera_m + sample.offset_m)
        .filter(|p_m| p_m.z > LOWEST_M)
        .collect();
    let mut nearest: Option<DetectedPlane> = None;
    // Other objects further away may have the same colour: graffiti, mats.
    for _ in 0..3 {
        let Some(line) = upright_line(&points_m) else { break };
        let (on, off): (Vec<DVec3>, Vec<DVec3>) =
            points_m.iter().partition(|p_m| line.behind_m(**p_m).abs() < ON_LINE_M);
        let found = describe(line, &on, camera_m);
        if found.framed && nearest.is_none_or(|best| found.range_m < best.range_m) {
            nearest = Some(found);
        }
        points_m = off;
    }
    nearest
}

/// Returns the plane of a colour near its known plane.
pub fn again(
    grid: &PixelGrid,
    camera_m: DVec3,
    color: ColorClass,
    known: &Plane,
) -> Option<DetectedPlane> {
    let points_m: Vec<DVec3> = grid
        .samples
        .iter()
        .filter(|sample| sample.color == Some(color) && sample.is_seen())
        .map(|sample| camera_m + sample.offset_m)
        .filter(|p_m| p_m.z > LOWEST_M && known.behind_m(*p_m).abs() < 0.3)
        .filter(|p_m| known.within_m(*p_m).x.abs() < 1.2)
        .collect();
    let line = upright_line(&points_m)?;
    Some(describe(line, &points_m, camera_m)).filter(|found| found.framed)
}

/// Returns the nearest large wall across the flight direction.
pub fn wall(grid: &PixelGrid, camera_m: DVec3) -> Option<DetectedPlane> {
    let mut areas_m2 = [0.0_f64; BINS];
    let camera = grid.camera?;
    let pixel = camera.stride as f64 / camera.intrinsics.fx_px;
    for sample in grid.samples.iter().filter(|sample| is_of_wall(camera_m, sample.offset_m)) {
        let depth_m = sample.offset_m.x;
        if let Some(area_m2) = areas_m2.get_mut((depth_m / BIN_M) as usize) {
            *area_m2 += (pixel * depth_m).powi(2);
        }
    }
    let bin = (0..BINS - 1).find(|&bin| areas_m2[bin] + areas_m2[bin + 1] > WALL_M2)?;
    let (low_m, high_m) = (bin as f64 * BIN_M, (bin + 2) as f64 * BIN_M);
    let points_m: Vec<DVec3> = grid
        .samples
        .iter()
        .filter(|sample| is_of_wall(camera_m, sample.offset_m))
        .filter(|sample| (low_m..high_m).contains(&sample.offset_m.x))
        .map(|sample| camera_m + sample.offset_m)
        .collect();
    let line = upright_line(&points_m)?;
    let found = describe(line, &points_m, camera_m);
    (found.plane.yaw_rad.abs() < 0.15).then_some(found)
}

fn is_of_wall(camera_m: DVec3, offset_m: DVec3) -> bool {
    let z_m = camera_m.z + offset_m.z;
    offset_m.x > 0.2 && offset_m.y.abs() < 3.0 && (0.3..2.9).contains(&z_m)
}

fn describe(plane: Plane, points_m: &[DVec3], camera_m: DVec3) -> DetectedPlane {
    let (mut low, mut high) = (DVec2::MAX, DVec2::MIN);
    for p_m in points_m {
        let at_m = plane.within_m(*p_m);
        low = low.min(at_m);
        high = high.max(at_m);
    }
    let (middle, size) = ((low + high) / 2.0, high - low);
    let within = |p_m: &&DVec3| {
        let off = (plane.within_m(**p_m) - middle).abs();
        off.x < 0.25 * size.x && off.y < 0.2 * size.y
    };
    let inner = points_m.iter().filter(within).count();
    // A full plane would have 20 % of its points in the middle.
    let hollow = inner * 20 < points_m.len();
    let wide = (0.8..2.2).contains(&size.x) && (0.45..2.2).contains(&size.y);
    let origin_m = plane.point_m(DVec2::new(middle.x, 0.0)).with_z(0.0);
    DetectedPlane {
        plane: Plane { origin_m, ..plane },
        range_m: plane.point_m(middle).distance(camera_m),
        framed: hollow && wide && points_m.len() >= FEWEST,
    }
}

/// Returns the vertical plane across the flight direction with the most points: tries lines through pairs of points in
/// the horizontal plane (RANSAC: M. Fischler and R. Bolles, Comm. ACM 24(6), 1981), then fits.
fn upright_line(points_m: &[DVec3]) -> Option<Plane> {
    if points_m.len() < FEWEST {
        return None;
    }
    let mut state = 0x9e37_79b9_u32;
    let mut pick = || {
        // xorshift32: the same pairs for the same image.
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        points_m[state as usize % points_m.len()]
    };
    // A subset of about 400 points is sufficient for the decision.
    let some = points_m.len().div_ceil(400);
    let mut best: Option<(usize, Plane)> = None;
    for _ in 0..TRIES {
        let (a_m, b_m) = (pick(), pick());
        let Some(plane) = plane_along(a_m, (b_m - a_m).truncate()) else { continue };
        let count = points_m
            .iter()
            .step_by(some)
            .filter(|p_m| plane.behind_m(**p_m).abs() < ON_LINE_M)
            .count();
        if best.as_ref().is_none_or(|(most, _)| count > *most) {
            best = Some((count, plane));
        }
    }
    let (count, plane) = best?;
    if count * some < FEWEST {
        return None;
    }
    let on = || points_m.iter().filter(|p_m| plane.behind_m(**p_m).abs() < ON_LINE_M);
    let n = on().count() as f64;
    let mean_m = on().sum::<DVec3>() / n;
    // Longer axis of the points' spread in the horizontal plane.
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for p_m in on() {
        let d = *p_m - mean_m;
        xx += d.x * d.x;
        xy += d.x * d.y;
        yy += d.y * d.y;
    }
    let along_rad = 0.5 * (2.0 * xy).atan2(xx - yy);
    plane_along(mean_m, DVec2::from_angle(along_rad) * 10.0)
}

/// Returns the vertical plane through a point along a horizontal direction; `None` if the direction is too short, or
/// the plane is not across the flight direction.
fn plane_along(a_m: DVec3, along_m: DVec2) -> Option<Plane> {
    if along_m.length() < SPREAD_M {
        return None;
    }
    let normal = DVec2::new(along_m.y, -along_m.x);
    let normal = if normal.x < 0.0 { -normal } else { normal };
    let yaw_rad = normal.to_angle();
    (yaw_rad.abs() < MAX_YAW_RAD).then_some(Plane { origin_m: a_m.with_z(0.0), yaw_rad })
}

/// Bars further away have only a few pixels. [m]
const FAR_M: f64 = 4.5;
/// Points below are not bars. [m, home]
const LOWEST_M: f64 = 0.15;
/// Maximum distance of a point from its plane. [m]
const ON_LINE_M: f64 = 0.06;
/// Minimum number of points of a plane.
const FEWEST: usize = 60;
const TRIES: usize = 48;
/// Pairs of points nearer to each other carry no information on the direction. [m]
const SPREAD_M: f64 = 0.4;
/// Windows are within 20 degrees of the flight direction; planes beyond twice that are other objects. [rad]
const MAX_YAW_RAD: f64 = 0.7;
/// Maximum range of walls: 5 m.
const BINS: usize = 50;
const BIN_M: f64 = 0.1;
/// Two thirds of a wall; a frame has less. [m^2]
const WALL_M2: f64 = 3.0;

#[cfg(test)]
mod tests;
