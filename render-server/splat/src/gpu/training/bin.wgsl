// Pass 4: lists the splats that touch each tile.
//
// In order of depth, the tiles of each splat are counted, the counts are converted to positions, and the pairs (tile,
// slot) are written there: ordered by depth. A stable sort by tile then gives the list of each tile from near to far;
// `bound` stores start and end of each list.

@group(0) @binding(0) var<uniform> tick: Tick;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read_write> sizes: array<u32>;
@group(0) @binding(3) var<storage, read_write> dispatches: array<u32>;
// Slots, from near to far.
@group(0) @binding(4) var<storage, read> order: array<u32>;
@group(0) @binding(5) var<storage, read> shapes: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> extents: array<vec4<f32>>;
// Counts per splat in order of depth; then per workgroup of `count_tiles`, later its first pair.
@group(0) @binding(7) var<storage, read_write> counts: array<u32>;
@group(0) @binding(8) var<storage, read_write> tiles: array<u32>;
@group(0) @binding(9) var<storage, read_write> slots: array<u32>;
@group(0) @binding(10) var<storage, read> digits: array<u32>;
@group(0) @binding(11) var<storage, read> sorted_tiles: array<u32>;
// First pair and end of each tile.
@group(0) @binding(12) var<storage, read_write> lists: array<vec2<u32>>;

/// Ellipse of a splat, and the rows of tiles that it reaches.
struct Rows {
    ellipse: Ellipse,
    width: f32,
    top: u32,
    /// End of the rows.
    bottom: u32,
    tiles_x: u32,
    first_tile: u32,
}

fn rows_of(slot: u32) -> Rows {
    let shape = shapes[slot];
    let extent = extents[slot];
    let camera = bitcast<u32>(extent.z) >> 16u;
    let size = views[camera * tick.parts].size;
    let reach = extent.y - MIN_LEVEL;
    let extent_y = sqrt(reach / extent.x);
    let rows = centres(shape.y - extent_y, shape.y + extent_y, f32(size.y));
    var top = 0u;
    var bottom = 0u;
    if rows.x < rows.y {
        top = rows.x / TILE;
        bottom = (rows.y - 1u) / TILE + 1u;
    }
    let ellipse = Ellipse(shape.xy, shape.z, vec2(shape.w, extent.x), reach, extent.w);
    return Rows(ellipse, f32(size.x), top, bottom, size.z, size.w);
}

/// Tiles of a row that the ellipse reaches: first and end.
fn span(r: Rows, row: u32) -> vec2<u32> {
    let top = f32(row * TILE) + 0.5;
    let edges = band(r.ellipse, top, top + f32(TILE - 1u));
    let columns = centres(edges.x, edges.y, r.width);
    if columns.x >= columns.y {
        return vec2(0u);
    }
    return vec2(columns.x / TILE, (columns.y - 1u) / TILE + 1u);
}

// One workgroup, after the first digit of the sort by depth: counts the visible splats.
@compute @workgroup_size(256)
fn count_visible(@builtin(local_invocation_index) thread: u32) {
    let groups = (sizes[SLOTS] + SORT_GROUP - 1u) / SORT_GROUP;
    _ = scan(thread, digits[256u * groups + thread]);
    if thread == 0u {
        let visible = scan_total;
        sizes[VISIBLE] = visible;
        dispatches[SORT_VISIBLE] = (visible + SORT_GROUP - 1u) / SORT_GROUP;
        dispatches[SORT_VISIBLE + 1u] = 1u;
        dispatches[SORT_VISIBLE + 2u] = 1u;
        dispatches[BIN] = (visible + 255u) / 256u;
        dispatches[BIN + 1u] = 1u;
        dispatches[BIN + 2u] = 1u;
    }
}

@compute @workgroup_size(256)
fn count_tiles(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let visible = sizes[VISIBLE];
    let i = group.x * 256u + thread;
    var count = 0u;
    if i < visible {
        let r = rows_of(order[i]);
        for (var row = r.top; row < r.bottom; row++) {
            let columns = span(r, row);
            count += columns.y - columns.x;
        }
        counts[i] = count;
    }
    _ = scan(thread, count);
    if thread == 0u {
        counts[visible + group.x] = scan_total;
    }
}

// One workgroup: converts numbers of pairs to first pairs.
@compute @workgroup_size(256)
fn place_pairs(@builtin(local_invocation_index) thread: u32) {
    let visible = sizes[VISIBLE];
    let groups = (visible + 255u) / 256u;
    var carry = 0u;
    for (var first = 0u; first < groups; first += 256u) {
        let i = first + thread;
        var count = 0u;
        if i < groups {
            count = counts[visible + i];
        }
        let before = scan(thread, count);
        if i < groups {
            counts[visible + i] = carry + before;
        }
        // Saturates: an overflow of 2^32 pairs must not appear as fewer pairs.
        carry = select(carry + scan_total, 0xffffffffu, carry + scan_total < carry);
        workgroupBarrier();
    }
    if thread == 0u {
        sizes[PAIRS_WANTED] = carry;
        let pairs = min(carry, tick.pairs);
        sizes[PAIRS] = pairs;
        dispatches[SORT_PAIRS] = (pairs + SORT_GROUP - 1u) / SORT_GROUP;
        dispatches[SORT_PAIRS + 1u] = 1u;
        dispatches[SORT_PAIRS + 2u] = 1u;
    }
}

@compute @workgroup_size(256)
fn emit(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let visible = sizes[VISIBLE];
    let i = group.x * 256u + thread;
    var count = 0u;
    if i < visible {
        count = counts[i];
    }
    let before = scan(thread, count);
    if i >= visible || sizes[PAIRS_WANTED] > tick.pairs {
        // Too little room for all pairs: the photo is rendered again.
        return;
    }
    var place = counts[visible + group.x] + before;
    let end = place + count;
    let slot = order[i];
    let r = rows_of(slot);
    for (var row = r.top; row < r.bottom; row++) {
        let columns = span(r, row);
        for (var column = columns.x; column < columns.y; column++) {
            // Compilers may round this kernel and `count_tiles` differently: writes not more ...
            if place < end {
                tiles[place] = r.first_tile + row * r.tiles_x + column;
                slots[place] = slot;
                place++;
            }
        }
    }
    // ... and not fewer pairs than counted.
    while place < end {
        tiles[place] = tick.tiles;
        slots[place] = slot;
        place++;
    }
}

@compute @workgroup_size(256)
fn bound(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let pairs = sizes[PAIRS];
    for (var round = 0u; round < SORT_GROUP / 256u; round++) {
        let i = group.x * SORT_GROUP + round * 256u + thread;
        if i >= pairs {
            continue;
        }
        let tile = sorted_tiles[i];
        if tile >= tick.tiles {
            continue;
        }
        if i == 0u || sorted_tiles[i - 1u] != tile {
            lists[tile].x = i;
        }
        if i + 1u == pairs || sorted_tiles[i + 1u] != tile {
            lists[tile].y = i + 1u;
        }
    }
}
