// After pass 2 of training: the sort by tile has moved the indices of pairs, not their slots. This pass derives the
// lists of slots from these indices, and the position of each pair in the lists, so that a splat's pairs, which
// `emit` wrote one after the other, find the sums of the tiles.

@group(0) @binding(0) var<storage, read> sizes: array<u32>;
@group(0) @binding(1) var<storage, read> slots: array<u32>;
@group(0) @binding(2) var<storage, read> permutation: array<u32>;
@group(0) @binding(3) var<storage, read> sorted_tiles: array<u32>;
@group(0) @binding(4) var<storage, read_write> sorted_slots: array<u32>;
@group(0) @binding(5) var<storage, read_write> places: array<u32>;
@group(0) @binding(6) var<uniform> tick: Tick;

/// Position of a pair that is not in the list of any tile.
const NOWHERE = 0xffffffffu;

@compute @workgroup_size(256)
fn invert(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let pairs = sizes[PAIRS];
    for (var round = 0u; round < SORT_GROUP / 256u; round++) {
        let i = group.x * SORT_GROUP + round * 256u + thread;
        if i < pairs {
            let pair = permutation[i];
            sorted_slots[i] = slots[pair];
            places[pair] = select(i, NOWHERE, sorted_tiles[i] >= tick.tiles);
        }
    }
}
