//! Boards for printed sheets at positions that a walk sees: on walls, and on posts next to the path.
//!
//! Data flow: [`plan`] tests many positions, rejects those that touch something or are hidden, and selects the ones
//! that most of the walk sees. Each board is a true solid. [`paint`] covers boards and posts with patches in the light
//! of the place. Sheets are white in the scene: a splat is too soft for the edge of a tag, so tags are drawn onto
//! images (`vizflyt scene generate --tags`).

mod sight;

use glam::{DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Object, Pose, Volume, World};

use crate::canvas::{Canvas, Patch};
use crate::random::{Rng, polar};
use crate::solids::Solids;
use crate::walk::Walk;
use sight::Glimpse;

/// White sheet on the front of a board.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Print {
    /// Pose of its centre: x to the reader's right, y up, z towards the reader.
    pub world_from_print: Pose<World, Object>,
    /// Edge of the square sheet. [m]
    pub side_m: f64,
}

/// Board on a wall or on a post, upright or leaning back a little.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Board {
    front: Print,
    /// Whether the board stands on a post.
    stands: bool,
}

impl Board {
    /// Returns the sheet of the board.
    pub(crate) fn print(&self) -> Print {
        self.front
    }

    /// Returns the solids of board and post.
    pub(crate) fn volumes(&self) -> Vec<Volume> {
        let pose = self.front.world_from_print;
        let half_m = DVec3::new(self.front.side_m / 2.0, self.front.side_m / 2.0, THICK_M / 2.0);
        let center_m = pose.transform_point(DVec3::NEG_Z * (THICK_M / 2.0));
        let mut volumes = vec![Volume::Cuboid { center_m, half_m, rotation: pose.rotation }];
        if let Some((low, high)) = self.post() {
            volumes.push(Volume::aabb(low, high));
        }
        volumes
    }

    /// Returns the corners of the post, which ends behind the board's centre.
    fn post(&self) -> Option<(DVec3, DVec3)> {
        self.stands.then(|| {
            let top_m = self
                .front
                .world_from_print
                .transform_point(DVec3::NEG_Z * (THICK_M + POST_M / 2.0));
            let half = DVec2::splat(POST_M / 2.0);
            ((top_m.truncate() - half).extend(0.0), (top_m.truncate() + half).extend(top_m.z))
        })
    }

    fn new(center_m: DVec3, normal: DVec3, stands: bool) -> Self {
        let right = DVec3::Z.cross(normal).normalize_or(DVec3::X);
        let axes = DMat3::from_cols(right, normal.cross(right), normal);
        let rotation = DQuat::from_mat3(&axes).normalize();
        let world_from_print = Pose::new(center_m, rotation);
        Self { front: Print { world_from_print, side_m: SIDE_M }, stands }
    }
}

/// Allowed positions of boards.
pub(crate) struct Places<'a> {
    /// Solids of the scene.
    pub(crate) solids: &'a Solids,
    /// Walls: a point on the wall, the inward normal, and the extent to both sides of the point. [m, world]
    pub(crate) walls: &'a [(DVec3, DVec3, f64)],
    /// Floor on which posts may stand. [m, world]
    pub(crate) floor_m: [DVec2; 2],
    /// Area without posts, because a course is flown there. [m, world]
    pub(crate) kept_free: Option<[DVec2; 2]>,
}

/// Returns up to [`COUNT`] boards for a walk. The same input gives the same boards.
pub(crate) fn plan(places: &Places<'_>, walk: &Walk, seed: u64) -> Vec<Board> {
    let glimpses = sight::glimpses(walk);
    let way_m = sight::way_m(walk);
    let mut rng = Rng::new(seed, 62);
    let mut open: Vec<(Board, Vec<usize>)> = candidates(places, &way_m, &mut rng)
        .into_iter()
        .filter(|board| fits(board, places.solids, &way_m))
        .filter_map(|board| {
            let seen = seen(&board, places.solids, &glimpses);
            (!seen.is_empty()).then_some((board, seen))
        })
        .collect();
    // Number of chosen boards that each glimpse sees: further boards count less.
    let mut counts = vec![0u32; glimpses.len()];
    let mut chosen: Vec<Board> = Vec::new();
    while chosen.len() < COUNT {
        let worth = |seen: &[usize]| -> f64 {
            seen.iter().map(|&n| [1.0, 0.5, 0.1][counts[n].min(2) as usize]).sum()
        };
        let best = open
            .iter()
            .enumerate()
            .map(|(n, (_, seen))| (worth(seen), n))
            .max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)));
        let Some((worth, n)) = best else { break };
        if worth < LEAST_WORTH {
            break;
        }
        let (board, seen) = open.swap_remove(n);
        for n in seen {
            counts[n] += 1;
        }
        // A board must not hide or touch another one.
        let middle_m = board.front.world_from_print.translation_m;
        open.retain(|(other, _)| {
            (other.front.world_from_print.translation_m - middle_m).length() > APART_M
        });
        chosen.push(board);
    }
    chosen
}

/// Returns candidate boards on walls and on posts, without any checks.
fn candidates(places: &Places<'_>, way_m: &[DVec2], rng: &mut Rng) -> Vec<Board> {
    let mut boards = Vec::new();
    for &(middle_m, normal, reach_m) in places.walls {
        let along = DVec3::Z.cross(normal);
        let count = (2.0 * reach_m / 0.35) as usize;
        for n in 0..count {
            let x = reach_m * (2.0 * (n as f64 + rng.unit()) / count as f64 - 1.0);
            let z = rng.range(0.95, 1.9);
            let center_m = middle_m + along * x + DVec3::Z * z + normal * OFF_WALL_M;
            boards.push(Board::new(center_m, normal, false));
        }
    }
    let [low, high] = places.floor_m;
    for _ in 0..STANDING_TRIES {
        let at = DVec2::new(rng.range(low.x, high.x), rng.range(low.y, high.y));
        let is_kept_free = places
            .kept_free
            .is_some_and(|[low, high]| at.cmpgt(low - 0.3).all() && at.cmplt(high + 0.3).all());
        // It faces a near position of the path, but not the nearest one, so that it is seen for longer.
        let near: Vec<DVec2> =
            way_m.iter().copied().filter(|p| ((*p - at).length() - 2.2).abs() < 0.8).collect();
        let (z, turn, lean) = (rng.range(0.95, 1.35), rng.spread(0.25), rng.range(0.0, 0.15));
        if is_kept_free || near.is_empty() {
            continue;
        }
        let to = near[rng.below(near.len())] - at;
        let level = polar(libm::atan2(to.y, to.x) + turn);
        let normal = (level * libm::cos(lean)).extend(libm::sin(lean));
        boards.push(Board::new(at.extend(z), normal, true));
    }
    boards
}

/// Whether a board touches nothing and does not obstruct the path.
fn fits(board: &Board, solids: &Solids, way_m: &[DVec2]) -> bool {
    let pose = board.front.world_from_print;
    let least_m = if board.stands { 0.12 } else { 0.5 * THICK_M };
    let half = board.front.side_m / 2.0;
    for row in -2..=2 {
        for column in -2..=2 {
            let at = DVec2::new(f64::from(column), f64::from(row)) * (half / 2.0);
            // Objects may be close behind a board on a wall, but not in front of it.
            for z in [0.0, 0.15, 0.3] {
                if solids.distance_m(pose.transform_point(at.extend(z))) < least_m.max(0.6 * z) {
                    return false;
                }
            }
        }
    }
    if let Some((low, high)) = board.post() {
        let middle = (low + high) / 2.0;
        for step in 1..8 {
            let z = high.z * f64::from(step) / 8.0;
            if solids.distance_to_bodies_m(DVec3::new(middle.x, middle.y, z)) < 0.15 {
                return false;
            }
        }
    }
    let at = pose.translation_m.truncate();
    way_m.iter().all(|p| (*p - at).length() > if board.stands { 0.85 } else { 0.6 })
}

/// Returns the indices of the glimpses that see a board well: near, from the front, and unobstructed.
fn seen(board: &Board, solids: &Solids, glimpses: &[Glimpse]) -> Vec<usize> {
    (0..glimpses.len()).filter(|&n| glimpses[n].sees(&board.front, solids)).collect()
}

/// Paints boards. `matt(point, normal, albedo)` returns the light that leaves a matt surface.
pub(crate) fn paint(
    canvas: &mut Canvas,
    boards: &[Board],
    matt: &mut dyn FnMut(DVec3, DVec3, DVec3) -> DVec3,
) {
    let white = DVec3::new(0.80, 0.80, 0.78);
    let back = DVec3::new(0.30, 0.27, 0.22);
    for board in boards {
        let pose = board.front.world_from_print;
        let (right, up, normal) =
            (pose.rotate(DVec3::X), pose.rotate(DVec3::Y), pose.rotate(DVec3::Z));
        let half = board.front.side_m / 2.0;
        let corner = |z: f64| pose.transform_point(DVec3::new(-half, -half, z));
        let side = DVec2::splat(board.front.side_m);
        face(canvas, [corner(0.0), right, up], side, white, matt);
        let low_right = pose.transform_point(DVec3::new(half, -half, -THICK_M));
        face(canvas, [low_right, -right, up], side, back, matt);
        // Edges, which are only visible from the side.
        let thin = DVec2::new(THICK_M, board.front.side_m);
        face(canvas, [corner(-THICK_M), normal, up], thin, white * 0.8, matt);
        let right_edge = pose.transform_point(DVec3::new(half, -half, 0.0));
        face(canvas, [right_edge, -normal, up], thin, white * 0.8, matt);
        let top = pose.transform_point(DVec3::new(-half, half, 0.0));
        let flat = DVec2::new(board.front.side_m, THICK_M);
        face(canvas, [top, right, -normal], flat, white * 0.8, matt);
        let bottom = pose.transform_point(DVec3::new(-half, -half, -THICK_M));
        face(canvas, [bottom, right, normal], flat, white * 0.8, matt);
        if let Some((low, high)) = board.post() {
            let size = DVec2::new(POST_M, high.z - low.z);
            let grey = DVec3::splat(0.22);
            for (foot, along) in [
                (low, DVec3::X),
                (DVec3::new(high.x, low.y, low.z), DVec3::Y),
                (DVec3::new(high.x, high.y, low.z), DVec3::NEG_X),
                (DVec3::new(low.x, high.y, low.z), DVec3::NEG_Y),
            ] {
                face(canvas, [foot, along, DVec3::Z], size, grey, matt);
            }
        }
    }
}

/// Paints a rectangle from its corner to the right and up, with the normal `right x up`. It has two layers, half a cell
/// apart, so that no seams are visible.
fn face(
    canvas: &mut Canvas,
    [corner_m, right, up]: [DVec3; 3],
    size_m: DVec2,
    albedo: DVec3,
    matt: &mut dyn FnMut(DVec3, DVec3, DVec3) -> DVec3,
) {
    let normal = right.cross(up);
    for (layer, depth_m) in [(0.0, 0.002), (0.5, 0.007)] {
        let counts = (size_m / CELL_M).ceil().max(DVec2::ONE)
            + if size_m.min_element() > CELL_M { layer * 2.0 } else { 0.0 };
        let cell_m = size_m / counts;
        // Patches are centred in their cells, so that the outermost ones end near the edge of the board.
        for row in 0..counts.y as usize {
            for column in 0..counts.x as usize {
                let middle = (DVec2::new(column as f64, row as f64) + 0.5) * cell_m;
                let p_m = corner_m + right * middle.x + up * middle.y;
                canvas.add(Patch {
                    center_m: p_m - normal * depth_m,
                    normal,
                    along: right,
                    sigma_m: (cell_m * 0.55).extend(0.002),
                    opacity: 0.985,
                    radiance: matt(p_m, normal, albedo),
                });
            }
        }
    }
}

/// Maximum number of boards of a scene.
pub(crate) const COUNT: usize = 14;
/// Edge of a board: a tag of 0.24 m, its white rim, and about 0.1 m. [m]
const SIDE_M: f64 = 0.38;
const THICK_M: f64 = 0.03;
/// Width of a post. [m]
const POST_M: f64 = 0.04;
/// Distance of the front of a board from its wall: thickness plus a gap. [m]
const OFF_WALL_M: f64 = THICK_M + 0.015;
/// Minimum distance between the centres of boards. [m]
const APART_M: f64 = 1.1;
/// Number of tested positions on the floor.
const STANDING_TRIES: usize = 1500;
/// Minimum benefit of a further board, in weighted glimpses.
const LEAST_WORTH: f64 = 1.5;
/// Side of a patch, which limits the sharpness of shadows. [m]
const CELL_M: f64 = 0.035;

#[cfg(test)]
mod tests;
