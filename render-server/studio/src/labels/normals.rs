//! Surface normals from depth.
//!
//! On a plane, 1 / z is linear in pixels (with `n . p = d` and p = z (x, y, 1): 1 / z = n . (x, y, 1) / d). Therefore,
//! the slopes of 1 / z define the normal. They are found by a least-squares fit to the surrounding pixels: the depth of
//! each splat is off by some percent of the distance, and only a window of several splats has the slope of the wall.

use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_splat::simd::{InstructionSet, Kernel, Simd};

/// Computation of normals, with buffers that are reused.
#[derive(Debug)]
pub struct Normals {
    instructions: InstructionSet,
    /// 1 / z with a border of [`REACH`] empty rows and columns, and rows padded for vector reads. [1/m]
    inverse: Vec<f32>,
    /// Encoded normals of a row, for each axis; NaN for none.
    row: [Vec<f32>; 3],
}

impl Default for Normals {
    fn default() -> Self {
        let fastest = InstructionSet::available()[0];
        Self { instructions: fastest, inverse: Vec::new(), row: [const { Vec::new() }; 3] }
    }
}

impl Normals {
    /// Writes unit normals towards the camera, H x W x 3, with each axis of `cam` encoded as `round(127.5 (n + 1))`;
    /// black for none. `depth_m` is along the optical axis, H x W, 0 for none. [m, cam]
    pub fn write(&mut self, k: &Intrinsics, depth_m: &[f32], out: &mut Vec<u8>) {
        let (width, height) = (k.width_px as usize, k.height_px as usize);
        let across = width.next_multiple_of(MOST_LANES);
        let pitch = across + 2 * REACH;
        self.inverse.clear();
        self.inverse.resize(pitch * (height + 2 * REACH), 0.0);
        for (row, depth_m) in
            self.inverse.chunks_exact_mut(pitch).skip(REACH).zip(depth_m.chunks_exact(width))
        {
            for (inverse, &z_m) in row[REACH..].iter_mut().zip(depth_m) {
                *inverse = if z_m > 0.0 { 1.0 / z_m } else { 0.0 };
            }
        }
        for row in &mut self.row {
            row.resize(across, 0.0);
        }
        out.clear();
        out.resize(3 * depth_m.len(), 0);
        for (y, out) in out.chunks_exact_mut(3 * width).enumerate() {
            let rows = &self.inverse[y * pitch..(y + 1 + 2 * REACH) * pitch];
            let [nx, ny, nz] = &mut self.row;
            self.instructions.run(Row { k, y, rows, pitch, out: [nx, ny, nz] });
            let pixels = nx.iter().zip(&*ny).zip(&*nz);
            for (out, ((nx, ny), nz)) in out.chunks_exact_mut(3).zip(pixels) {
                // NaN becomes 0.
                out.copy_from_slice(&[*nx as u8, *ny as u8, *nz as u8]);
            }
        }
    }
}

/// Kernel that fits a plane at each pixel of a row.
struct Row<'a> {
    k: &'a Intrinsics,
    y: usize,
    /// 1 / z of the row and the rows around it.
    rows: &'a [f32],
    pitch: usize,
    out: [&'a mut [f32]; 3],
}

impl Kernel for Row<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { k, y, rows, pitch, mut out } = self;
        let [fx, fy, cx, cy] = [k.fx_px, k.fy_px, k.cx_px, k.cy_px].map(|value| value as f32);
        let at_y = s.splat((y as f32 + 0.5 - cy) / fy);
        let mut middles = [0.0; MOST_LANES];
        for (n, middle) in middles.iter_mut().enumerate() {
            *middle = n as f32 + 0.5 - cx;
        }
        let middles = s.load(&middles);
        let zero = s.splat(0.0);
        for x in (0..out[0].len()).step_by(S::LANES) {
            let here = s.load(&rows[REACH * pitch + REACH + x..]);
            let step = here * s.splat(STEP);
            // Sums over the window of the products of horizontal steps, vertical steps, and changes of 1 / z.
            let (mut xx, mut xy, mut yy, mut xz, mut yz) = (zero, zero, zero, zero, zero);
            for &(dx, dy) in &AROUND {
                let start = ((REACH as i32 + dy) * pitch as i32 + REACH as i32 + dx) as usize + x;
                let change = s.load(&rows[start..]) - here;
                let same = s.lt(s.negative(step), change) & s.lt(change, step);
                let change = s.keep(same, change);
                let (dx, dy) = (dx as f32, dy as f32);
                xz = s.mul_add(change, s.splat(dx), xz);
                yz = s.mul_add(change, s.splat(dy), yz);
                xx = xx + s.keep(same, s.splat(dx * dx));
                xy = xy + s.keep(same, s.splat(dx * dy));
                yy = yy + s.keep(same, s.splat(dy * dy));
            }
            // Slopes times the determinant, which cancels in the normalization.
            let determinant = xx * yy - xy * xy;
            let a = (yy * xz - xy * yz) * s.splat(fx);
            let b = (xx * yz - xy * xz) * s.splat(fy);
            let at_x = (middles + s.splat(x as f32)) / s.splat(fx);
            let c = determinant * here - a * at_x - b * at_y;
            let length = s.sqrt(a * a + b * b + c * c);
            // Pixels on one line define no plane. The comparison is safe because sums of integers are exact.
            let is_plane = s.lt(s.splat(0.5), determinant);
            let scale = s.select(is_plane, s.splat(-127.5) / length, s.splat(f32::NAN));
            for (axis, out) in [a, b, c].into_iter().zip(&mut out) {
                s.store(s.mul_add(axis, scale, s.splat(128.0)), &mut out[x..]);
            }
        }
    }
}

/// Radius of the window. [px]
const REACH: usize = 5;
/// Offsets of the window: every other pixel of a disc, because using all hardly improves normals.
const AROUND: [(i32, i32); 44] = around();
/// Lanes of the widest instruction set.
const MOST_LANES: usize = 16;
/// A relative change of 1 / z above this is an edge: a floor 1.2 m below is one surface up to 12 pixels below the
/// horizon.
const STEP: f32 = 0.08;

const fn around() -> [(i32, i32); 44] {
    let reach = REACH as i32;
    let mut around = [(0, 0); 44];
    let mut count = 0;
    let mut n = 0;
    while n < (2 * reach + 1) * (2 * reach + 1) {
        let (x, y) = (n % (2 * reach + 1) - reach, n / (2 * reach + 1) - reach);
        if x * x + y * y <= reach * reach && (x + y) % 2 != 0 {
            around[count] = (x, y);
            count += 1;
        }
        n += 1;
    }
    around
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, DVec3};

    use super::*;
    use crate::labels::flow::tests::{camera, plane};

    fn normals(k: &Intrinsics, depth_m: &[f32], out: &mut Vec<u8>) {
        Normals::default().write(k, depth_m, out);
    }

    #[test]
    fn computes_the_normals_of_planes() {
        let k = camera();
        let mut bytes = Vec::new();
        for normal in [DVec3::NEG_Z, DVec3::new(0.3, -0.5, -1.0), DVec3::new(-0.6, 0.1, -0.7)] {
            let normal = normal.normalize();
            normals(&k, &plane(&k, normal, -3.0), &mut bytes);
            for (n, bytes) in (0u32..).zip(bytes.chunks_exact(3)) {
                let at = DVec2::new(f64::from(n % 64) + 0.5, f64::from(n / 64) + 0.5);
                let ray = k.unproject(at, 1.0).unwrap().normalize();
                // Near the vanishing line of the plane, 1 / z changes too much from pixel to pixel to be one surface.
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
    fn edges_do_not_change_normals_and_missing_depth_has_none() {
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
}
