//! Space that a capture has seen to be free: one bit per voxel, in a file next to the scene.
//!
//! ```text
//! twin::carve -> SeenSpace -> scene.ply.seen -> OccupancyGrid: other space is solid, if the arena requires it
//! ```
//! The voxels are aligned with the world at the time of carving, and the file contains the scene's placement at
//! that time: if the scene is aligned again, the seen space moves with it. The file also contains the scene's
//! hash: it is invalid for any other scene.

mod file;

pub use file::SeenError;
use glam::{DMat3, DQuat, DVec3};

use crate::config::SceneConfig;
use crate::grid::Grid;

/// Placement of a scene in the world: `metres_per_unit * (rotation * p) + origin_m`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScenePlace {
    /// Rotation from the scene's axes to the world's; unit quaternion.
    pub rotation: DQuat,
    /// Length of the scene's unit. [m]
    pub metres_per_unit: f64,
    /// Position of the scene's origin. [m, world]
    pub origin_m: DVec3,
}

impl ScenePlace {
    /// Returns the placement of an arena's scene.
    pub fn of(scene: &SceneConfig) -> Self {
        Self {
            rotation: scene.rotation(),
            metres_per_unit: scene.metres_per_unit,
            origin_m: scene.origin_m,
        }
    }
}

/// Voxels that were seen to be free.
#[derive(Clone, Debug, PartialEq)]
pub struct SeenSpace {
    grid: Grid,
    /// Placement at the time of carving.
    place: ScenePlace,
    /// SHA-256 of the scene's file.
    scene: [u8; 32],
    /// One bit per voxel in [`Grid::index`] order, low bit first; 1 is seen.
    bits: Vec<u8>,
}

impl SeenSpace {
    /// Returns the seen space of a scene; `bits` has one bit per voxel in [`Grid::index`] order, low bit first.
    ///
    /// # Panics
    /// If the number of bytes does not match the number of voxels.
    pub fn new(grid: Grid, place: ScenePlace, scene: [u8; 32], bits: Vec<u8>) -> Self {
        assert_eq!(bits.len(), grid.voxels().div_ceil(8), "one bit a voxel");
        Self { grid, place, scene, bits }
    }

    /// Returns the grid of voxels, in the world at the time of carving.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Returns the SHA-256 of the scene's file.
    pub fn scene(&self) -> &[u8; 32] {
        &self.scene
    }

    /// Returns the number of seen voxels.
    pub fn seen_voxels(&self) -> usize {
        self.bits.iter().map(|byte| byte.count_ones() as usize).sum()
    }

    /// Returns the lookup for a scene that is now at `place`.
    pub fn at(&self, place: &ScenePlace) -> SeenAt<'_> {
        SeenAt { seen: self, then_from_now: then_from_now(&self.place, place) }
    }

    /// Whether the voxel that contains a point was seen. The point is in the world at the time of carving.
    fn is_seen(&self, p_then_m: DVec3) -> bool {
        let at = ((p_then_m - self.grid.min_m) / self.grid.voxel_m).floor();
        let size = DVec3::from(self.grid.size.map(|n| n as f64));
        // Stated positively, so that NaN is unseen.
        if !(at.cmpge(DVec3::ZERO).all() && at.cmplt(size).all()) {
            return false;
        }
        let index = self.grid.index([at.x as usize, at.y as usize, at.z as usize]);
        self.bits[index / 8] >> (index % 8) & 1 == 1
    }
}

/// Seen space of a scene at its present placement.
#[derive(Clone, Copy, Debug)]
pub struct SeenAt<'a> {
    seen: &'a SeenSpace,
    /// `None` if the placement has not changed.
    then_from_now: Option<(DMat3, DVec3)>,
}

impl SeenAt<'_> {
    /// Whether a point was seen to be free; points outside of the grid were not. [m, world]
    pub fn is_seen(&self, p_m: DVec3) -> bool {
        match self.then_from_now {
            None => self.seen.is_seen(p_m),
            Some((turn, shift_m)) => self.seen.is_seen(turn * p_m + shift_m),
        }
    }
}

/// Returns the transform from the present world to the world at the time of carving.
fn then_from_now(then: &ScenePlace, now: &ScenePlace) -> Option<(DMat3, DVec3)> {
    if then == now {
        return None;
    }
    let turn = then.rotation * now.rotation.inverse();
    let scale = then.metres_per_unit / now.metres_per_unit;
    let matrix = DMat3::from_quat(turn) * scale;
    Some((matrix, then.origin_m - matrix * now.origin_m))
}
