//! Gaussians to occupied voxels.
//!
//! Budget: 130 k splats into 21 M voxels in well under 3 s on two cores; one byte a voxel, and a
//! few MB of scratch. Bound by the voxels each splat's extent touches.
//!
//! 1. Each splat that is opaque enough becomes a quadratic form in voxel units, widened by
//!    [`WIDENING`] so that a surface thinner than a voxel is still seen at voxel centres.
//! 2. Slabs of x planes in parallel: transmittance at a voxel's centre is the product of
//!    `1 - alpha` over the splats within [`CUTOFF`] standard deviations; opaque enough is occupied.
//! 3. Floaters of training go: small isolated components, and those that hang in the air with few
//!    splats for their volume (a blob of haze). Small enclosed voids (the inside of a trunk) become
//!    solid.
//! 4. Space that the capture has not seen becomes solid, where the arena wants it.
//! 5. The band above the floor takes what stands above it: grass and litter vanish, trunks keep
//!    their feet. The floor itself is a plane, no voxels.
//!
//! Where the surface comes to lie: for a wall of discs of standard deviation s across, the field
//! at distance z from the plane is at least `1 - (1 - a exp(-z^2 / 2 w^2))` with
//! `w^2 = s^2 + (0.35 voxel)^2`, and nothing beyond `2 w`. With a = 0.9 and one to eight splats
//! overlapping, opacity 0.5 is crossed at 1.1 w to 2 w, that is 0.4 to 0.7 voxels for a thin disc:
//! a layer without holes whose faces lie within one voxel of the plane.

use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DVec3, Mat3, Quat, Vec3};
use rayon::prelude::*;

use crate::config::ArenaConfig;
use crate::grid::Grid;
use crate::seen::SeenAt;

mod components;
mod object;

use components::{Component, Connectivity, Runs};

/// A Gaussian as the baker needs it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ellipsoid {
    /// Centre. [m, world]
    pub center_m: Vec3,
    /// Standard deviations along its own axes. [m]
    pub scales_m: Vec3,
    /// Its axes in the world; unit.
    pub rotation: Quat,
    /// Peak opacity, 0 to 1.
    pub opacity: f32,
}

/// What to bake into.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BakeSpec {
    /// The voxels.
    pub grid: Grid,
    /// Splats fainter than this are no obstacle, 0 to 1.
    pub min_opacity: f32,
    /// Height of the floor. [m, world]
    pub floor_z_m: f64,
    /// What hangs in the air with fewer splats in its volume is a floater; 0 keeps all. [1/m^3]
    pub min_splats_per_m3: f32,
}

impl BakeSpec {
    /// Returns what an arena asks for: voxels from the floor up in the geofence and a margin.
    pub fn of(config: &ArenaConfig) -> Self {
        let occupancy = &config.occupancy;
        let mut min_m = config.geofence.min_m - MARGIN_M;
        min_m.z = min_m.z.max(occupancy.floor_z_m);
        let max_m = config.geofence.max_m + MARGIN_M;
        Self {
            grid: Grid::covering(min_m, max_m, occupancy.voxel_m),
            min_opacity: occupancy.min_opacity as f32,
            floor_z_m: occupancy.floor_z_m,
            min_splats_per_m3: occupancy.min_splats_per_m3 as f32,
        }
    }
}

/// What the baker did, for people and tests.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BakeCounts {
    /// Splats that count as obstacle and touch the grid.
    pub splats_used: usize,
    /// Splats left out: too faint, not finite, or outside.
    pub splats_left_out: usize,
    /// Occupied voxels in the end.
    pub occupied: usize,
    /// Voxels of floaters removed.
    pub floating: usize,
    /// Voxels of enclosed voids made solid.
    pub enclosed: usize,
    /// Of the occupied, those that are as nobody has seen them free.
    pub unseen: usize,
}

/// Occupied and free voxels. The floor is not among them.
#[derive(Clone, Debug, PartialEq)]
pub struct OccupancyGrid {
    pub(crate) grid: Grid,
    /// 1 is occupied, 0 is free; in [`Grid::index`] order.
    pub(crate) cells: Vec<u8>,
    pub(crate) floor_z_m: f64,
    /// One bit a voxel, low bit first: occupied, but by nothing that was seen. Empty if nothing is.
    pub(crate) unseen: Vec<u8>,
    counts: BakeCounts,
}

impl OccupancyGrid {
    /// Bakes splats; what was not seen is free.
    pub fn bake(ellipsoids: impl IntoIterator<Item = Ellipsoid>, spec: &BakeSpec) -> Self {
        Self::bake_with(ellipsoids, spec, None, &|_| ())
    }

    /// Bakes splats; what is not `seen`, if that is given, is solid. `progress` is called with the share that is
    /// done, 0 to 1, from any thread.
    pub fn bake_with(
        ellipsoids: impl IntoIterator<Item = Ellipsoid>,
        spec: &BakeSpec,
        seen: Option<SeenAt<'_>>,
        progress: &(dyn Fn(f64) + Sync),
    ) -> Self {
        let grid = spec.grid;
        let mut counts = BakeCounts::default();
        let mut prepared = Vec::new();
        for ellipsoid in ellipsoids {
            match Prepared::new(&ellipsoid, spec) {
                Some(splat) => prepared.push(splat),
                None => counts.splats_left_out += 1,
            }
        }
        counts.splats_used = prepared.len();

        let mut cells = vec![0; grid.voxels()];
        progress(SPLATS_READ);
        splat_into(&prepared, &grid, &mut cells, &|share| {
            progress(SPLATS_READ + (SPLATS_LAID - SPLATS_READ) * share);
        });
        let mut runs = Runs::of(&cells, &grid, 1, Connectivity::Corners);
        for splat in &prepared {
            if let Some(voxel) = splat.voxel(&grid, &cells) {
                runs.count(voxel);
            }
        }
        drop(prepared);
        let floaters = Floaters::of(spec);
        counts.floating =
            runs.overwrite(&mut cells, 0, |component| floaters.contain(component, &grid));
        progress(FLOATERS_GONE);
        // A pocket within the unseen is as unknown as what is around it.
        let void = if seen.is_some() { UNSEEN } else { OCCUPIED };
        if let Some(seen) = seen {
            fill_unseen(&mut cells, &grid, seen);
        }
        stand_on_floor(&mut cells, spec);
        let void_voxels = (VOID_M3 / grid.voxel_m.powi(3)) as usize;
        counts.enclosed = Runs::of(&cells, &grid, 0, Connectivity::Faces).overwrite(
            &mut cells,
            void,
            |component| component.voxels < void_voxels,
        );
        let unseen = if seen.is_some() { take_unseen(&mut cells) } else { Vec::new() };
        counts.unseen = unseen.iter().map(|byte| byte.count_ones() as usize).sum();
        counts.occupied = cells.iter().map(|&cell| usize::from(cell)).sum();
        progress(1.0);
        Self { grid, cells, floor_z_m: spec.floor_z_m, unseen, counts }
    }

    /// Returns the voxels' places.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Returns what the baker did.
    pub fn counts(&self) -> BakeCounts {
        self.counts
    }

    /// Whether a voxel is occupied.
    pub fn is_occupied(&self, voxel: [usize; 3]) -> bool {
        self.cells[self.grid.index(voxel)] == 1
    }
}

/// What of the occupied is a leftover of training.
struct Floaters {
    /// Below this extent. [voxels]
    extent: usize,
    /// With fewer splats in a voxel, if it hangs in the air.
    splats_per_voxel: f32,
    /// Hanging means above this layer.
    floor_layers: usize,
}

impl Floaters {
    fn of(spec: &BakeSpec) -> Self {
        let voxel_m = spec.grid.voxel_m;
        Self {
            extent: (FLOATER_EXTENT_M / voxel_m).round() as usize,
            splats_per_voxel: spec.min_splats_per_m3 * voxel_m.powi(3) as f32,
            floor_layers: floor_layers(spec),
        }
    }

    /// Small, or a thin haze that touches neither the floor nor the end of what is known: there it
    /// may go on.
    fn contain(&self, component: &Component, grid: &Grid) -> bool {
        let hangs = component.low[2] as usize > self.floor_layers
            && component.low.iter().all(|&low| low > 0)
            && component.high.iter().zip(grid.size).all(|(&high, size)| (high as usize) < size);
        let sparse = (component.splats as f32) < self.splats_per_voxel * component.voxels as f32;
        component.extent() < self.extent || hangs && sparse
    }
}

/// A splat in voxel units relative to the grid's corner, with voxel centres at +0.5.
#[derive(Clone, Copy)]
struct Prepared {
    center: Vec3,
    /// Inverse of the widened covariance: xx, xy, xz, yy, yz, zz.
    form: [f32; 6],
    opacity: f32,
    /// Half sides of the box around the cut-off ellipsoid.
    half: Vec3,
}

impl Prepared {
    /// Returns `None` for a splat that is faint, not finite, or nowhere near the grid.
    fn new(ellipsoid: &Ellipsoid, spec: &BakeSpec) -> Option<Self> {
        let &Ellipsoid { center_m, scales_m, rotation, opacity } = ellipsoid;
        if !(opacity >= spec.min_opacity && opacity > 0.0) {
            return None;
        }
        let unit = (rotation.length_squared() - 1.0).abs() < 1e-2;
        if !(center_m.is_finite() && scales_m.is_finite() && rotation.is_finite() && unit) {
            return None;
        }
        let voxel_m = spec.grid.voxel_m;
        let center = ((center_m.as_dvec3() - spec.grid.min_m) / voxel_m).as_vec3();
        let scales = scales_m.abs() / voxel_m as f32;
        let variances = scales * scales + WIDENING * WIDENING;
        let axes = Mat3::from_quat(rotation);
        let squares = Mat3::from_diagonal(variances);
        let covariance = axes * squares * axes.transpose();
        let inverse = axes * Mat3::from_diagonal(variances.recip()) * axes.transpose();
        let half = CUTOFF * covariance.diagonal().max(Vec3::ZERO).map(f32::sqrt);
        let size = Vec3::from_array(spec.grid.size.map(|n| n as f32));
        let (low, high) = (center - half, center + half);
        // Positively stated, so that an overflow to infinity or NaN fails.
        if !(high.cmpgt(Vec3::ZERO).all() && low.cmplt(size).all() && half.is_finite()) {
            return None;
        }
        let form = [
            inverse.x_axis.x,
            inverse.y_axis.x,
            inverse.z_axis.x,
            inverse.y_axis.y,
            inverse.z_axis.y,
            inverse.z_axis.z,
        ];
        // Fully opaque would make transmittance 0 and no second splat matter; harmless, but the
        // product stays positive this way.
        Some(Self { center, form, opacity: opacity.min(0.999), half })
    }

    /// Returns the occupied voxel that holds the centre, or one beside it: the middle of a thin disc
    /// may lie between voxel centres.
    fn voxel(&self, grid: &Grid, cells: &[u8]) -> Option<[usize; 3]> {
        let beside = [Vec3::ZERO, Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];
        let size = Vec3::from_array(grid.size.map(|n| n as f32));
        beside.into_iter().find_map(|aside| {
            let at = (self.center + aside).floor();
            let inside = at.cmpge(Vec3::ZERO).all() && at.cmplt(size).all();
            let voxel = at.to_array().map(|n| n as usize);
            (inside && cells[grid.index(voxel)] == 1).then_some(voxel)
        })
    }

    /// Returns the voxels whose centres lie between `low` and `high` on an axis of `size`.
    fn span(center: f32, half: f32, size: usize) -> std::ops::Range<usize> {
        let first = (center - half - 0.5).ceil().max(0.0) as usize;
        let end = ((center + half - 0.5).floor() + 1.0).max(0.0) as usize;
        first.min(size)..end.min(size)
    }

    /// Multiplies this splat's `1 - alpha` into the planes `x_range` of a slab that starts at
    /// `x_start`.
    fn attenuate(&self, grid: &Grid, x_start: usize, planes: usize, transmittance: &mut [f32]) {
        let [xx, xy, xz, yy, yz, zz] = self.form;
        let xs = Self::span(self.center.x, self.half.x, grid.size[0]);
        for x in xs.start.max(x_start)..xs.end.min(x_start + planes) {
            let dx = x as f32 + 0.5 - self.center.x;
            for y in Self::span(self.center.y, self.half.y, grid.size[1]) {
                let dy = y as f32 + 0.5 - self.center.y;
                // The form along z: zz dz^2 + 2 b dz + c, at most CUTOFF^2 between its roots.
                let b = xz * dx + yz * dy;
                let c = xx * dx * dx + 2.0 * xy * dx * dy + yy * dy * dy;
                let discriminant = b * b - zz * (c - CUTOFF * CUTOFF);
                if !(discriminant >= 0.0) {
                    continue;
                }
                let (middle, reach) = (self.center.z - b / zz, discriminant.sqrt() / zz);
                let column = ((x - x_start) * grid.size[1] + y) * grid.size[2];
                for z in Self::span(middle, reach, grid.size[2]) {
                    let dz = z as f32 + 0.5 - self.center.z;
                    let distance = (zz * dz + 2.0 * b) * dz + c;
                    transmittance[column + z] *= 1.0 - self.opacity * (-0.5 * distance).exp();
                }
            }
        }
    }
}

/// Marks voxels whose centre is opaque.
fn splat_into(splats: &[Prepared], grid: &Grid, cells: &mut [u8], progress: &(dyn Fn(f64) + Sync)) {
    let slabs = grid.size[0].div_ceil(SLAB_PLANES);
    let slabs_of = |splat: &Prepared| {
        let xs = Prepared::span(splat.center.x, splat.half.x, grid.size[0]);
        xs.start / SLAB_PLANES..xs.end.div_ceil(SLAB_PLANES)
    };
    // Which splats touch which slab: counted, then filled in place.
    let mut starts = vec![0usize; slabs + 1];
    for splat in splats {
        for slab in slabs_of(splat) {
            starts[slab + 1] += 1;
        }
    }
    for slab in 0..slabs {
        starts[slab + 1] += starts[slab];
    }
    let mut next = starts.clone();
    let mut members = vec![0u32; starts[slabs]];
    for (index, splat) in splats.iter().enumerate() {
        for slab in slabs_of(splat) {
            members[next[slab]] = index as u32;
            next[slab] += 1;
        }
    }
    let done = AtomicUsize::new(0);
    cells.par_chunks_mut(SLAB_PLANES * grid.plane()).enumerate().for_each_init(
        Vec::new,
        |transmittance: &mut Vec<f32>, (slab, cells)| {
            let before = done.fetch_add(1, Ordering::Relaxed);
            progress(before as f64 / slabs as f64);
            let members = &members[starts[slab]..starts[slab + 1]];
            if members.is_empty() {
                return;
            }
            transmittance.clear();
            transmittance.resize(cells.len(), 1.0);
            let planes = cells.len() / grid.plane();
            for &member in members {
                let splat = &splats[member as usize];
                splat.attenuate(grid, slab * SLAB_PLANES, planes, transmittance);
            }
            for (cell, &left) in cells.iter_mut().zip(transmittance.iter()) {
                *cell = u8::from(left <= 1.0 - OPAQUE);
            }
        },
    );
}

/// Fills what is free and was not seen.
fn fill_unseen(cells: &mut [u8], grid: &Grid, seen: SeenAt<'_>) {
    let [_, ny, nz] = grid.size;
    cells.par_chunks_mut(grid.plane()).enumerate().for_each(|(x, plane)| {
        for y in 0..ny {
            for z in 0..nz {
                let cell = &mut plane[y * nz + z];
                if *cell == 0 && !seen.is_seen(grid.center_m([x, y, z])) {
                    *cell = UNSEEN;
                }
            }
        }
    });
}

/// Makes the unseen occupied like all else; returns which they were, one bit a voxel, low bit first.
fn take_unseen(cells: &mut [u8]) -> Vec<u8> {
    let mut bits = vec![0; cells.len().div_ceil(8)];
    bits.par_iter_mut().zip(cells.par_chunks_mut(8)).for_each(|(bits, cells)| {
        for (n, cell) in cells.iter_mut().enumerate().filter(|(_, cell)| **cell == UNSEEN) {
            *cell = OCCUPIED;
            *bits |= 1 << n;
        }
    });
    bits
}

/// Gives the band above the floor what stands right above the band.
fn stand_on_floor(cells: &mut [u8], spec: &BakeSpec) {
    let layers = floor_layers(spec);
    for column in cells.chunks_exact_mut(spec.grid.size[2]) {
        let above = column[layers];
        column[..layers].fill(above);
    }
}

/// Returns how many layers lie in the band above the floor, by their centres.
fn floor_layers(spec: &BakeSpec) -> usize {
    let grid = &spec.grid;
    let band_top_m = spec.floor_z_m + FLOOR_BAND_M;
    let layers = ((band_top_m - grid.min_m.z) / grid.voxel_m - 0.5).ceil().max(0.0) as usize;
    layers.min(grid.size[2] - 1)
}

/// A voxel with something in it.
const OCCUPIED: u8 = 1;
/// While baking: one that is solid as nobody has seen it.
const UNSEEN: u8 = 2;
/// Standard deviation by which splats are widened, so that a thin surface leaves no holes between
/// voxel centres; see the module's text. [voxels]
const WIDENING: f32 = 0.35;
/// Extent of a splat: what lies further out (13 % of its peak) never adds up to an obstacle.
/// [standard deviations]
const CUTOFF: f32 = 2.0;
/// A voxel is occupied when this part of the light would stop there: the renderer's median depth
/// takes the same level.
const OPAQUE: f32 = 0.5;
/// Obstacles this far outside the geofence are baked too: the body's surface may touch the fence,
/// and a vehicle that left it still wants to know. [m]
const MARGIN_M: f64 = 0.5;
/// Parts of the work that are done with the splats read, laid into voxels, and the floaters gone.
const SPLATS_READ: f64 = 0.1;
const SPLATS_LAID: f64 = 0.8;
const FLOATERS_GONE: f64 = 0.9;
/// Occupied components whose largest side is shorter are floaters of training. [m]
const FLOATER_EXTENT_M: f64 = 0.25;
/// Free components smaller than this are voids inside something solid. [m^3]
const VOID_M3: f64 = 1.0;
/// Grass and litter stay below this height above the floor. [m]
pub const FLOOR_BAND_M: f64 = 0.3;
/// x planes that one task bakes: 8 of 280 x 90 voxels are 0.8 MB of transmittance, in cache.
const SLAB_PLANES: usize = 8;

/// Returns a grid whose voxels are occupied where `solid` is true of the centre; for tests and benches.
pub fn occupancy_of(grid: Grid, floor_z_m: f64, solid: impl Fn(DVec3) -> bool) -> OccupancyGrid {
    let [nx, ny, nz] = grid.size;
    let mut cells = Vec::with_capacity(grid.voxels());
    for x in 0..nx {
        for y in 0..ny {
            for z in 0..nz {
                cells.push(u8::from(solid(grid.center_m([x, y, z]))));
            }
        }
    }
    let occupied = cells.iter().map(|&cell| usize::from(cell)).sum();
    let counts = BakeCounts { occupied, ..Default::default() };
    OccupancyGrid { grid, cells, floor_z_m, unseen: Vec::new(), counts }
}

#[cfg(test)]
mod tests;
