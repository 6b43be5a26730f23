//! Camera of a photo and its rendering options, in the form of the training shaders.

use glam::Vec3;
use zerocopy::{Immutable, IntoBytes};

use super::super::TILE_PX;

/// Pinhole camera and rendering options. Lengths have the unit of the rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Photo {
    /// Image width. [px]
    pub width: u32,
    /// Image height. [px]
    pub height: u32,
    /// Focal lengths. [px]
    pub focal: [f32; 2],
    /// Principal point. [px]
    pub center: [f32; 2],
    /// Rows of `cam_from_world`: right, down, forward. [world]
    pub axes: [Vec3; 3],
    /// Position of the camera. [world]
    pub position: Vec3,
    /// Minimum depth; closer rows are not visible.
    pub near: f32,
    /// Bounds of the slopes at which the projection is linearised, x and y.
    pub slopes: [[f32; 2]; 2],
    /// Degree of the harmonics to use, at most that of the rows.
    pub degree: u8,
    /// Whether splats smaller than a pixel are dimmed (mip-splatting).
    pub antialiased: bool,
}

/// `Photo` of `photo.wgsl`, field by field.
#[derive(Clone, Copy, Debug, IntoBytes, Immutable)]
#[repr(C)]
pub(super) struct GpuPhoto {
    axes: [[f32; 4]; 3],
    focal: [f32; 4],
    slopes: [f32; 4],
    /// Width, height [px], tiles across, tiles.
    pub(super) size: [u32; 4],
    rows: [u32; 4],
    near: [f32; 4],
}

/// Size of a [`GpuPhoto`]. [byte]
pub(super) const PHOTO_BYTES: usize = size_of::<GpuPhoto>();
const _: () = assert!(PHOTO_BYTES == 128);

impl Photo {
    /// Returns the number of tiles across and down.
    pub(super) fn tiles(&self) -> [u32; 2] {
        [self.width.div_ceil(TILE_PX), self.height.div_ceil(TILE_PX)]
    }

    /// Returns the number of values of a channel, padded to whole tiles.
    pub(super) fn plane(&self) -> u64 {
        let [across, down] = self.tiles();
        u64::from(across) * u64::from(down) * u64::from(TILE_PX * TILE_PX)
    }

    /// Returns the shaders' form for `count` rows of `stride` values.
    pub(super) fn packed(&self, count: u32, stride: u32) -> GpuPhoto {
        let axis = |k: usize| {
            let Vec3 { x, y, z } = self.axes[k];
            [x, y, z, self.position[k]]
        };
        let [[left, right], [top, bottom]] = self.slopes;
        let [across, down] = self.tiles();
        GpuPhoto {
            axes: [axis(0), axis(1), axis(2)],
            focal: [self.focal[0], self.focal[1], self.center[0], self.center[1]],
            slopes: [left, top, right, bottom],
            size: [self.width, self.height, across, across * down],
            rows: [count, stride, u32::from(self.degree), u32::from(self.antialiased)],
            near: [self.near, 0.0, 0.0, 0.0],
        }
    }
}
