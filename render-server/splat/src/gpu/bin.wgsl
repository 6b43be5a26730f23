// Pass 3: lists the splats of each tile, in any order; `sort` sorts the lists.
//
// `project` has counted the splats of each tile: `place` converts the counts to positions, and `emit` writes there.

@group(0) @binding(0) var<uniform> tick: Tick;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read_write> sizes: array<u32>;
@group(0) @binding(3) var<storage, read> covers: array<Cover>;
// Splats per tile, then those of all images; `place` replaces each tile's count by its first pair.
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;
// The same, but the end of the tile's pairs after `emit` has run.
@group(0) @binding(5) var<storage, read_write> ends: array<atomic<u32>>;
// Depth as bits, slot.
@group(0) @binding(6) var<storage, read_write> pairs: array<vec2<u32>>;

/// Number of tiles per thread and iteration.
const EACH = 4u;

// One workgroup: converts numbers of pairs to first pairs.
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
        // Saturates: an overflow of 2^32 pairs must not appear as fewer pairs.
        carry = select(carry + scan_total, 0xffffffffu, carry + scan_total < carry);
        workgroupBarrier();
    }
    if thread == 0u {
        sizes[VISIBLE] = counts[tick.tiles];
        sizes[PAIRS_WANTED] = carry;
        sizes[PAIRS] = min(carry, tick.pairs);
    }
}

/// Number of tiles that a thread processes concurrently, to hide the latency of atomics.
const AT_ONCE = 4u;

// One workgroup per region.
@compute @workgroup_size(256)
fn emit(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let slot = group.x * BLOCK + thread;
    // Too little room for all pairs: the tick is rendered again.
    var own = nothing();
    if sizes[PAIRS_WANTED] <= tick.pairs {
        own = covers[slot];
    }
    let large_tiles = share(thread, own);
    let tiles_x = views[(own.size >> 20u) * tick.parts].size.z;
    for (var first = 0u; first < tiles_alone(own); first += AT_ONCE) {
        var places: array<u32, AT_ONCE>;
        for (var i = 0u; i < AT_ONCE; i++) {
            places[i] = place_in(own, first + i, tiles_x);
        }
        for (var i = 0u; i < AT_ONCE; i++) {
            write(places[i], own.key, slot);
        }
    }
    for (var first = thread; first < large_tiles; first += 256u * AT_ONCE) {
        var places: array<u32, AT_ONCE>;
        var whose: array<u32, AT_ONCE>;
        for (var i = 0u; i < AT_ONCE; i++) {
            let tile = first + 256u * i;
            whose[i] = owner(min(tile, large_tiles - 1u));
            let cover = large[whose[i]];
            let across = views[(cover.size >> 20u) * tick.parts].size.z;
            // After the last tile: an index outside of the rectangle.
            places[i] = place_in(cover, select(NO_TILE, tile - starts[whose[i]], tile < large_tiles), across);
        }
        for (var i = 0u; i < AT_ONCE; i++) {
            write(places[i], large[whose[i]].key, group.x * BLOCK + whose[i]);
        }
    }
}

/// Returns a position in the list of a tile of a rectangle; NO_PLACE if the ellipse does not reach the tile.
fn place_in(cover: Cover, index: u32, tiles_x: u32) -> u32 {
    if index < columns(cover) * rows(cover) {
        let tile = tile_of(cover, index, tiles_x);
        if tile != NO_TILE {
            return atomicAdd(&ends[tile], 1u);
        }
    }
    return NO_PLACE;
}

const NO_PLACE = 0xffffffffu;

fn write(place: u32, key: u32, slot: u32) {
    if place != NO_PLACE {
        pairs[place] = vec2(key, slot);
    }
}
