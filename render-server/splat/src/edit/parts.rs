//! Connected parts of a scene: solid splats in neighbouring cells.
//!
//! ```text
//! solid splats -> covered cells, sorted -> union of neighbours -> part of each splat -> size of
//! each part
//! ```
//! Faint splats (haze) do not connect parts. They belong to the part of their own or a neighbouring
//! cell.

use glam::IVec3;
use rayon::prelude::*;

use super::cells::{Cells, is_solid, key};
use crate::Splats;

/// Marks the splats of parts with at least `least` splats.
pub(super) fn of_at_least(splats: &Splats, side: f64, least: usize) -> Vec<bool> {
    let parts = Parts::of(splats, side);
    let counts = parts.counts();
    parts.marks(|part| counts[part as usize] >= least)
}

/// Marks the splats of the `keep` largest parts. Of equal parts, those with the first cells are
/// preferred.
pub(super) fn largest(splats: &Splats, side: f64, keep: usize) -> Vec<bool> {
    let parts = Parts::of(splats, side);
    let counts = parts.counts();
    let mut order: Vec<u32> =
        (0..counts.len() as u32).filter(|p| counts[*p as usize] > 0).collect();
    order.sort_by_key(|part| (std::cmp::Reverse(counts[*part as usize]), *part));
    order.truncate(keep);
    let mut kept = vec![false; counts.len()];
    for part in order {
        kept[part as usize] = true;
    }
    parts.marks(|part| kept[part as usize])
}

/// Assignment of splats to parts.
struct Parts {
    /// For each splat, the number of its part's first cell; `None` for haze away from all parts.
    of_splat: Vec<Option<u32>>,
    cells: usize,
}

impl Parts {
    fn of(splats: &Splats, side: f64) -> Self {
        let cells = Cells { side };
        let mut keys: Vec<u64> = (0..splats.len())
            .into_par_iter()
            .filter(|&index| is_solid(splats, index, SOLID_OPACITY))
            .fold(Vec::new, |mut keys, index| {
                cells.covered(splats, index, |cell| keys.push(key(cell)));
                keys
            })
            .reduce(Vec::new, |mut all, mut keys| {
                all.append(&mut keys);
                all
            });
        keys.par_sort_unstable();
        keys.dedup();
        let first = first_of_part(&keys);
        let of_splat = (0..splats.len())
            .into_par_iter()
            .map(|index| {
                let cell = cells.of(splats.means_m[index].as_dvec3())?;
                let at =
                    |cell: IVec3| keys.binary_search(&key(cell)).ok().map(|found| first[found]);
                at(cell).or_else(|| BESIDE.iter().find_map(|&aside| at(cell + IVec3::from(aside))))
            })
            .collect();
        Self { of_splat, cells: keys.len() }
    }

    /// Returns the number of splats of each part, indexed by its first cell.
    fn counts(&self) -> Vec<usize> {
        let mut counts = vec![0; self.cells];
        self.of_splat.iter().flatten().for_each(|part| counts[*part as usize] += 1);
        counts
    }

    fn marks(&self, wanted: impl Fn(u32) -> bool + Sync) -> Vec<bool> {
        self.of_splat.par_iter().map(|part| part.is_some_and(&wanted)).collect()
    }
}

/// Returns for each cell, in the order of `keys`, the first cell of its part. Neighbours share at
/// least a corner.
fn first_of_part(keys: &[u64]) -> Vec<u32> {
    let mut parent: Vec<u32> = (0..keys.len() as u32).collect();
    // Columns of cells with lower keys, and the column of the cell itself. The cursor of each
    // column moves along with the cell.
    let columns = [[-1, -1], [-1, 0], [-1, 1], [0, -1], [0, 0]];
    let mut cursors = [0; 5];
    for (cell, &at) in keys.iter().enumerate() {
        for ([dx, dy], cursor) in columns.iter().zip(&mut cursors) {
            let middle = at.wrapping_add_signed((dx << 42) + (dy << 21));
            while keys[*cursor] + 1 < middle {
                *cursor += 1;
            }
            let near = keys[*cursor..cell].iter().take_while(|&&other| other <= middle + 1);
            for other in (*cursor..).take(near.count()) {
                let (a, b) = (first(&mut parent, cell as u32), first(&mut parent, other as u32));
                parent[a.max(b) as usize] = a.min(b);
            }
        }
    }
    (0..keys.len() as u32).map(|cell| first(&mut parent, cell)).collect()
}

/// Returns the current first cell of a cell's part.
fn first(parent: &mut [u32], mut cell: u32) -> u32 {
    while parent[cell as usize] != cell {
        parent[cell as usize] = parent[parent[cell as usize] as usize];
        cell = parent[cell as usize];
    }
    cell
}

/// Offsets of the 26 neighbours of a cell, those that share a face first.
const BESIDE: [[i32; 3]; 26] = beside();

const fn beside() -> [[i32; 3]; 26] {
    let mut found = [[0; 3]; 26];
    let mut count = 0;
    let mut distance = 1;
    while distance <= 3 {
        let mut n = 0;
        while n < 27 {
            let [x, y, z] = [n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1];
            if x * x + y * y + z * z == distance {
                found[count] = [x, y, z];
                count += 1;
            }
            n += 1;
        }
        distance += 1;
    }
    found
}

/// Opacity below which a splat is haze. A tenth: in captures, three quarters of the splats above
/// the renderer's own threshold exceed it.
const SOLID_OPACITY: f32 = 0.1;
