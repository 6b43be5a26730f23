// Before pass 1 of training: copies changed rows to their places. Each thread moves one value, as bits.

// Number of rows, changed values of each, values of each, unused; then the rows' indices; then, from an even index
// on, their values.
@group(0) @binding(0) var<storage, read> changes: array<u32>;
@group(0) @binding(1) var<storage, read_write> rows: array<u32>;

const HEADER = 4u;
/// Maximum number of workgroups along x.
const GRID = 32768u;

@compute @workgroup_size(256)
fn scatter(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let count = changes[0];
    let columns = changes[1];
    let i = (group.y * GRID + group.x) * 256u + thread;
    if i >= count * columns {
        return;
    }
    let first = (HEADER + count + 1u) / 2u * 2u;
    rows[changes[HEADER + i / columns] * changes[2] + i % columns] = changes[first + i];
}
