//! A scene larger than memory: blocks come from a packed file as images need them, into a pool of fixed size.
//!
//! ```text
//! walk over all trees -> blocks drawn, blocks missing -> reader -> slots of the pool (a `Part`) -> project, sort, ...
//! ```
//! The bounds of all blocks stay in memory, so that the walk is that of `cull`: where a block is off by too many pixels,
//! those that it stands for are drawn in its place. Those of them in view must all be there; as long as one is not, the coarser
//! block stands in, so that nothing is drawn twice or left out. What is missing on the way down is asked for at once, level
//! below level, what is off by most pixels first. The coarsest block of each part is always there. When all that an image
//! needs is in the pool, it is bit by bit the image of the same parts in memory.
//!
//! The pool gives the slot to a new block that was needed longest ago, never one that this image needs: what does not fit
//! stays coarse, and nothing is read only to be thrown away.

mod file;
mod reader;

pub(crate) use file::MAGIC;
pub use file::{PackSummary, PackedError, PackedScene, Source, pack};

use super::cull::{ObjectView, Visible};
use super::detail::BRANCH;
use super::scene::{BLOCK, Block, Part};
use file::{GEOMETRY, Tree, block_bytes};
use reader::{Arrived, Reader};

/// What an image does about blocks that are not in memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Loading {
    /// It is drawn with coarser ones in their place, and waits for nothing.
    #[default]
    Live,
    /// It waits until all are there.
    Whole,
}

/// The pool among the parts that are rendered: what stands still.
const POOL: u32 = 0;
/// Asked for at most, at once: more than arrives until the next image.
const MAX_WANTED: usize = 4096;
/// Of a block that is not in the pool.
const ABSENT: u32 = u32::MAX;
/// Seen by every image: never replaced.
const ALWAYS: u64 = u64::MAX;

/// A slot of the pool, and when its block was last needed.
#[derive(Clone, Copy, Debug)]
struct Slot {
    block: u32,
    /// Number of the image.
    needed: u64,
}

/// The part of a packed scene that is in memory, and what keeps it up to date.
#[derive(Debug)]
pub(super) struct Streamed {
    trees: Vec<Tree>,
    blocks: Vec<Block>,
    loading: Loading,
    /// As the scene was packed for. [px]
    max_error_px: f32,
    /// How many times that is allowed, for what an image needs to fit.
    relief: f32,
    /// Per block.
    slot_of: Vec<u32>,
    slots: Vec<Slot>,
    most_slots: usize,
    /// Slots to be given to other blocks.
    replaceable: Vec<u32>,
    image: u64,
    /// Blocks that the image needs, with those on the way to them.
    needed: usize,
    missing: Vec<Missing>,
    stand_ins: usize,
    reader: Reader,
    arrived: Vec<Arrived>,
    wanted: Vec<u32>,
}

/// A block that is needed and not there, and how far off is what it is needed for. [px]
#[derive(Clone, Copy, Debug)]
struct Missing {
    block: u32,
    error_px: f32,
}

/// What the last image of a packed scene was made of.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Streaming {
    /// Blocks that stood in for finer ones that were not there yet.
    pub stand_ins: usize,
    /// Blocks that were needed.
    pub needed: usize,
    /// Blocks that fit into memory.
    pub most: usize,
    /// How far off splats were allowed to be, where all was there: more than the scene was packed for where that would
    /// not have fitted. [px]
    pub max_error_px: f32,
}

/// Where a walk is: a tree, a level of it, a place in that.
#[derive(Clone, Copy)]
struct At {
    tree: usize,
    level: usize,
    place: usize,
}

impl Streamed {
    /// Starts to read a scene; returns also the pool, of at most so many bytes, as the part that is rendered.
    pub(super) fn new(
        mut scene: PackedScene,
        memory_bytes: usize,
        loading: Loading,
    ) -> Result<(Self, Part), PackedError> {
        let coefficients = scene.coefficients;
        let (slot_bytes, harmonics) = (block_bytes(coefficients), coefficients * 3 * BLOCK);
        let most_slots = (memory_bytes / slot_bytes).min(scene.blocks.len());
        let least = scene.trees.len();
        if most_slots < least {
            return Err(PackedError::Memory { given: memory_bytes, least: least * slot_bytes });
        }
        let mut pool = Part {
            levels: vec![0],
            // Zeros: the system gives memory once it is written.
            geometry: vec![0.0; most_slots * GEOMETRY],
            sh: vec![0; most_slots * harmonics],
            coefficients,
            len: scene.splats,
            antialiased: scene.antialiased,
            ..Part::default()
        };
        let mut slots = Vec::with_capacity(most_slots);
        let mut slot_of = vec![ABSENT; scene.blocks.len()];
        let trees = scene.trees.clone();
        for (slot, tree) in trees.iter().enumerate() {
            let geometry = &mut pool.geometry[slot * GEOMETRY..][..GEOMETRY];
            scene.read(tree.top(), geometry, &mut pool.sh[slot * harmonics..][..harmonics])?;
            slot_of[tree.top()] = slot as u32;
            slots.push(Slot { block: tree.top() as u32, needed: ALWAYS });
        }
        let streamed = Self {
            trees,
            blocks: std::mem::take(&mut scene.blocks),
            loading,
            max_error_px: scene.max_error_px,
            relief: 1.0,
            slot_of,
            slots,
            most_slots,
            replaceable: Vec::new(),
            image: 0,
            needed: 0,
            missing: Vec::new(),
            stand_ins: 0,
            reader: Reader::new(scene).map_err(PackedError::Thread)?,
            arrived: Vec::new(),
            wanted: Vec::new(),
        };
        Ok((streamed, pool))
    }

    /// Returns what the last image was made of.
    pub(super) fn streaming(&self) -> Streaming {
        Streaming {
            stand_ins: self.stand_ins,
            needed: self.needed,
            most: self.most_slots,
            max_error_px: self.max_error_px * self.relief,
        }
    }

    /// Puts what has arrived into the pool, and appends the blocks to draw.
    ///
    /// # Errors
    /// Why the image cannot be made: the file cannot be read, or, where it is to be whole, it does not fit.
    pub(super) fn cull(
        &mut self,
        pool: &mut Part,
        view: &ObjectView,
        visible: &mut Vec<Visible>,
    ) -> Result<(), String> {
        let waits = self.loading == Loading::Whole;
        self.reader.take(&mut self.arrived, false)?;
        self.install(pool);
        if !waits {
            self.fit();
        }
        self.image += 1;
        let first = visible.len();
        loop {
            visible.truncate(first);
            self.walk(view, visible);
            if waits && self.needed > self.most_slots {
                let bytes =
                    |blocks: usize| (blocks * block_bytes(pool.coefficients)).div_ceil(1 << 20);
                return Err(format!(
                    "this image needs {} MiB of the scene, more than the {} MiB of memory that it was given",
                    bytes(self.needed),
                    bytes(self.most_slots)
                ));
            }
            self.ask();
            if !waits || self.missing.is_empty() {
                break;
            }
            self.reader.take(&mut self.arrived, true)?;
            self.install(pool);
        }
        Ok(())
    }

    /// Allows more error where what the last image needed does not fit, and less again where it does by far.
    fn fit(&mut self) {
        if self.needed > self.most_slots {
            self.relief *= 1.1;
        } else if self.needed < self.most_slots / 8 * 7 {
            self.relief = (self.relief / 1.02).max(1.0);
        }
    }

    /// Gives what has arrived the slots that are free, then those needed longest ago; none that the last walk needed.
    fn install(&mut self, pool: &mut Part) {
        self.arrived.retain(|arrived| self.slot_of[arrived.block as usize] == ABSENT);
        let free = self.most_slots - self.slots.len();
        self.replaceable.clear();
        if let Some(more) = self.arrived.len().checked_sub(free + 1) {
            let slots = &self.slots;
            let all = 0..slots.len() as u32;
            self.replaceable.extend(all.filter(|&slot| slots[slot as usize].needed < self.image));
            if more < self.replaceable.len() {
                // Of those needed at the same time the finer one, which stands before what it is reached by.
                let oldest =
                    |&slot: &u32| (slots[slot as usize].needed, slots[slot as usize].block);
                self.replaceable.select_nth_unstable_by_key(more, oldest);
                self.replaceable.truncate(more + 1);
            }
        }
        let harmonics = pool.sh_numbers() * BLOCK;
        // Needed by the image that asked for it, or by one before.
        let needed = self.image.saturating_sub(1);
        for Arrived { block, geometry, sh } in &self.arrived {
            let new = Slot { block: *block, needed };
            let slot = if self.slots.len() < self.most_slots {
                self.slots.push(new);
                self.slots.len() - 1
            } else if let Some(slot) = self.replaceable.pop() {
                let old = std::mem::replace(&mut self.slots[slot as usize], new);
                self.slot_of[old.block as usize] = ABSENT;
                slot as usize
            } else {
                break;
            };
            self.slot_of[*block as usize] = slot as u32;
            pool.geometry[slot * GEOMETRY..][..GEOMETRY].copy_from_slice(geometry);
            pool.sh[slot * harmonics..][..harmonics].copy_from_slice(sh);
        }
    }

    /// Asks for what is missing, as much of it as there is room for.
    fn ask(&mut self) {
        let urgency = |a: &Missing, b: &Missing| {
            // Of a tree's blocks the coarser one, which comes later, leads to the finer one.
            b.error_px.total_cmp(&a.error_px).then(b.block.cmp(&a.block))
        };
        let kept = self.slots.iter().filter(|slot| slot.needed >= self.image).count();
        let most = (self.most_slots - kept).min(MAX_WANTED);
        if most < self.missing.len() {
            if most > 0 {
                self.missing.select_nth_unstable_by(most - 1, urgency);
            }
            self.missing.truncate(most);
        }
        self.missing.sort_unstable_by(urgency);
        self.wanted.clear();
        self.wanted.extend(self.missing.iter().rev().map(|missing| missing.block));
        self.reader.ask(&mut self.wanted);
    }

    /// Appends the blocks to draw and notes those that are missing.
    fn walk(&mut self, view: &ObjectView, visible: &mut Vec<Visible>) {
        self.missing.clear();
        self.stand_ins = 0;
        // All the tops are there.
        self.needed = self.trees.len();
        for tree in 0..self.trees.len() {
            if view.sees(&self.blocks[self.trees[tree].top()]) {
                let at = At { tree, level: self.trees[tree].levels.len() - 2, place: 0 };
                self.descend(at, true, view, visible);
            }
        }
    }

    /// Visits a block that is in view, and what it stands for; draws where all on the way is there.
    fn descend(&mut self, at: At, draws: bool, view: &ObjectView, visible: &mut Vec<Visible>) {
        let At { tree, level, place } = at;
        let Tree { first, levels, .. } = &self.trees[tree];
        let block = first + levels[level] + place;
        let slot = self.slot_of[block];
        if slot != ABSENT {
            let needed = &mut self.slots[slot as usize].needed;
            *needed = self.image.max(*needed);
        }
        let error_px = self.blocks[block].error_m * view.px_per_m(&self.blocks[block]);
        if level == 0 || error_px <= self.max_error_px * self.relief {
            if draws {
                visible.push(Visible { part: POOL, block: slot });
            }
            return;
        }
        let finer = levels[level] - levels[level - 1];
        let children = place * BRANCH..((place + 1) * BRANCH).min(finer);
        let first_child = first + levels[level - 1];
        let mut are_seen = [false; BRANCH];
        let mut all_there = true;
        for (is_seen, child) in are_seen.iter_mut().zip(children.clone()) {
            let child = first_child + child;
            *is_seen = view.sees(&self.blocks[child]);
            if *is_seen {
                self.needed += 1;
                if self.slot_of[child] == ABSENT {
                    all_there = false;
                    self.missing.push(Missing { block: child as u32, error_px });
                }
            }
        }
        if draws && !all_there {
            self.stand_ins += 1;
            visible.push(Visible { part: POOL, block: slot });
        }
        for (is_seen, place) in are_seen.into_iter().zip(children) {
            if is_seen {
                let child = At { tree, level: level - 1, place };
                self.descend(child, draws && all_there, view, visible);
            }
        }
    }
}

#[cfg(test)]
mod tests;
