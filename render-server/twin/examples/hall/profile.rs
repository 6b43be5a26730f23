//! Classifies a twin's occupied voxels: correct ones, surplus ones, and what the capture shows about the surplus ones.

use std::fmt;

use glam::DVec3;
use vizflyt_arena::OccupancyGrid;
use vizflyt_arena::grid::Grid;

use crate::capture::Capture;

/// Voxels by class, as fractions of the truly occupied ones.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Profile {
    /// Truly occupied, and occupied in the twin.
    pub(crate) found: f64,
    /// Truly occupied and visible to a photo, but free in the twin including its neighbours.
    pub(crate) missed: f64,
    /// Surplus next to a true voxel, and two voxels away: thick or displaced surfaces.
    pub(crate) beside: f64,
    pub(crate) near: f64,
    /// Surplus farther away: where two or more photos truly look through, where one does, behind the true surface in
    /// all photos, and outside all photos.
    pub(crate) open: f64,
    pub(crate) once: f64,
    pub(crate) behind: f64,
    pub(crate) outside: f64,
    /// Surplus farther away and above the fence.
    pub(crate) above: f64,
}

impl Profile {
    pub(crate) fn of(
        rebuilt: &OccupancyGrid,
        truth: &OccupancyGrid,
        grid: &Grid,
        capture: &Capture,
        top_m: f64,
    ) -> Self {
        let mut profile = Self::default();
        let [nx, ny, nz] = grid.size;
        let around = |grid: &OccupancyGrid, [x, y, z]: [usize; 3], reach: usize| {
            let range = |n: usize, size: usize| n.saturating_sub(reach)..(n + reach + 1).min(size);
            range(x, nx)
                .any(|x| range(y, ny).any(|y| range(z, nz).any(|z| grid.is_occupied([x, y, z]))))
        };
        let mut occupied = 0.0;
        for voxel in (0..nx * ny * nz).map(|n| [n / (ny * nz), n / nz % ny, n % nz]) {
            let (is, should) = (rebuilt.is_occupied(voxel), truth.is_occupied(voxel));
            if should {
                occupied += 1.0;
            }
            if !is && !should {
                continue;
            }
            let count = match (is, should) {
                (true, true) => &mut profile.found,
                (false, _) => {
                    if around(rebuilt, voxel, 1)
                        || looks(capture, grid.center_m(voxel), grid.voxel_m).0 == 0
                    {
                        continue;
                    }
                    &mut profile.missed
                }
                _ if around(truth, voxel, 1) => &mut profile.beside,
                _ if around(truth, voxel, 2) => &mut profile.near,
                _ => {
                    let center_m = grid.center_m(voxel);
                    if center_m.z > top_m {
                        profile.above += 1.0;
                    }
                    match looks(capture, center_m, grid.voxel_m) {
                        (2.., _) => &mut profile.open,
                        (1, _) => &mut profile.once,
                        (0, true) => &mut profile.behind,
                        (0, false) => &mut profile.outside,
                    }
                }
            };
            *count += 1.0;
        }
        let Self { found, missed, beside, near, open, once, behind, outside, above } = &mut profile;
        for count in [found, missed, beside, near, open, once, behind, outside, above] {
            *count /= occupied;
        }
        profile
    }
}

impl fmt::Display for Profile {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { found, missed, beside, near, open, once, behind, outside, above } = self;
        write!(
            out,
            "{found:.3} found, {missed:.3} missed; surplus {beside:.3} next to true ones, {near:.3} two voxels \
             off; further {open:.3} seen through, {once:.3} by one photo, {behind:.3} behind surfaces, {outside:.3} in no photo; {above:.3} \
             of these above the fence"
        )
    }
}

/// Returns the number of photos that truly look past a position by at least a voxel, and whether any photo contains it.
fn looks(capture: &Capture, p_m: DVec3, voxel_m: f64) -> (usize, bool) {
    let (mut through, mut shown) = (0, false);
    let k = &capture.intrinsics;
    for photo in &capture.photos {
        let p_cam = photo.world_from_cam.inverse().transform_point(p_m);
        let Some(at) = k.project(p_cam).filter(|_| p_cam.z > 0.05) else { continue };
        if !(at.x >= 0.0
            && at.y >= 0.0
            && at.x < f64::from(k.width_px)
            && at.y < f64::from(k.height_px))
        {
            continue;
        }
        shown = true;
        let pixel = at.y as usize * k.width_px as usize + at.x as usize;
        let depth_m = f64::from(photo.true_depth_m[pixel]);
        through += usize::from(depth_m == 0.0 || depth_m > p_cam.z + voxel_m);
    }
    (through, shown)
}
