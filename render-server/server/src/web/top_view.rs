//! Top view for the page's map, and the solid surface for its 3D view; computed once at the start.
//!
//! The image shows the twin straight from above, from a great distance (so that perspective is negligible), without
//! splats above the flight height, because crowns and ceilings would hide trunks and floor. The map overlays the solid
//! cells at flight height, one bit per cell.

use axum::body::Bytes;
use glam::{DMat3, DQuat, DVec2, DVec3};
use serde::Serialize;
use vizflyt_arena::{ArenaConfig, DistanceField};
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};
use vizflyt_rgbd::encode_jpeg;
use vizflyt_splat::{Atmosphere, Camera, CpuRenderer, Rasterizer, RgbdImage, Splats};

use super::twin::select;

/// Image and obstacles of the map.
#[derive(Clone, Debug, Default)]
pub struct TopView {
    /// JPEG, north up; empty if it could not be rendered.
    pub jpeg: Bytes,
    /// South-west corner of the picture. [m, world]
    pub min_m: [f64; 2],
    /// North-east corner of the picture. [m, world]
    pub max_m: [f64; 2],
    /// Solid cells at flight height.
    pub obstacles: Obstacles,
    /// Surface of all solid space: [`shell`].
    pub shell: Bytes,
}

impl TopView {
    /// Renders the top view of a scene for its flight height.
    pub(crate) fn render(splats: &Splats, arena: &ArenaConfig, field: &DistanceField) -> Self {
        let (min, max) = (arena.geofence.min_m.truncate(), arena.geofence.max_m.truncate());
        let flight_m = arena.spawn.position_m.z + arena.takeoff_height_m;
        let obstacles = Obstacles::scan(min, max, arena.occupancy.voxel_m, |p: DVec2| {
            field.obstacle_distance_m(p.extend(flight_m)) < 0.0
        });
        let jpeg = picture(splats, min, max, flight_m + MAP_HEADROOM_M);
        let (low, high) = (arena.geofence.min_m, arena.geofence.max_m);
        let shell = shell(low, high, arena.occupancy.voxel_m, |p| field.obstacle_distance_m(p));
        Self {
            shell,
            jpeg: jpeg.unwrap_or_default(),
            min_m: min.to_array(),
            max_m: max.to_array(),
            obstacles,
        }
    }
}

/// Grid of solid cells.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Obstacles {
    /// South-west corner. [m, world]
    origin_m: [f64; 2],
    /// Side of a cell. [m]
    cell_m: f64,
    /// Cells along x.
    width: usize,
    /// Cells along y.
    height: usize,
    /// Base64 of one bit per cell, least significant first, row by row from the south-west.
    bits: String,
}

impl Obstacles {
    /// Returns the solid cells of the rectangle from `min_m` to `max_m`, with cells of `cell_m` or coarser, so that no
    /// side has more than [`MAX_CELLS`].
    pub fn scan(
        min_m: DVec2,
        max_m: DVec2,
        cell_m: f64,
        mut solid: impl FnMut(DVec2) -> bool,
    ) -> Self {
        let span = max_m - min_m;
        let cell_m = cell_m.max(span.max_element() / MAX_CELLS as f64);
        let cells = |length: f64| ((length / cell_m).ceil() as usize).clamp(1, MAX_CELLS);
        let (width, height) = (cells(span.x), cells(span.y));
        let mut bits = vec![0u8; (width * height).div_ceil(8)];
        for y in 0..height {
            for x in 0..width {
                let p = min_m + (DVec2::new(x as f64, y as f64) + 0.5) * cell_m;
                if solid(p) {
                    let index = y * width + x;
                    bits[index / 8] |= 1 << (index % 8);
                }
            }
        }
        Self { origin_m: min_m.to_array(), cell_m, width, height, bits: base64(&bits) }
    }
}

/// Returns the surface of the solid space in a box, as cells for the page: little-endian, the box's lower corner and
/// the side of a cell as four f32 [m, world], then the index of each cell along x, y, z as u16. Cells are at least
/// `cell_m` wide, so that there are at most [`MAX_SHELL`].
///
/// `distance_m` returns the distance of a point to the nearest solid, correct within half of `cell_m`. [m, world]
pub fn shell(min_m: DVec3, max_m: DVec3, cell_m: f64, distance_m: impl Fn(DVec3) -> f64) -> Bytes {
    let span = (max_m - min_m).max(DVec3::splat(1e-3));
    let mut cell_m = cell_m.max((span.element_product() / MAX_SAMPLES).cbrt());
    cell_m = cell_m.max(span.max_element() / f64::from(u16::MAX));
    loop {
        let [nx, ny, nz] = (span / cell_m).ceil().to_array().map(|n| (n as usize).max(1));
        let at = |x: usize, y: usize, z: usize| (z * ny + y) * nx + x;
        let mut is_solid = vec![false; nx * ny * nz];
        for z in 0..nz {
            for y in 0..ny {
                let mut x = 0;
                while x < nx {
                    let p = min_m + (DVec3::new(x as f64, y as f64, z as f64) + 0.5) * cell_m;
                    let cells = distance_m(p) / cell_m;
                    is_solid[at(x, y, z)] = cells < 0.5;
                    // Cells within this distance are free too: skip them.
                    x += (cells - 1.5) as usize + 1;
                }
            }
        }
        let hidden = |x: usize, y: usize, z: usize| {
            let inside = x > 0 && y > 0 && z > 0 && x + 1 < nx && y + 1 < ny && z + 1 < nz;
            inside
                && [
                    at(x - 1, y, z),
                    at(x + 1, y, z),
                    at(x, y - 1, z),
                    at(x, y + 1, z),
                    at(x, y, z - 1),
                    at(x, y, z + 1),
                ]
                .iter()
                .all(|&neighbour| is_solid[neighbour])
        };
        let mut bytes = Vec::new();
        for value in [min_m.x, min_m.y, min_m.z, cell_m] {
            bytes.extend_from_slice(&(value as f32).to_le_bytes());
        }
        for z in 0..nz {
            for y in 0..ny {
                for x in (0..nx).filter(|&x| is_solid[at(x, y, z)] && !hidden(x, y, z)) {
                    for place in [x, y, z] {
                        bytes.extend_from_slice(&(place as u16).to_le_bytes());
                    }
                }
            }
        }
        if bytes.len() <= 16 + 6 * MAX_SHELL {
            return bytes.into();
        }
        cell_m *= 1.25;
    }
}

/// Returns the camera that looks straight down on the rectangle, north up, at `px_per_m`, and sees nothing above
/// `ceiling_m`.
fn camera_above(min_m: DVec2, max_m: DVec2, ceiling_m: f64, px_per_m: f64) -> Camera {
    let (span, middle) = (max_m - min_m, (min_m + max_m) / 2.0);
    let height_m = span.max_element() * DISTANCE;
    let side = |metres: f64| ((metres * px_per_m).round() as u32).clamp(16, MAX_SIDE_PX);
    let (width_px, height_px) = (side(span.x), side(span.y));
    // At the ceiling's height one metre is `px_per_m` pixels; the camera is `height_m` above it.
    let f_px = px_per_m * height_m;
    // Columns: the camera's axes in the world: right is east, down is south, forward is down.
    let axes = DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z);
    Camera {
        intrinsics: Intrinsics {
            width_px,
            height_px,
            fx_px: f_px,
            fy_px: f_px,
            cx_px: f64::from(width_px) / 2.0,
            cy_px: f64::from(height_px) / 2.0,
            distortion: Distortion::None,
        },
        world_from_cam: Pose::new(middle.extend(ceiling_m + height_m), DQuat::from_mat3(&axes)),
        near_m: height_m as f32,
        background: [0.05, 0.07, 0.09],
        atmosphere: Atmosphere::CLEAR,
    }
}

/// Renders the top view of the rectangle up to `ceiling_m` with a CPU renderer for the splats below: one image does not
/// justify a graphics device. Returns a JPEG, or nothing if rendering fails.
pub fn picture(splats: &Splats, min_m: DVec2, max_m: DVec2, ceiling_m: f64) -> Option<Bytes> {
    let span = max_m - min_m;
    let px_per_m = f64::from(WANTED_SIDE_PX) / span.max_element();
    let camera = camera_above(min_m, max_m, ceiling_m, px_per_m);
    let mut renderer = CpuRenderer::new(&below(splats, ceiling_m as f32));
    let mut images = [RgbdImage::default()];
    renderer.render(&[], &[camera], &mut images).ok()?;
    let mut rgb = Vec::new();
    images[0].write_rgb8(&mut rgb);
    let mut jpeg = Vec::new();
    encode_jpeg(&rgb, images[0].width_px, images[0].height_px, 85, &mut jpeg).ok()?;
    Some(jpeg.into())
}

/// Returns the splats with their centre below a height, in their constant colour, which is sufficient from straight
/// above.
fn below(splats: &Splats, ceiling_m: f32) -> Splats {
    let kept = (0..splats.len()).filter(|&k| splats.means_m[k].z < ceiling_m);
    select(splats, kept)
}

/// Returns bytes in base64 (RFC 4648).
pub fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let word = chunk.iter().fold(0u32, |word, &byte| word << 8 | u32::from(byte))
            << (8 * (3 - chunk.len()));
        for digit in 0..4 {
            if digit <= chunk.len() {
                text.push(DIGITS[(word >> (18 - 6 * digit) & 63) as usize] as char);
            } else {
                text.push('=');
            }
        }
    }
    text
}

/// Height of the camera, in longer sides of the map. A post of 1 m then leans by less than 3 cm.
const DISTANCE: f64 = 30.0;
/// Size of the image's longer side; larger maps have a coarser scale. [px]
const WANTED_SIDE_PX: u32 = 1200;
const MAX_SIDE_PX: u32 = 2048;
/// Takes tenths of a second to scan. [cells]
const MAX_SAMPLES: f64 = 400_000.0;
/// Rendered smoothly by a phone; 360 KB.
const MAX_SHELL: usize = 60_000;
/// At most 64 KB of bits.
const MAX_CELLS: usize = 720;

/// Splats up to this height above the flight are on the map. [m]
const MAP_HEADROOM_M: f64 = 0.4;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_matches_the_vectors_of_the_rfc() {
        // RFC 4648 section 10.
        let vectors = ["", "Zg==", "Zm8=", "Zm9v", "Zm9vYg==", "Zm9vYmE=", "Zm9vYmFy"];
        for (length, expected) in vectors.iter().enumerate() {
            assert_eq!(base64(&b"foobar"[..length]), *expected);
        }
    }

    #[test]
    fn obstacles_are_one_bit_per_cell_from_the_south_west() {
        let solid = |p: DVec2| p.x > 1.0 && p.y > 0.5;
        let found = Obstacles::scan(DVec2::ZERO, DVec2::new(2.0, 1.0), 0.5, solid);
        assert_eq!((found.width, found.height), (4, 2));
        // South row free; north row: the two eastern cells.
        assert_eq!(found.bits, base64(&[0b1100_0000]));
        let coarse = Obstacles::scan(DVec2::ZERO, DVec2::new(7200.0, 1.0), 0.1, solid);
        assert_eq!((coarse.width, coarse.height), (MAX_CELLS, 1));
    }

    #[test]
    fn a_shell_is_the_surface_of_solid_space() {
        // A cube of 5 x 5 x 5 cells in the middle of 9 x 9 x 9: 125 less the 27 inside.
        let cube = |p: DVec3| (p - 0.45).abs().max_element() - 0.2;
        let bytes = shell(DVec3::ZERO, DVec3::splat(0.9), 0.1, cube);
        let f32_at = |k: usize| f32::from_le_bytes(bytes[4 * k..4 * k + 4].try_into().unwrap());
        assert_eq!([f32_at(0), f32_at(1), f32_at(2), f32_at(3)], [0.0, 0.0, 0.0, 0.1]);
        assert_eq!((bytes.len() - 16) / 6, 125 - 27);
        assert_eq!(bytes[16..22], [2, 0, 2, 0, 2, 0]);
        // A large hall is rendered with coarser cells; an empty room is an empty list.
        let all = shell(DVec3::ZERO, DVec3::splat(500.0), 0.01, |_| -1.0);
        assert!(all.len() <= 16 + 6 * MAX_SHELL && all.len() > 1000);
        assert_eq!(shell(DVec3::ZERO, DVec3::ONE, 0.1, |_| 1.0).len(), 16);
        assert_eq!(shell(DVec3::ZERO, DVec3::ONE, 0.1, |_| f64::NAN).len(), 16);
    }

    #[test]
    fn a_shell_skips_free_space_and_misses_no_cell() {
        // Balls in a box of 8 x 5 x 3 m, at least one cell across; distances have an error of up to half a cell.
        let balls: Vec<_> = (0..60)
            .map(|k| {
                let r = |share: f64| (0.5 + share * f64::from(k)).fract();
                (DVec3::new(8.0 * r(0.819), 5.0 * r(0.671), 3.0 * r(0.549)), 0.05 + 0.3 * r(0.137))
            })
            .collect();
        let asked = std::cell::Cell::new(0);
        let noisy_m = |p: DVec3| {
            asked.set(asked.get() + 1);
            let off_m = 0.1 * ((p.x * 91.7 + p.y * 53.3 + p.z * 17.9).sin() / 2.0);
            off_m + balls.iter().map(|(c, r)| p.distance(*c) - r).fold(f64::MAX, f64::min)
        };
        let size_m = DVec3::new(8.0, 5.0, 3.0);
        let quick = shell(DVec3::ZERO, size_m, 0.1, noisy_m);
        let asked_quickly = asked.take();
        // Capped distances, so that no cell is skipped.
        let every = shell(DVec3::ZERO, size_m, 0.1, |p| noisy_m(p).min(0.2));
        assert_eq!(quick, every);
        assert_eq!(asked.get(), 80 * 50 * 30);
        assert!(asked_quickly < asked.get() / 2 && quick.len() > 1000, "{asked_quickly}");
    }

    #[test]
    fn the_camera_maps_the_corners_of_the_rectangle_to_the_corners_of_the_image() {
        let (min, max) = (DVec2::new(-1.0, -6.0), DVec2::new(42.0, 6.0));
        let camera = camera_above(min, max, 1.5, 20.0);
        let k = camera.intrinsics;
        let pixel = |x: f64, y: f64| {
            let p_cam = camera.world_from_cam.inverse().transform_point(DVec3::new(x, y, 1.5));
            k.project(p_cam).unwrap()
        };
        assert!((pixel(-1.0, 6.0) - DVec2::ZERO).length() < 1e-6);
        let corner = DVec2::new(f64::from(k.width_px), f64::from(k.height_px));
        assert!((pixel(42.0, -6.0) - corner).length() < 1e-6);
        assert_eq!(camera.validate(), Ok(()));
    }
}
