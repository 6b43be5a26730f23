//! Cameras and sizes in the form of the shaders. Computed in f64 once per image, stored as f32.

use glam::{DMat3, DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Distortion, Frame, Intrinsics, Pose};
use zerocopy::{Immutable, IntoBytes};

use super::limits::TILE_PX;
use crate::limits::BLUR_PX2;
use crate::{Atmosphere, Camera};

/// `Tick` of `common.wgsl`.
#[derive(Clone, Copy, Debug, Default, IntoBytes, Immutable)]
#[repr(C)]
pub(super) struct Tick {
    pub(super) cameras: u32,
    pub(super) parts: u32,
    pub(super) blocks: u32,
    pub(super) tiles: u32,
    pub(super) regions: u32,
    pub(super) pairs: u32,
    pub(super) has_ids: u32,
    pub(super) max_error_px: f32,
}

/// `View` of `common.wgsl`, field by field.
#[derive(Clone, Copy, Debug, Default, IntoBytes, Immutable)]
#[repr(C)]
pub(super) struct GpuView {
    rows: [[f32; 4]; 3],
    focal: [f32; 4],
    slopes: [f32; 4],
    lens: [f32; 4],
    more: [f32; 4],
    background: [f32; 4],
    light: [f32; 4],
    fog: [f32; 4],
    size: [u32; 4],
    flags: [u32; 4],
    planes: [[f32; 4]; 5],
    weights: [[f32; 4]; 2],
}

const _: () = assert!(size_of::<Tick>() == 32 && size_of::<GpuView>() == 304);

/// Position of an image among the images of its tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ImageOffset {
    pub(super) first_tile: u32,
    pub(super) first_pixel: u32,
}

/// Values of a lens that are expensive to compute.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lens {
    slopes: [DVec2; 2],
    reach: f64,
}

/// Cache of lenses.
#[derive(Debug, Default)]
pub(super) struct Lenses {
    known: Vec<(Intrinsics, Lens)>,
}

/// Capacity of the cache. With more different cameras at once, lenses are recomputed for every image.
const MAX_LENSES: usize = 32;

impl Lenses {
    pub(super) fn of(&mut self, camera: &Camera) -> Lens {
        let k = &camera.intrinsics;
        if let Some((_, lens)) = self.known.iter().find(|(known, _)| known == k) {
            return *lens;
        }
        let lens = Lens { slopes: camera.slope_bounds(), reach: k.distortion.reach() };
        if self.known.len() >= MAX_LENSES {
            self.known.clear();
        }
        self.known.push((*k, lens));
        lens
    }
}

impl GpuView {
    /// Prepares a validated camera, for a part relative to which it has the pose `part_from_cam`.
    pub(super) fn new<F: Frame>(
        camera: &Camera,
        lens: &Lens,
        part_from_cam: &Pose<F, Cam>,
        place: ImageOffset,
        id: u16,
        antialiased: bool,
    ) -> Self {
        let k = &camera.intrinsics;
        let rotation = DMat3::from_quat(part_from_cam.rotation.normalize()).transpose();
        let center_m = part_from_cam.translation_m;
        let row = |i: usize| {
            let row = rotation.row(i).as_vec3();
            [row.x, row.y, row.z, center_m[i] as f32]
        };
        let [low, high] = lens.slopes;
        let (model, coefficients) = k.distortion.to_wire();
        let c = coefficients.map(|c| c as f32);
        // Infinite for a pinhole, for which the shader does not use it.
        let reach = lens.reach.min(f64::from(f32::MAX)) as f32;
        let (planes, weights) = planes(camera, lens, &rotation);
        let [r, g, b] = camera.atmosphere.background(camera.background);
        let Atmosphere { light, fog, fog_per_m } = camera.atmosphere;
        Self {
            rows: [row(0), row(1), row(2)],
            focal: [k.fx_px, k.fy_px, k.cx_px, k.cy_px].map(|v| v as f32),
            slopes: [low.x, low.y, high.x, high.y].map(|v| v as f32),
            lens: [c[0], c[1], c[2], c[3]],
            more: [c[4], reach, camera.near_m, f32::from(u8::from(antialiased))],
            background: [r, g, b, 0.0],
            light: [light[0], light[1], light[2], fog_per_m * std::f32::consts::LOG2_E],
            fog: [fog[0], fog[1], fog[2], 0.0],
            size: [k.width_px, k.height_px, k.width_px.div_ceil(TILE_PX), place.first_tile],
            flags: [u32::from(model), 1, place.first_pixel, u32::from(id)],
            planes,
            weights,
        }
    }

    /// Returns a view with only the size set: width, height [px], tiles across, tiles.
    pub(super) fn of_size([width, height, across, _]: [u32; 4]) -> Self {
        Self { size: [width, height, across, 0], ..Self::default() }
    }

    /// Returns the view of an absent part.
    pub(super) fn absent() -> Self {
        Self::default()
    }
}

/// Returns the planes `normal . (p - camera) + reach * weight >= offset` between which a splat may touch the image:
/// normals with offsets, and weights.
fn planes(camera: &Camera, lens: &Lens, rotation: &DMat3) -> ([[f32; 4]; 5], [[f32; 4]; 2]) {
    let k = &camera.intrinsics;
    let [x, y, z] = [rotation.row(0), rotation.row(1), rotation.row(2)];
    // The first plane is the near plane, which applies to the centres only.
    let mut planes = [[z.x as f32, z.y as f32, z.z as f32, camera.near_m]; 5];
    let mut weights = [[0f32; 4]; 2];
    if k.distortion != Distortion::None {
        // A lens bends the border of the image: everything in front of the camera is projected.
        return (planes, weights);
    }
    // A splat's mean is at u = fx x/z + cx; its extent is at most
    //   sqrt(reach^2 fx^2 (1 + jx^2) / z^2 + 2 ln(255) 0.3),
    // with jx the clamped slope. Both sides times z > 0 are linear in the position: u + extent
    // >= 0 becomes fx x + (cx + blur) z + reach fx sqrt(1 + jx^2) >= 0, and so on.
    let blur = (2.0 * 255f64.ln() * BLUR_PX2).sqrt();
    let [low, high] = lens.slopes;
    let steepest = low.abs().max(high.abs());
    let steep_x = k.fx_px * (1.0 + steepest.x * steepest.x).sqrt();
    let steep_y = k.fy_px * (1.0 + steepest.y * steepest.y).sqrt();
    let (w, h) = (f64::from(k.width_px), f64::from(k.height_px));
    let sides: [(DVec3, f64); 4] = [
        (x * k.fx_px + z * (k.cx_px + blur), steep_x),
        (-x * k.fx_px + z * (w - k.cx_px + blur), steep_x),
        (y * k.fy_px + z * (k.cy_px + blur), steep_y),
        (-y * k.fy_px + z * (h - k.cy_px + blur), steep_y),
    ];
    for (i, (normal, weight)) in sides.into_iter().enumerate() {
        let length = normal.length();
        let n = (normal / length).as_vec3();
        planes[i + 1] = [n.x, n.y, n.z, 0.0];
        weights[(i + 1) / 4][(i + 1) % 4] = (weight / length) as f32;
    }
    (planes, weights)
}
