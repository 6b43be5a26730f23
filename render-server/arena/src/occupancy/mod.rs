//! Baking: Gaussians to occupied voxels.
//!
//! Budget: 130 k splats into 21 M voxels in well under 3 s on two cores; one byte per voxel, and a few MB of
//! scratch memory. The time is limited by the number of voxels that each splat touches.
//!
//! 1. Each splat above the minimum opacity becomes a quadratic form in voxel units, widened by [`WIDENING`] so
//!    that voxel centres detect a surface thinner than a voxel.
//! 2. Slabs of x planes in parallel: the transmittance at a voxel's centre is the product of `1 - alpha` over
//!    the splats within [`CUTOFF`] standard deviations; below a limit, the voxel is occupied.
//! 3. Floaters of training are removed: small isolated components, and those that hang in the air with few
//!    splats for their volume (a blob of haze). Small enclosed voids (the inside of a trunk) become solid.
//! 4. Space that the capture has not seen becomes solid, if the arena requires it.
//! 5. The band above the floor copies the voxels directly above it: grass and litter vanish, trunks reach the
//!    floor. The floor itself is a plane, without voxels.
//!
//! Position of the surface: for a wall of discs of standard deviation s across, the field at distance z from
//! the plane is at least `1 - (1 - a exp(-z^2 / 2 w^2))` with `w^2 = s^2 + (0.35 voxel)^2`, and zero beyond
//! `2 w`. With a = 0.9 and one to eight overlapping splats, opacity 0.5 is crossed at 1.1 w to 2 w, that is 0.4 to
//! 0.7 voxels for a thin disc: a layer without holes whose faces are within one voxel of the plane.

use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DVec3, Mat3, Quat, Vec3};
use rayon::prelude::*;

use crate::config::ArenaConfig;
use crate::grid::Grid;
use crate::seen::SeenAt;

mod components;
mod object;

use components::{Component, Connectivity, Runs};

/// Gaussian, as input of the baker.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ellipsoid {
    /// Centre. [m, world]
    pub center_m: Vec3,
    /// Standard deviations along the Gaussian's own axes. [m]
    pub scales_m: Vec3,
    /// Rotation from the Gaussian's axes to the world's; unit quaternion.
    pub rotation: Quat,
    /// Peak opacity, 0 to 1.
    pub opacity: f32,
}

/// Parameters of baking.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BakeSpec {
    /// Voxels of the result.
    pub grid: Grid,
    /// Minimum opacity of a splat that counts as an obstacle, 0 to 1.
    pub min_opacity: f32,
    /// Height of the floor. [m, world]
    pub floor_z_m: f64,
    /// Minimum density of splats in a component that hangs in the air; below it, the component is a floater. 0
    /// keeps all. [1/m^3]
    pub min_splats_per_m3: f32,
}

impl BakeSpec {
    /// Returns the parameters for an arena: voxels from the floor up, in the geofence plus a margin.
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

/// Statistics of baking, for people and tests.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BakeCounts {
    /// Splats that count as obstacles and touch the grid.
    pub splats_used: usize,
    /// Splats skipped: too faint, not finite, or outside.
    pub splats_left_out: usize,
    /// Occupied voxels in the result.
    pub occupied: usize,
    /// Voxels of floaters removed.
    pub floating: usize,
    /// Voxels of enclosed voids made solid.
    pub enclosed: usize,
    /// Occupied voxels that are solid only because the capture has not seen them.
    pub unseen: usize,
}

/// Occupied and free voxels, without the floor.
#[derive(Clone, Debug, PartialEq)]
pub struct OccupancyGrid {
    pub(crate) grid: Grid,
    /// 1 is occupied, 0 is free; in [`Grid::index`] order.
    pub(crate) cells: Vec<u8>,
    pub(crate) floor_z_m: f64,
    /// One bit per voxel, low bit first: 1 is unseen and free of splats. Empty if there are none.
    pub(crate) unseen: Vec<u8>,
    counts: BakeCounts,
}

impl OccupancyGrid {
    /// Bakes splats; unseen space is free.
    pub fn bake(ellipsoids: impl IntoIterator<Item = Ellipsoid>, spec: &BakeSpec) -> Self {
        Self::bake_with(ellipsoids, spec, None, &|_| ())
    }

    /// Bakes splats; with `seen`, all other space is solid. `progress` receives the completed share, 0 to 1,
    /// from any thread.
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
        // A pocket inside unseen space is as unknown as its surroundings.
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

    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    pub fn counts(&self) -> BakeCounts {
        self.counts
    }

    pub fn is_occupied(&self, voxel: [usize; 3]) -> bool {
        self.cells[self.grid.index(voxel)] == 1
    }
}

/// Criteria for leftovers of training.
struct Floaters {
    /// Minimum extent of a component. [voxels]
    extent: usize,
    /// Minimum number of splats per voxel of a component that hangs in the air.
    splats_per_voxel: f32,
    /// Components above this layer hang in the air.
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

    /// Whether a component is a floater: small, or a thin haze that touches neither the floor nor the boundary
    /// of the grid, beyond which it may continue.
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
    /// Returns `None` for a splat that is faint, not finite, or outside of the grid.
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
        // Stated positively, so that an overflow to infinity or NaN fails.
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
        // Full opacity would give a transmittance of 0, so that no second splat matters; harmless, but this
        // keeps the product positive.
        Some(Self { center, form, opacity: opacity.min(0.999), half })
    }

    /// Returns the occupied voxel that contains the centre, or one next to it: the centre of a thin disc may be
    /// between voxel centres.
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

    /// Returns the voxels with centres between `center - half` and `center + half` on an axis of `size`.
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

/// Marks voxels with an opaque centre.
fn splat_into(splats: &[Prepared], grid: &Grid, cells: &mut [u8], progress: &(dyn Fn(f64) + Sync)) {
    let slabs = grid.size[0].div_ceil(SLAB_PLANES);
    let slabs_of = |splat: &Prepared| {
        let xs = Prepared::span(splat.center.x, splat.half.x, grid.size[0]);
        xs.start / SLAB_PLANES..xs.end.div_ceil(SLAB_PLANES)
    };
    // Splats of each slab: counted first, then filled in place.
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

/// Marks voxels that are free and unseen.
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

/// Makes unseen voxels occupied like all others; returns them, one bit per voxel, low bit first.
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

/// Copies the voxels directly above the band into the band above the floor.
fn stand_on_floor(cells: &mut [u8], spec: &BakeSpec) {
    let layers = floor_layers(spec);
    for column in cells.chunks_exact_mut(spec.grid.size[2]) {
        let above = column[layers];
        column[..layers].fill(above);
    }
}

/// Returns the number of layers with centres in the band above the floor.
fn floor_layers(spec: &BakeSpec) -> usize {
    let grid = &spec.grid;
    let band_top_m = spec.floor_z_m + FLOOR_BAND_M;
    let layers = ((band_top_m - grid.min_m.z) / grid.voxel_m - 0.5).ceil().max(0.0) as usize;
    layers.min(grid.size[2] - 1)
}

/// An occupied voxel.
const OCCUPIED: u8 = 1;
/// While baking: a voxel that is solid because it is unseen.
const UNSEEN: u8 = 2;
/// Standard deviation by which splats are widened, so that a thin surface has no holes between voxel centres;
/// see the module's documentation. [voxels]
const WIDENING: f32 = 0.35;
/// Extent of a splat: farther parts (13 % of its peak) never add up to an obstacle. [standard deviations]
const CUTOFF: f32 = 2.0;
/// Share of light that must stop in an occupied voxel: the renderer's median depth uses the same level.
const OPAQUE: f32 = 0.5;
/// Margin outside of the geofence that is baked too: the body's surface may touch the fence, and a vehicle
/// outside of the fence still needs distances. [m]
const MARGIN_M: f64 = 0.5;
/// Progress after reading the splats, laying them into voxels, and removing floaters.
const SPLATS_READ: f64 = 0.1;
const SPLATS_LAID: f64 = 0.8;
const FLOATERS_GONE: f64 = 0.9;
/// Minimum length of the largest side of an occupied component; smaller ones are floaters of training. [m]
const FLOATER_EXTENT_M: f64 = 0.25;
/// Minimum volume of a free component; smaller ones are voids in something solid. [m^3]
const VOID_M3: f64 = 1.0;
/// Maximum height of grass and litter above the floor. [m]
pub const FLOOR_BAND_M: f64 = 0.3;
/// Number of x planes per task: 8 of 280 x 90 voxels are 0.8 MB of transmittance, in cache.
const SLAB_PLANES: usize = 8;

/// Returns a grid with occupied voxels where `solid` is true at the centre; for tests and benchmarks.
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
