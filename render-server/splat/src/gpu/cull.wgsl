// Pass 1: finds the blocks of splats that each camera may see, and assigns each a region of slots. Of a tree of
// blocks, it selects everywhere the coarsest one with a sufficiently small error, like `cpu/cull.rs`.

struct Block {
    /// Centre of the box around the splats' centres. [m, part]
    center: vec3<f32>,
    /// Maximum distance from its centre at which a splat of the block is visible. [m]
    reach: f32,
    /// Half side lengths of that box. [m]
    half_size: vec3<f32>,
    part: u32,
    /// Error of its splats relative to the finer ones that they replace; 0 for original splats. [m]
    error: f32,
    /// Parent block, or NONE.
    parent: u32,
    padding: vec2<u32>,
}

const NONE = 0xffffffffu;

@group(0) @binding(0) var<uniform> tick: Tick;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> blocks: array<Block>;
// Per camera and block: 0, or 1 plus the index of the region relative to the workgroup's first. Then, per workgroup:
// its number of regions, later its first region.
@group(0) @binding(3) var<storage, read_write> regions: array<u32>;
@group(0) @binding(4) var<storage, read_write> sizes: array<u32>;
// Workgroups of `emit`.
@group(0) @binding(5) var<storage, read_write> dispatches: array<u32>;

// Views are accessed by index, not by value: a copy that is indexed in a loop would be in memory.
fn is_seen(block: Block, view: u32) -> bool {
    let center = block.center - vec3(views[view].row_x.w, views[view].row_y.w, views[view].row_z.w);
    let farthest = max(max(abs(center.x), abs(center.y)), abs(center.z));
    for (var i = 0u; i < 5u; i++) {
        let plane = views[view].planes[i];
        let slack = dot(abs(plane.xyz), block.half_size) + block.reach * views[view].weights[i / 4u][i % 4u];
        // Rounding error of the sums, so that nothing is lost at the edge.
        let rounding = 1e-5 * (farthest + slack);
        if dot(plane.xyz, center) + slack + rounding < plane.w {
            return false;
        }
    }
    return true;
}

/// Returns whether the error of a block is sufficiently small.
fn is_fine(index: u32, view: u32) -> bool {
    let center = blocks[index].center - vec3(views[view].row_x.w, views[view].row_y.w, views[view].row_z.w);
    let ahead = views[view].row_z.xyz;
    // Depth of the block's point nearest to the camera.
    let nearest = dot(ahead, center) - dot(abs(ahead), blocks[index].half_size);
    let focal = max(abs(views[view].focal.x), abs(views[view].focal.y));
    let px_per_m = focal / max(nearest, views[view].more.z);
    // Original splats always are, also if a number overflows.
    return blocks[index].error == 0.0 || blocks[index].error * px_per_m <= tick.max_error;
}

/// Returns whether a block is the coarsest sufficient one. All ancestors are tested, so that rounding cannot draw
/// splats twice.
fn is_drawn(index: u32, view: u32) -> bool {
    if !is_fine(index, view) {
        return false;
    }
    var above = blocks[index].parent;
    while above != NONE {
        if is_fine(above, view) {
            return false;
        }
        above = blocks[above].parent;
    }
    return true;
}

@compute @workgroup_size(256)
fn cull(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let total = tick.cameras * tick.blocks;
    let index = group.x * 256u + thread;
    var seen = 0u;
    if index < total {
        let place = index % tick.blocks;
        let view = index / tick.blocks * tick.parts + blocks[place].part;
        if views[view].flags.y != 0u && is_drawn(place, view) && is_seen(blocks[place], view) {
            seen = 1u;
        }
    }
    let before = scan(thread, seen);
    if index < total {
        regions[index] = select(0u, before + 1u, seen == 1u);
    }
    if thread == 0u {
        regions[total + group.x] = scan_total;
    }
}

// One workgroup: converts numbers of regions to first regions.
@compute @workgroup_size(256)
fn place(@builtin(local_invocation_index) thread: u32) {
    let total = tick.cameras * tick.blocks;
    let groups = (total + 255u) / 256u;
    var carry = 0u;
    for (var first = 0u; first < groups; first += 256u) {
        let i = first + thread;
        var count = 0u;
        if i < groups {
            count = regions[total + i];
        }
        let before = scan(thread, count);
        if i < groups {
            regions[total + i] = carry + before;
        }
        carry += scan_total;
        workgroupBarrier();
    }
    if thread == 0u {
        sizes[REGIONS_WANTED] = carry;
        let slots = min(carry, tick.regions) * BLOCK;
        sizes[SLOTS] = slots;
        dispatches[0] = slots / BLOCK;
        dispatches[1] = 1u;
        dispatches[2] = 1u;
    }
}
