//! Optical flow from depth and the motion of camera and objects.

use glam::Mat3;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose};
use vizflyt_splat::simd::{InstructionSet, Kernel, Simd};

/// Computation of optical flow, with buffers that are reused.
#[derive(Debug)]
pub struct Flow {
    instructions: InstructionSet,
    /// Depth of a row, padded for vector reads. [m, cam]
    depth_m: Vec<f32>,
    /// Encoded flow of a row to the right and down.
    row: [Vec<f32>; 2],
}

impl Default for Flow {
    fn default() -> Self {
        let fastest = InstructionSet::available()[0];
        Self { instructions: fastest, depth_m: Vec::new(), row: [Vec::new(), Vec::new()] }
    }
}

impl Flow {
    /// Writes optical flow, H x W x 3, in the format of the KITTI benchmark (Geiger et al. 2012, development kit):
    /// `64 u + 2^15` and `64 v + 2^15` with 16 bits each, then 1 for valid flow and 0 for none. There is no flow if
    /// nothing was hit, if the point moves behind the camera, or if the flow exceeds 16 bits. Flow is the position of a
    /// pixel's surface in the next image, where it may be hidden.
    ///
    /// `depth_m` is along the optical axis, H x W, 0 for none [m, cam]; `ids` has the same pixels. `next_from_cam` is
    /// the motion of static surfaces, `of_id` that of moving objects by their ids. [next cam, cam]
    pub fn write(
        &mut self,
        k: &Intrinsics,
        depth_m: &[f32],
        ids: &[u16],
        next_from_cam: &Pose<Cam, Cam>,
        of_id: &[(u16, Pose<Cam, Cam>)],
        out: &mut Vec<u16>,
    ) {
        let width = k.width_px as usize;
        let across = width.next_multiple_of(MOST_LANES);
        self.depth_m.resize(across, 0.0);
        for row in &mut self.row {
            row.resize(across, 0.0);
        }
        out.clear();
        out.resize(3 * depth_m.len(), 0);
        let rows = out.chunks_exact_mut(3 * width).zip(depth_m.chunks_exact(width));
        for (y, ((out, depth_m), ids)) in rows.zip(ids.chunks_exact(width)).enumerate() {
            self.depth_m[..width].copy_from_slice(depth_m);
            self.row_of(k, y, next_from_cam, out, |_| true);
            for (id, next_from_cam) in of_id {
                if ids.contains(id) {
                    self.row_of(k, y, next_from_cam, out, |x| ids[x] == *id);
                }
            }
        }
    }

    /// Writes the pixels of a row that belong to one motion.
    fn row_of(
        &mut self,
        k: &Intrinsics,
        y: usize,
        next_from_cam: &Pose<Cam, Cam>,
        out: &mut [u16],
        is_of: impl Fn(usize) -> bool,
    ) {
        let depth_m = &self.depth_m;
        let [du, dv] = &mut self.row;
        self.instructions.run(Row { k, v: y as f32 + 0.5, next_from_cam, depth_m, out: [du, dv] });
        for (x, (out, (&du, &dv))) in out.chunks_exact_mut(3).zip(du.iter().zip(&*dv)).enumerate() {
            if is_of(x) {
                // No range contains NaN.
                let is_held = (0.0..65536.0).contains(&du) && (0.0..65536.0).contains(&dv);
                let flow = if is_held { [du as u16, dv as u16, 1] } else { [0; 3] };
                out.copy_from_slice(&flow);
            }
        }
    }
}

/// Kernel that computes the next positions of a row's points.
struct Row<'a> {
    k: &'a Intrinsics,
    /// Centre of the row. [px]
    v: f32,
    next_from_cam: &'a Pose<Cam, Cam>,
    depth_m: &'a [f32],
    /// Encoded flow; NaN for none.
    out: [&'a mut [f32]; 2],
}

impl Kernel for Row<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { k, v, next_from_cam, depth_m, out: [out_u, out_v] } = self;
        let [fx, fy, cx, cy] = [k.fx_px, k.fy_px, k.cx_px, k.cy_px].map(|value| value as f32);
        let rotation = Mat3::from_quat(next_from_cam.rotation.as_quat()).to_cols_array_2d();
        let moved_m = next_from_cam.translation_m.as_vec3().to_array();
        let slope_y = (v - cy) / fy;
        // A point with slope x and depth z moves to (x column + rest) z + moved.
        let rest = [0, 1, 2].map(|row| rotation[1][row] * slope_y + rotation[2][row]);
        let column = broadcast(s, rotation[0]);
        let rest = broadcast(s, rest);
        let moved_m = broadcast(s, moved_m);
        let mut steps = [0.0; MOST_LANES];
        for (n, step) in steps.iter_mut().enumerate() {
            *step = n as f32 + 0.5;
        }
        let steps = s.load(&steps);
        let nearest = s.splat(NEAREST_M);
        let none = s.splat(f32::NAN);
        for x in (0..depth_m.len()).step_by(S::LANES) {
            let u = steps + s.splat(x as f32);
            let slope_x = (u - s.splat(cx)) / s.splat(fx);
            let z_m = s.load(&depth_m[x..]);
            let mut next = moved_m;
            for (next, (column, rest)) in next.iter_mut().zip(column.into_iter().zip(rest)) {
                *next = s.mul_add(s.mul_add(slope_x, column, rest), z_m, *next);
            }
            let is_before = s.lt(s.splat(0.0), z_m) & s.lt(nearest, next[2]);
            let moved_u = s.mul_add(s.splat(fx), next[0] / next[2], s.splat(cx) - u);
            let moved_v = s.mul_add(s.splat(fy), next[1] / next[2], s.splat(cy - v));
            for (moved_px, out) in [(moved_u, &mut *out_u), (moved_v, &mut *out_v)] {
                let encoded = s.mul_add(moved_px, s.splat(64.0), s.splat(32768.5));
                s.store(s.select(is_before, encoded, none), &mut out[x..]);
            }
        }
    }
}

#[inline(always)]
fn broadcast<S: Simd>(s: S, v: [f32; 3]) -> [S::F; 3] {
    [s.splat(v[0]), s.splat(v[1]), s.splat(v[2])]
}

/// Lanes of the widest instruction set.
const MOST_LANES: usize = 16;
/// Minimum depth in the next image; points below it count as behind the camera. [m, cam]
const NEAREST_M: f32 = 0.02;

#[cfg(test)]
pub(crate) mod tests {
    use glam::{DQuat, DVec2, DVec3};

    use super::*;

    pub(crate) fn camera() -> Intrinsics {
        Intrinsics { cx_px: 30.0, cy_px: 25.5, ..Intrinsics::from_horizontal_fov(64, 48, 1.4) }
    }

    /// Returns the depth of the plane `normal . p = offset`. [m]
    pub(crate) fn plane(k: &Intrinsics, normal: DVec3, offset_m: f64) -> Vec<f32> {
        let pixel = |n: u32| {
            let at = DVec2::new(f64::from(n % 64) + 0.5, f64::from(n / 64) + 0.5);
            let ray = k.unproject(at, 1.0).unwrap();
            (offset_m / normal.dot(ray)) as f32
        };
        (0..64 * 48).map(pixel).collect()
    }

    fn flow(
        k: &Intrinsics,
        depth_m: &[f32],
        ids: &[u16],
        next_from_cam: &Pose<Cam, Cam>,
        of_id: &[(u16, Pose<Cam, Cam>)],
        out: &mut Vec<u16>,
    ) {
        Flow::default().write(k, depth_m, ids, next_from_cam, of_id, out);
    }

    #[test]
    fn flow_matches_the_projected_motion() {
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
    fn no_flow_without_depth_or_behind_the_camera() {
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
}
