//! Space that a capture has seen to be free: one bit a voxel, in a file beside the scene.
//!
//! ```text
//! twin::carve -> SeenSpace -> scene.ply.seen -> OccupancyGrid: all else is solid, where the arena says so
//! ```
//! The voxels lie along the axes of the world as it was when the scene was carved, and the file says how the scene
//! lay then: a scene that is aligned anew takes what was seen of it along. It says the scene's hash too: of another
//! scene nothing is known.

mod file;

pub use file::SeenError;
use glam::{DMat3, DQuat, DVec3};

use crate::config::SceneConfig;
use crate::grid::Grid;

/// How a scene lies in the world: `metres_per_unit * (rotation * p) + origin_m`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScenePlace {
    /// The scene's axes to the world's; unit.
    pub rotation: DQuat,
    /// Length of the scene's unit. [m]
    pub metres_per_unit: f64,
    /// Where the scene's origin lies. [m, world]
    pub origin_m: DVec3,
}

impl ScenePlace {
    /// Returns the place that an arena gives its scene.
    pub fn of(scene: &SceneConfig) -> Self {
        Self {
            rotation: scene.rotation(),
            metres_per_unit: scene.metres_per_unit,
            origin_m: scene.origin_m,
        }
    }
}

/// Which voxels were seen to be free.
#[derive(Clone, Debug, PartialEq)]
pub struct SeenSpace {
    grid: Grid,
    /// As it was when the scene was carved.
    place: ScenePlace,
    /// SHA-256 of the scene's file.
    scene: [u8; 32],
    /// One bit a voxel in [`Grid::index`] order, low bit first; 1 is seen.
    bits: Vec<u8>,
}

impl SeenSpace {
    /// Returns what was seen of a scene: one bit a voxel in [`Grid::index`] order, low bit first.
    ///
    /// # Panics
    /// If there are not as many bytes as the voxels need.
    pub fn new(grid: Grid, place: ScenePlace, scene: [u8; 32], bits: Vec<u8>) -> Self {
        assert_eq!(bits.len(), grid.voxels().div_ceil(8), "one bit a voxel");
        Self { grid, place, scene, bits }
    }

    /// Returns the voxels' places, in the world as it was when the scene was carved.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Returns the SHA-256 of the scene's file that it was made for.
    pub fn scene(&self) -> &[u8; 32] {
        &self.scene
    }

    /// Returns how many voxels were seen.
    pub fn seen_voxels(&self) -> usize {
        self.bits.iter().map(|byte| byte.count_ones() as usize).sum()
    }

    /// Returns the look-up for a scene that lies at `place` now.
    pub fn at(&self, place: &ScenePlace) -> SeenAt<'_> {
        SeenAt { seen: self, then_from_now: then_from_now(&self.place, place) }
    }

    /// Whether the voxel with a point of the world of then was seen.
    fn is_seen(&self, p_then_m: DVec3) -> bool {
        let at = ((p_then_m - self.grid.min_m) / self.grid.voxel_m).floor();
        let size = DVec3::from(self.grid.size.map(|n| n as f64));
        // Positively stated, so that NaN is unseen.
        if !(at.cmpge(DVec3::ZERO).all() && at.cmplt(size).all()) {
            return false;
        }
        let index = self.grid.index([at.x as usize, at.y as usize, at.z as usize]);
        self.bits[index / 8] >> (index % 8) & 1 == 1
    }
}

/// What was seen of a scene, where the scene lies now.
#[derive(Clone, Copy, Debug)]
pub struct SeenAt<'a> {
    seen: &'a SeenSpace,
    /// `None` where nothing has moved.
    then_from_now: Option<(DMat3, DVec3)>,
}

impl SeenAt<'_> {
    /// Whether a point was seen to be free; what lies outside of all voxels was not. [m, world]
    pub fn is_seen(&self, p_m: DVec3) -> bool {
        match self.then_from_now {
            None => self.seen.is_seen(p_m),
            Some((turn, shift_m)) => self.seen.is_seen(turn * p_m + shift_m),
        }
    }
}

/// Returns what takes points of the world of now to the world of then.
fn then_from_now(then: &ScenePlace, now: &ScenePlace) -> Option<(DMat3, DVec3)> {
    if then == now {
        return None;
    }
    let turn = then.rotation * now.rotation.inverse();
    let scale = then.metres_per_unit / now.metres_per_unit;
    let matrix = DMat3::from_quat(turn) * scale;
    Some((matrix, then.origin_m - matrix * now.origin_m))
}
