//! Connected components by runs along z: a grid of 21 M voxels has under a million runs, so labels need
//! megabytes instead of a second grid.

use crate::grid::Grid;

/// Neighbours that count as connected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Connectivity {
    /// The six neighbours that share a face.
    Faces,
    /// The 26 neighbours that share at least a corner.
    Corners,
}

/// One connected component.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Component {
    pub(super) voxels: usize,
    /// Number of splats in the component.
    pub(super) splats: u32,
    /// Bounding box: first voxel on each axis, and the one after the last.
    pub(super) low: [u32; 3],
    pub(super) high: [u32; 3],
}

impl Component {
    /// Returns the largest side of the bounding box. [voxels]
    pub(super) fn extent(&self) -> usize {
        (0..3).map(|axis| (self.high[axis] - self.low[axis]) as usize).max().unwrap_or(0)
    }
}

/// Voxels `start..end` of a column.
#[derive(Clone, Copy)]
struct Run {
    start: u16,
    end: u16,
}

/// All runs of cells of one value, with their connections.
pub(super) struct Runs {
    size: [usize; 3],
    all: Vec<Run>,
    /// Runs of column n are `first[n]..first[n + 1]`.
    first: Vec<u32>,
    /// Union-find forest.
    parent: Vec<u32>,
    /// Number of splats in each run.
    splats: Vec<u32>,
}

impl Runs {
    /// Finds the components of the cells that equal `value`.
    pub(super) fn of(cells: &[u8], grid: &Grid, value: u8, connectivity: Connectivity) -> Self {
        let [nx, ny, nz] = grid.size;
        assert!(u16::try_from(nz).is_ok(), "columns of at most 65535 voxels");
        let mut runs = Vec::new();
        let mut first = Vec::with_capacity(nx * ny + 1);
        for column in cells.chunks_exact(nz) {
            first.push(runs.len() as u32);
            let mut z = 0;
            while let Some(skipped) = column[z..].iter().position(|&cell| cell == value) {
                let start = z + skipped;
                let length = column[start..].iter().position(|&cell| cell != value);
                z = length.map_or(nz, |length| start + length);
                runs.push(Run { start: start as u16, end: z as u16 });
            }
        }
        first.push(runs.len() as u32);
        let parent = (0..runs.len() as u32).collect();
        let splats = vec![0; runs.len()];
        let mut this = Self { size: grid.size, all: runs, first, parent, splats };
        for x in 0..nx {
            for y in 0..ny {
                // Only preceding neighbours; the others join this column from their side.
                if y > 0 {
                    this.join(x * ny + y, x * ny + y - 1, connectivity);
                }
                if x > 0 {
                    let before = (x - 1) * ny + y;
                    this.join(x * ny + y, before, connectivity);
                    if connectivity == Connectivity::Corners {
                        if y > 0 {
                            this.join(x * ny + y, before - 1, connectivity);
                        }
                        if y + 1 < ny {
                            this.join(x * ny + y, before + 1, connectivity);
                        }
                    }
                }
            }
        }
        this
    }

    /// Joins the runs of two columns that touch.
    fn join(&mut self, a: usize, b: usize, connectivity: Connectivity) {
        let reach = match connectivity {
            Connectivity::Faces => 0,
            Connectivity::Corners => 1,
        };
        let (mut i, end_i) = (self.first[a], self.first[a + 1]);
        let (mut j, end_j) = (self.first[b], self.first[b + 1]);
        while i < end_i && j < end_j {
            let (p, q) = (self.all[i as usize], self.all[j as usize]);
            if p.start < q.end + reach && q.start < p.end + reach {
                self.union(i, j);
            }
            if p.end < q.end {
                i += 1;
            } else {
                j += 1;
            }
        }
    }

    fn root(&mut self, mut run: u32) -> u32 {
        while self.parent[run as usize] != run {
            let grandparent = self.parent[self.parent[run as usize] as usize];
            self.parent[run as usize] = grandparent;
            run = grandparent;
        }
        run
    }

    fn union(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        // The older run becomes the root: ranks are not needed, because columns are joined in order and paths
        // are halved.
        self.parent[a.max(b) as usize] = a.min(b);
    }

    /// Counts a splat in the component that contains a voxel, if there is one.
    pub(super) fn count(&mut self, [x, y, z]: [usize; 3]) {
        let column = x * self.size[1] + y;
        let (first, end) = (self.first[column] as usize, self.first[column + 1] as usize);
        let after = self.all[first..end].partition_point(|run| usize::from(run.end) <= z);
        if first + after < end && usize::from(self.all[first + after].start) <= z {
            self.splats[first + after] += 1;
        }
    }

    /// Writes `value` into the cells of the components for which `chosen` is true; returns the number of cells.
    pub(super) fn overwrite(
        mut self,
        cells: &mut [u8],
        value: u8,
        chosen: impl Fn(&Component) -> bool,
    ) -> usize {
        let none = Component { voxels: 0, splats: 0, low: [u32::MAX; 3], high: [0; 3] };
        let mut components = vec![none; self.all.len()];
        let [nx, ny, nz] = self.size;
        for column in 0..nx * ny {
            for index in self.first[column]..self.first[column + 1] {
                let run = self.all[index as usize];
                let (start, end) = (u32::from(run.start), u32::from(run.end));
                let root = self.root(index) as usize;
                let (x, y) = ((column / ny) as u32, (column % ny) as u32);
                let component = &mut components[root];
                component.voxels += (end - start) as usize;
                component.splats += self.splats[index as usize];
                for (axis, (low, high)) in [(x, x + 1), (y, y + 1), (start, end)].iter().enumerate()
                {
                    component.low[axis] = component.low[axis].min(*low);
                    component.high[axis] = component.high[axis].max(*high);
                }
            }
        }
        let mut written = 0;
        for column in 0..nx * ny {
            for index in self.first[column]..self.first[column + 1] {
                let root = self.root(index) as usize;
                if chosen(&components[root]) {
                    let run = self.all[index as usize];
                    let (start, end) = (usize::from(run.start), usize::from(run.end));
                    cells[column * nz + start..column * nz + end].fill(value);
                    written += end - start;
                }
            }
        }
        written
    }
}
