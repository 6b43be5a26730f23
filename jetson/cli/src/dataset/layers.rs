//! Layers of an image from what the renderer gives: depth of surfaces, normals, classes, optical flow.
//!
//! Budget on one core, 320x240: 1 ms each for normals and flow, less for the others.

use glam::{Mat3, Vec3};
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose};
use vizflyt_splat::RgbdImage;

use super::classes::NOTHING;

/// Writes camera-z depth of the surfaces that pixels show, row-major; 0 is none. The expected depth, which is smooth along a
/// surface, where it is that of the median splat; the median, which lies between no two surfaces, elsewhere. [m, cam]
pub(super) fn surface_depth(image: &RgbdImage, out: &mut Vec<f32>) {
    out.clear();
    let depths = image.depth_median_m.iter().zip(&image.depth_expected_m).zip(&image.alpha);
    out.extend(depths.map(|((&median_m, &expected_m), &alpha)| {
        let is_seen = alpha >= RgbdImage::MIN_DEPTH_ALPHA && median_m > 0.0;
        let is_one = (expected_m - median_m).abs() <= SAME_M + SAME * median_m;
        if is_seen { if is_one { expected_m } else { median_m } } else { 0.0 }
    }));
}

/// Writes depth in whole millimetres, 0 where there is none or beyond 65.535 m.
pub(super) fn depth_mm(depth_m: &[f32], out: &mut Vec<u16>) {
    out.clear();
    out.extend(depth_m.iter().map(|depth_m| {
        let mm = depth_m * 1000.0 + 0.5;
        if mm < 65536.0 { mm as u16 } else { 0 }
    }));
}

/// Writes the surfaces' unit normals towards the camera, H x W x 3, each axis of `cam` as `round(127.5 (n + 1))`; black where
/// there is none. From depth: along a plane 1 / z is linear in pixels, so its slopes give the normal.
pub(super) fn normals(k: &Intrinsics, depth_m: &[f32], out: &mut Vec<u8>) {
    let (width, height) = (k.width_px as usize, k.height_px as usize);
    let inverse: Vec<f32> = depth_m.iter().map(|&z| if z > 0.0 { 1.0 / z } else { 0.0 }).collect();
    let [fx, fy, cx, cy] = [k.fx_px, k.fy_px, k.cx_px, k.cy_px].map(|value| value as f32);
    out.clear();
    out.resize(3 * depth_m.len(), 0);
    for y in 0..height {
        for x in 0..width {
            let at = y * width + x;
            let here = inverse[at];
            if !(here > 0.0) {
                continue;
            }
            let across = slope(
                here,
                [
                    (x >= REACH).then(|| inverse[at - REACH]),
                    (x + REACH < width).then(|| inverse[at + REACH]),
                ],
            );
            let down = slope(
                here,
                [
                    (y >= REACH).then(|| inverse[at - REACH * width]),
                    (y + REACH < height).then(|| inverse[at + REACH * width]),
                ],
            );
            let (Some(across), Some(down)) = (across, down) else { continue };
            let (a, b) = (across * fx, down * fy);
            let at_x = (x as f32 + 0.5 - cx) / fx;
            let at_y = (y as f32 + 0.5 - cy) / fy;
            let away = Vec3::new(a, b, here - a * at_x - b * at_y);
            let normal = -away.normalize_or_zero();
            let bytes = (normal * 127.5 + 128.0).to_array().map(|value| value as u8);
            out[3 * at..3 * at + 3].copy_from_slice(&bytes);
        }
    }
}

/// Returns the slope of 1 / z at a pixel from those beside it that are of the same surface; `None` if none is. [1/m/px]
fn slope(here: f32, [before, after]: [Option<f32>; 2]) -> Option<f32> {
    let step = REACH as f32;
    let same =
        |other: Option<f32>| other.filter(|other| (other - here).abs() <= STEEPEST * step * here);
    match (same(before), same(after)) {
        (Some(before), Some(after)) => Some((after - before) / (2.0 * step)),
        (Some(before), None) => Some((here - before) / step),
        (None, Some(after)) => Some((after - here) / step),
        (None, None) => None,
    }
}

/// Writes optical flow, H x W x 3, as the KITTI benchmark has it (Geiger et al. 2012, its development kit): 16 bits each of
/// `64 u + 2^15` and `64 v + 2^15` pixels, then 1 where there is flow, 0 where not: nothing was hit, it goes behind the camera,
/// or farther than 16 bits hold. Where a pixel's surface is in the next image; it may be hidden there.
///
/// `next_from_cam` is of what stands still; `of_id` of what moves, by its id. [next cam, cam]
pub(super) fn flow(
    k: &Intrinsics,
    depth_m: &[f32],
    ids: &[u16],
    next_from_cam: &Pose<Cam, Cam>,
    of_id: &[(u16, Pose<Cam, Cam>)],
    out: &mut Vec<u16>,
) {
    let width = k.width_px as usize;
    let still = Motion::of(next_from_cam);
    let moving: Vec<(u16, Motion)> =
        of_id.iter().map(|(id, pose)| (*id, Motion::of(pose))).collect();
    let [fx, fy, cx, cy] = [k.fx_px, k.fy_px, k.cx_px, k.cy_px].map(|value| value as f32);
    out.clear();
    out.resize(3 * depth_m.len(), 0);
    let rows = out.chunks_exact_mut(3 * width).zip(depth_m.chunks_exact(width));
    for (y, ((out, depth_m), ids)) in rows.zip(ids.chunks_exact(width)).enumerate() {
        let v = y as f32 + 0.5;
        let slope_y = (v - cy) / fy;
        for (x, (out, &z_m)) in out.chunks_exact_mut(3).zip(depth_m).enumerate() {
            if !(z_m > 0.0) {
                continue;
            }
            let motion = match ids[x] {
                0 => &still,
                id => moving.iter().find(|(moving, _)| *moving == id).map_or(&still, |(_, m)| m),
            };
            let u = x as f32 + 0.5;
            let p_cam = Vec3::new((u - cx) / fx, slope_y, 1.0) * z_m;
            let next = motion.rotation * p_cam + motion.translation_m;
            if !(next.z > NEAREST_M) {
                continue;
            }
            let du = (fx * next.x / next.z + cx - u) * 64.0 + 32768.5;
            let dv = (fy * next.y / next.z + cy - v) * 64.0 + 32768.5;
            if (0.0..65536.0).contains(&du) && (0.0..65536.0).contains(&dv) {
                out.copy_from_slice(&[du as u16, dv as u16, 1]);
            }
        }
    }
}

struct Motion {
    rotation: Mat3,
    translation_m: Vec3,
}

impl Motion {
    fn of(pose: &Pose<Cam, Cam>) -> Self {
        let rotation = Mat3::from_quat(pose.rotation.as_quat());
        Self { rotation, translation_m: pose.translation_m.as_vec3() }
    }
}

/// Writes the class of each pixel, by that of its id; nothing where there is no depth.
pub(super) fn classes(depth_m: &[f32], ids: &[u16], of_id: &[u8], out: &mut Vec<u8>) {
    out.clear();
    let pixels = depth_m.iter().zip(ids);
    out.extend(pixels.map(|(&z_m, &id)| if z_m > 0.0 { of_id[usize::from(id)] } else { NOTHING }));
}

/// Expected and median depth are of one surface within this. [m], and of the depth.
const SAME_M: f32 = 0.02;
const SAME: f32 = 0.02;
/// Slopes are taken so far to each side: over one pixel splats show. [px]
const REACH: usize = 2;
/// A step of 1 / z that is more than this share of it a pixel is an edge: a floor 1.2 m below is one surface up to where it is
/// 12 pixels below the horizon.
const STEEPEST: f32 = 0.08;
/// What is nearer in the next image is behind its camera. [m, cam]
const NEAREST_M: f32 = 0.02;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec2, DVec3};

    fn camera() -> Intrinsics {
        Intrinsics { cx_px: 30.0, cy_px: 25.5, ..Intrinsics::from_horizontal_fov(64, 48, 1.4) }
    }

    /// Depth of the plane `normal . p = offset`. [m]
    fn plane(k: &Intrinsics, normal: DVec3, offset_m: f64) -> Vec<f32> {
        let pixel = |n: u32| {
            let at = DVec2::new(f64::from(n % 64) + 0.5, f64::from(n / 64) + 0.5);
            let ray = k.unproject(at, 1.0).unwrap();
            (offset_m / normal.dot(ray)) as f32
        };
        (0..64 * 48).map(pixel).collect()
    }

    #[test]
    fn a_planes_normals_are_its_own() {
        let k = camera();
        let mut bytes = Vec::new();
        for normal in [DVec3::NEG_Z, DVec3::new(0.3, -0.5, -1.0), DVec3::new(-0.6, 0.1, -0.7)] {
            let normal = normal.normalize();
            normals(&k, &plane(&k, normal, -3.0), &mut bytes);
            for (n, bytes) in (0u32..).zip(bytes.chunks_exact(3)) {
                let at = DVec2::new(f64::from(n % 64) + 0.5, f64::from(n / 64) + 0.5);
                let ray = k.unproject(at, 1.0).unwrap().normalize();
                // Beside the plane's vanishing line 1 / z changes by too much from pixel to pixel to be one surface.
                if bytes == [0; 3] && normal.dot(ray).abs() < 0.2 {
                    continue;
                }
                let decoded =
                    DVec3::new(bytes[0].into(), bytes[1].into(), bytes[2].into()) / 127.5 - 1.0;
                assert!(
                    (decoded - normal).length() < 0.012,
                    "pixel {n}: {decoded} is not {normal}"
                );
            }
        }
    }

    #[test]
    fn edges_do_not_bend_normals_and_nothing_has_none() {
        let k = camera();
        let mut depth_m = plane(&k, DVec3::NEG_Z, -3.0);
        for (n, z_m) in depth_m.iter_mut().enumerate() {
            match n % 64 {
                0..20 => *z_m = 1.0,
                60.. => *z_m = 0.0,
                _ => {}
            }
        }
        let mut bytes = Vec::new();
        normals(&k, &depth_m, &mut bytes);
        for (n, bytes) in bytes.chunks_exact(3).enumerate() {
            let expected = if n % 64 >= 60 { [0, 0, 0] } else { [128, 128, 0] };
            assert_eq!(bytes, expected, "pixel {}", n % 64);
        }
    }

    #[test]
    fn flow_leads_to_where_points_are_next() {
        let k = camera();
        let depth_m = plane(&k, DVec3::new(0.1, -0.4, -1.0), -2.0);
        let next_from_cam: Pose<Cam, Cam> =
            Pose::new(DVec3::new(0.05, -0.02, -0.1), DQuat::from_rotation_y(0.03));
        let of_mover: Pose<Cam, Cam> = Pose::new(DVec3::new(0.3, 0.0, 0.0), DQuat::IDENTITY);
        let ids: Vec<u16> = (0..64 * 48).map(|n| u16::from(n % 64 > 40) * 5).collect();
        let mut encoded = Vec::new();
        flow(&k, &depth_m, &ids, &next_from_cam, &[(5, of_mover)], &mut encoded);
        for (n, flow) in encoded.chunks_exact(3).enumerate() {
            assert_eq!(flow[2], 1);
            let at = DVec2::new((n % 64) as f64 + 0.5, (n / 64) as f64 + 0.5);
            let p_cam = k.unproject(at, f64::from(depth_m[n])).unwrap();
            let motion = if ids[n] == 5 { of_mover } else { next_from_cam };
            let expected = k.project(motion.transform_point(p_cam)).unwrap() - at;
            let decoded = DVec2::new(f64::from(flow[0]), f64::from(flow[1])) / 64.0 - 512.0;
            assert!((decoded - expected).length() < 0.02, "{decoded} is not {expected}");
        }
    }

    #[test]
    fn flow_is_not_where_nothing_is_or_behind_the_camera() {
        let k = camera();
        let mut depth_m = plane(&k, DVec3::NEG_Z, -2.0);
        depth_m[7] = 0.0;
        let mut encoded = Vec::new();
        let back: Pose<Cam, Cam> = Pose::new(DVec3::Z * 1.0, DQuat::IDENTITY);
        flow(&k, &depth_m, &vec![0; depth_m.len()], &back, &[], &mut encoded);
        assert_eq!(encoded[3 * 7..3 * 8], [0, 0, 0]);
        assert_eq!(encoded[2], 1);
        let through: Pose<Cam, Cam> = Pose::new(DVec3::Z * -2.5, DQuat::IDENTITY);
        flow(&k, &depth_m, &vec![0; depth_m.len()], &through, &[], &mut encoded);
        assert!(encoded.iter().all(|&value| value == 0));
    }

    #[test]
    fn depth_is_smooth_on_a_surface_and_sharp_at_edges() {
        let mut image = RgbdImage::default();
        image.resize(4, 1);
        image.alpha = vec![1.0, 1.0, 0.4, 1.0];
        image.depth_median_m = vec![2.0, 2.0, 2.0, f32::NAN];
        image.depth_expected_m = vec![2.03, 3.0, 2.0, 2.0];
        let mut depth_m = Vec::new();
        surface_depth(&image, &mut depth_m);
        assert_eq!(depth_m, [2.03, 2.0, 0.0, 0.0]);
        let mut mm = Vec::new();
        depth_mm(&[1.2344, 70.0, 0.0], &mut mm);
        assert_eq!(mm, [1234, 0, 0]);
        let mut labels = Vec::new();
        classes(&depth_m, &[0, 1, 1, 0], &[1, 9], &mut labels);
        assert_eq!(labels, [1, 9, 0, 0]);
    }
}
