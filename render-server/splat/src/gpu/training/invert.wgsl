// After pass 2 of training: the sort by tile has moved the numbers of pairs, not their slots. From those
// numbers come the lists of slots, and where each pair stands in them: a splat's pairs, which `emit` wrote
// one after the other, find what the tiles summed up for it.

@group(0) @binding(0) var<storage, read> sizes: array<u32>;
@group(0) @binding(1) var<storage, read> slots: array<u32>;
@group(0) @binding(2) var<storage, read> permutation: array<u32>;
@group(0) @binding(3) var<storage, read> sorted_tiles: array<u32>;
@group(0) @binding(4) var<storage, read_write> sorted_slots: array<u32>;
@group(0) @binding(5) var<storage, read_write> places: array<u32>;
@group(0) @binding(6) var<uniform> tick: Tick;

/// The place of a pair that is in no tile's list.
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
