//! Renderer of scenes larger than memory: loads blocks from a packed file on demand, into a pool of fixed size.
//!
//! ```text
//! walk over all trees -> blocks drawn, blocks missing -> reader -> slots of the pool (a `Part`) -> project, sort, ...
//! ```
//! The bounds of all blocks stay in memory, so the walk is the same as that of `cull`: where a block's error exceeds
//! the allowed pixels, its children are drawn instead. All of its visible children must be in the pool; until then,
//! the coarser block stands in, so that nothing is drawn twice or missing. The walk requests missing blocks of all
//! levels at once, those with the greatest error first. Then it requests blocks that will come into view or be
//! refined soon, if there is room. The coarsest block of each part is always in the pool. If all blocks that an image
//! needs are in the pool, the image is bit-identical to that of the same parts in memory.
//!
//! A new block replaces the block that was needed least recently, never one that the current image needs. Blocks that
//! do not fit are drawn coarser, and no block is read only to be dropped again.

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

/// How an image handles blocks that are not in memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Loading {
    /// Draws coarser blocks instead, without waiting.
    #[default]
    Live,
    /// Waits until all blocks are in memory.
    Whole,
}

/// Index of the pool among the rendered parts: the static part.
const POOL: u32 = 0;
/// Blocks are requested when the error of the drawn block exceeds this share of the allowed error: at 10 m/s and 50
/// m, half a second in advance.
const SOON_SHARE: f32 = 0.9;
/// Margin around the image, as a share of its sides, in which blocks are requested before they come into view: half a
/// second of a slow turn.
const BEYOND: f64 = 0.25;
/// Maximum number of requested blocks: more than arrive until the next image.
const MAX_WANTED: usize = 4096;
/// Slot of a block that is not in the pool.
const ABSENT: u32 = u32::MAX;
/// Value of `needed` of a block that is never replaced: the top blocks, which every image needs.
const ALWAYS: u64 = u64::MAX;

/// Slot of the pool, with the last image that needed its block.
#[derive(Clone, Copy, Debug)]
struct Slot {
    block: u32,
    /// Image number.
    needed: u64,
}

/// Pool of a packed scene, with its reader.
#[derive(Debug)]
pub(super) struct Streamed {
    trees: Vec<Tree>,
    blocks: Vec<Block>,
    loading: Loading,
    /// Allowed error for which the scene was packed. [px]
    max_error_px: f32,
    /// Factor on the allowed error, above 1 if the blocks of an image do not fit.
    relief: f32,
    /// Slot of each block.
    slot_of: Vec<u32>,
    slots: Vec<Slot>,
    most_slots: usize,
    /// Slots that can be given to other blocks.
    replaceable: Vec<u32>,
    image: u64,
    /// Number of blocks that the image needs, including those on the path to them.
    needed: usize,
    missing: Vec<Missing>,
    stand_ins: usize,
    reader: Reader,
    arrived: Vec<Arrived>,
    wanted: Vec<u32>,
}

/// Needed block that is not in the pool.
#[derive(Clone, Copy, Debug)]
struct Missing {
    block: u32,
    /// Error of the block that it refines. [px]
    error_px: f32,
    /// Whether it is needed soon instead of by this image.
    soon: bool,
}

/// Views of a walk.
#[derive(Clone, Copy)]
pub(super) struct Views<'a> {
    /// View of the image.
    pub(super) image: &'a ObjectView,
    /// Wider view, for blocks that come into view soon.
    pub(super) soon: &'a ObjectView,
}

/// Returns a camera with a margin around the image of `camera`: what its next images may show.
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

/// Statistics of the last image of a packed scene.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Streaming {
    /// Number of coarse blocks that were drawn because finer ones were not loaded yet.
    pub stand_ins: usize,
    /// Number of needed blocks.
    pub needed: usize,
    /// Maximum number of blocks in memory.
    pub most: usize,
    /// Allowed error of splats in fully loaded areas. Greater than the value of the packing if the blocks of the
    /// image would not fit otherwise. [px]
    pub max_error_px: f32,
}

/// Position of a walk: tree, level, and index within the level.
#[derive(Clone, Copy)]
struct At {
    tree: usize,
    level: usize,
    place: usize,
}

impl Streamed {
    /// Starts reading a scene. Returns also the pool, of at most `memory_bytes`, as the part that is rendered.
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
            // Zeros: the system allocates memory only when it is written.
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

    /// Returns the statistics of the last image.
    pub(super) fn streaming(&self) -> Streaming {
        Streaming {
            stand_ins: self.stand_ins,
            needed: self.needed,
            most: self.most_slots,
            max_error_px: self.max_error_px * self.relief,
        }
    }

    /// Puts arrived blocks into the pool, and appends the blocks to draw.
    ///
    /// # Errors
    /// If the file cannot be read, or a complete image does not fit.
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

    /// Increases the allowed error if the blocks of the last image do not fit, and reduces it if they fit with a
    /// margin.
    fn fit(&mut self) {
        if self.needed > self.most_slots {
            self.relief *= 1.1;
        } else if self.needed < self.most_slots / 8 * 7 {
            self.relief = (self.relief / 1.02).max(1.0);
        }
    }

    /// Puts arrived blocks into free slots, then into those needed least recently; never into those of the last walk.
    fn install(&mut self, pool: &mut Part) {
        self.arrived.retain(|arrived| self.slot_of[arrived.block as usize] == ABSENT);
        let free = self.most_slots - self.slots.len();
        self.replaceable.clear();
        if let Some(more) = self.arrived.len().checked_sub(free + 1) {
            let slots = &self.slots;
            let all = 0..slots.len() as u32;
            self.replaceable.extend(all.filter(|&slot| slots[slot as usize].needed < self.image));
            if more < self.replaceable.len() {
                // Among those needed at the same time, prefers the finer one, which is stored before its parent.
                let oldest =
                    |&slot: &u32| (slots[slot as usize].needed, slots[slot as usize].block);
                self.replaceable.select_nth_unstable_by_key(more, oldest);
                self.replaceable.truncate(more + 1);
            }
        }
        let harmonics = pool.sh_numbers() * BLOCK;
        // Needed by the image that requested it, or by an earlier one.
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

    /// Requests missing blocks, as many as fit: those of this image can replace all blocks that it does not need,
    /// those needed soon only blocks that neither this image nor the last one used.
    fn ask(&mut self) {
        let urgency = |a: &Missing, b: &Missing| {
            // Coarser blocks of a tree first: they are stored later and lead to the finer ones.
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

    /// Appends the blocks to draw, and collects the missing ones.
    fn walk(&mut self, views: Views<'_>, visible: &mut Vec<Visible>) {
        self.missing.clear();
        self.stand_ins = 0;
        // All top blocks are in the pool.
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

    /// Visits a needed block and its children; `soon` if it is not needed yet. Draws it if all blocks on the path are
    /// loaded.
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
