// Pass 3: the list of each tile's splats, in any order; `sort` puts it right.
//
// `project` has counted each tile's splats: `place` turns the counts into places, `emit` writes there.

@group(0) @binding(0) var<uniform> tick: Tick;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read_write> sizes: array<u32>;
@group(0) @binding(3) var<storage, read> covers: array<Cover>;
// Splats per tile, those of all images; `place` leaves the first pair of each tile here.
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;
// The same, but one past the tile's last pair once `emit` has run.
@group(0) @binding(5) var<storage, read_write> ends: array<atomic<u32>>;
// Depth as bits, slot.
@group(0) @binding(6) var<storage, read_write> pairs: array<vec2<u32>>;

/// Tiles per thread at once.
const EACH = 4u;

// One workgroup: turns numbers of pairs into first pairs.
@compute @workgroup_size(256)
fn place(@builtin(local_invocation_index) thread: u32) {
    var carry = 0u;
    for (var first = 0u; first < tick.tiles; first += 256u * EACH) {
        let own = first + thread * EACH;
        var places = array<u32, EACH>();
        var count = 0u;
        for (var i = 0u; i < EACH; i++) {
            places[i] = count;
            if own + i < tick.tiles {
                count += counts[own + i];
            }
        }
        let before = carry + scan(thread, count);
        for (var i = 0u; i < EACH; i++) {
            if own + i < tick.tiles {
                counts[own + i] = before + places[i];
                atomicStore(&ends[own + i], before + places[i]);
            }
        }
        // Saturates: more pairs than 2^32 are more than there is room for, not fewer.
        carry = select(carry + scan_total, 0xffffffffu, carry + scan_total < carry);
        workgroupBarrier();
    }
    if thread == 0u {
        sizes[VISIBLE] = counts[tick.tiles];
        sizes[PAIRS_WANTED] = carry;
        sizes[PAIRS] = min(carry, tick.pairs);
    }
}

fn emit_pair(cover: Cover, index: u32, slot: u32, tiles_x: u32) {
    let tile = tile_of(cover, index, tiles_x);
    if tile != NO_TILE {
        pairs[atomicAdd(&ends[tile], 1u)] = vec2(cover.key, slot);
    }
}

// One workgroup per region.
@compute @workgroup_size(256)
fn emit(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let slot = group.x * BLOCK + thread;
    // With no room for all pairs there will be another try.
    var cover = nothing();
    if sizes[PAIRS_WANTED] <= tick.pairs {
        cover = covers[slot];
    }
    let tiles_x = views[(cover.size >> 20u) * tick.parts].size.z;
    for (var i = 0u; i < tiles_alone(cover); i++) {
        emit_pair(cover, i, slot, tiles_x);
    }
    let large_tiles = share(thread, cover);
    for (var i = thread; i < large_tiles; i += 256u) {
        let whose = owner(i);
        let whole = large[whose];
        let across = views[(whole.size >> 20u) * tick.parts].size.z;
        emit_pair(whole, i - starts[whose], group.x * BLOCK + whose, across);
    }
}
