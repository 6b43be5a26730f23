//! A scene larger than memory: blocks come from a packed file as images need them, into a pool of fixed size.
//!
//! ```text
//! walk over all trees -> blocks drawn, blocks missing -> reader -> slots of the pool (a `Part`) -> project, sort, ...
//! ```
//! The bounds of all blocks stay in memory, so that the walk is that of `cull`: where a block is off by too many pixels,
//! those that it stands for are drawn in its place. Those of them in view must all be there; as long as one is not, the coarser
//! block stands in, so that nothing is drawn twice or left out. What is missing on the way down is asked for at once, level
//! below level, what is off by most pixels first; then what comes into view or is to be finer soon, where there is room for
//! it. The coarsest block of each part is always there. When all that an image
//! needs is in the pool, it is bit by bit the image of the same parts in memory.
//!
//! The pool gives the slot to a new block that was needed longest ago, never one that this image needs: what does not fit
//! stays coarse, and nothing is read only to be thrown away.

mod file;
mod near;
mod reader;

pub(crate) use file::MAGIC;
pub use file::{PackSummary, PackedError, PackedScene, Source, pack};

use vizflyt_protocol::geometry::Intrinsics;

use super::cull::{ObjectView, Visible};
use super::detail::BRANCH;
use super::scene::{BLOCK, Block, Part};
use file::{GEOMETRY, Tree, block_bytes};
use reader::{Arrived, Reader};

use crate::Camera;

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
/// What is drawn by a block that is off by more than this share of what is allowed is asked for already: at 10 m/s and 50 m
/// half a second before.
const SOON_SHARE: f32 = 0.9;
/// Of the image's sides, what is looked at beyond each for what comes into view: a quarter of it, half a second of a slow
/// turn.
const BEYOND: f64 = 0.25;
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

/// A block that is needed and not there.
#[derive(Clone, Copy, Debug)]
struct Missing {
    block: u32,
    /// How far off is what it is needed for. [px]
    error_px: f32,
    /// Not by this image, but soon.
    soon: bool,
}

/// What a walk is for.
#[derive(Clone, Copy)]
pub(super) struct Views<'a> {
    /// The image.
    pub(super) image: &'a ObjectView,
    /// A wider one, of what comes into view soon.
    pub(super) soon: &'a ObjectView,
}

/// Returns a camera that looks at what the next images of another may show.
pub(super) fn looking_beyond(camera: &Camera) -> Camera {
    let k = camera.intrinsics;
    let [beyond_x, beyond_y] =
        [k.width_px, k.height_px].map(|side| (f64::from(side) * BEYOND) as u32);
    let intrinsics = Intrinsics {
        width_px: k.width_px + 2 * beyond_x,
        height_px: k.height_px + 2 * beyond_y,
        cx_px: k.cx_px + f64::from(beyond_x),
        cy_px: k.cy_px + f64::from(beyond_y),
        ..k
    };
    Camera { intrinsics, ..*camera }
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
        views: Views<'_>,
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
            self.walk(views, visible);
            if waits && self.needed > self.most_slots {
                let bytes =
                    |blocks: usize| (blocks * block_bytes(pool.coefficients)).div_ceil(1 << 20);
                return Err(format!(
                    "packed scene: this image needs {} MiB of it, more than the {} MiB of memory that it was given",
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

    /// Asks for what is missing, as much of it as there is room for: what the image needs in place of all that it does not,
    /// what is needed soon in place of what neither this nor the last image looked at.
    fn ask(&mut self) {
        let urgency = |a: &Missing, b: &Missing| {
            // Of a tree's blocks the coarser one, which comes later, leads to the finer one.
            let error = b.error_px.total_cmp(&a.error_px);
            a.soon.cmp(&b.soon).then(error).then(b.block.cmp(&a.block))
        };
        let room = |image: u64| {
            let kept = self.slots.iter().filter(|slot| slot.needed >= image).count();
            self.most_slots - kept
        };
        let now = self.missing.iter().filter(|missing| !missing.soon).count();
        let most = now.min(room(self.image)).max(room(self.image - 1)).min(MAX_WANTED);
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
    fn walk(&mut self, views: Views<'_>, visible: &mut Vec<Visible>) {
        self.missing.clear();
        self.stand_ins = 0;
        // All the tops are there.
        self.needed = self.trees.len();
        for tree in 0..self.trees.len() {
            let top = &self.blocks[self.trees[tree].top()];
            let is_seen = views.image.sees(top);
            if is_seen || self.loading == Loading::Live && views.soon.sees(top) {
                let at = At { tree, level: self.trees[tree].levels.len() - 2, place: 0 };
                self.descend(at, is_seen, !is_seen, views, visible);
            }
        }
    }

    /// Visits a block that is needed, now or `soon`, and what it stands for; draws where all on the way is there.
    fn descend(
        &mut self,
        at: At,
        draws: bool,
        soon: bool,
        views: Views<'_>,
        visible: &mut Vec<Visible>,
    ) {
        let At { tree, level, place } = at;
        let Tree { first, levels, .. } = &self.trees[tree];
        let block = first + levels[level] + place;
        let slot = self.slot_of[block];
        if slot != ABSENT {
            let needed = &mut self.slots[slot as usize].needed;
            *needed = (*needed).max(self.image - u64::from(soon));
        }
        let error_px = self.blocks[block].error_m * views.image.px_per_m(&self.blocks[block]);
        let most_px = self.max_error_px * self.relief;
        let is_fine = level == 0 || error_px <= most_px;
        if is_fine && draws {
            visible.push(Visible { part: POOL, block: slot });
        }
        let looks_ahead = self.loading == Loading::Live && error_px > most_px * SOON_SHARE;
        if level == 0 || is_fine && !looks_ahead {
            return;
        }
        let finer = levels[level] - levels[level - 1];
        let children = place * BRANCH..((place + 1) * BRANCH).min(finer);
        let first_child = first + levels[level - 1];
        let soon = soon || is_fine;
        let (mut now, mut later) = ([false; BRANCH], [false; BRANCH]);
        let mut all_there = true;
        for (i, child) in children.clone().enumerate() {
            let child = first_child + child;
            let bounds = &self.blocks[child];
            let is_seen = views.image.sees(bounds);
            now[i] = is_seen && !soon;
            later[i] =
                !now[i] && self.loading == Loading::Live && (is_seen || views.soon.sees(bounds));
            let is_absent = self.slot_of[child] == ABSENT;
            if is_absent && (now[i] || later[i]) {
                self.missing.push(Missing { block: child as u32, error_px, soon: later[i] });
            }
            if now[i] {
                self.needed += 1;
                all_there &= !is_absent;
            }
        }
        let refines = draws && !is_fine && all_there;
        if draws && !is_fine && !all_there {
            self.stand_ins += 1;
            visible.push(Visible { part: POOL, block: slot });
        }
        for (i, place) in children.enumerate() {
            if now[i] || later[i] {
                let child = At { tree, level: level - 1, place };
                self.descend(child, refines && now[i], later[i], views, visible);
            }
        }
    }
}

#[cfg(test)]
mod tests;
