// Pass 4: sorts the list of each tile from near to far. One workgroup per tile.
//
// Runs of CHUNK pairs are sorted in workgroup memory by a bitonic network. Longer lists merge their runs in the
// device's memory, alternating between both buffers, and end in the first.

@group(0) @binding(0) var<uniform> tick: Tick;
@group(0) @binding(1) var<storage, read> firsts: array<u32>;
@group(0) @binding(2) var<storage, read> ends: array<u32>;
// Depth as bits, slot.
@group(0) @binding(3) var<storage, read_write> pairs: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read_write> other: array<vec2<u32>>;

const CHUNK = 1024u;
const THREADS = 256u;
/// Maximum number of workgroups along x.
const GRID = 32768u;
/// Number of pairs that a thread merges one after the other.
const STRIP = 16u;

var<workgroup> run: array<vec2<u32>, CHUNK>;
var<workgroup> own_list: vec2<u32>;

/// Returns whether a pair is nearer; pairs of equal depth stay in scene order.
fn is_before(a: vec2<u32>, b: vec2<u32>) -> bool {
    return a.x < b.x || (a.x == b.x && a.y < b.y);
}

/// Returns two pairs, the nearer one first if `is_up`, otherwise last.
fn ordered(a: vec2<u32>, b: vec2<u32>, is_up: bool) -> vec4<u32> {
    return select(vec4(a, b), vec4(b, a), is_before(b, a) == is_up);
}

/// Sorts a run of `pairs` in place, or writes it to `other`.
fn sort_run(thread: u32, first: u32, count: u32, stays: bool) {
    var size = 2u;
    while size < count {
        size *= 2u;
    }
    for (var i = thread; i < size; i += THREADS) {
        run[i] = vec2(0xffffffffu);
        if i < count {
            run[i] = pairs[first + i];
        }
    }
    workgroupBarrier();
    for (var block = 2u; block <= size; block *= 2u) {
        var step = block / 2u;
        // Two steps at a time, each thread with four pairs of the run: an odd number of steps
        // starts with a single one.
        if countTrailingZeros(block) % 2u == 1u {
            for (var i = thread; i < size / 2u; i += THREADS) {
                let low = 2u * i - (i & (step - 1u));
                let pair = ordered(run[low], run[low + step], (low & block) == 0u);
                run[low] = pair.xy;
                run[low + step] = pair.zw;
            }
            workgroupBarrier();
            step /= 2u;
        }
        for (; step > 0u; step /= 4u) {
            let half = step / 2u;
            for (var i = thread; i < size / 4u; i += THREADS) {
                let low = 4u * i - 3u * (i & (half - 1u));
                let is_up = (low & block) == 0u;
                let even = ordered(run[low], run[low + step], is_up);
                let odd = ordered(run[low + half], run[low + step + half], is_up);
                let left = ordered(even.xy, odd.xy, is_up);
                let right = ordered(even.zw, odd.zw, is_up);
                run[low] = left.xy;
                run[low + half] = left.zw;
                run[low + step] = right.xy;
                run[low + step + half] = right.zw;
            }
            workgroupBarrier();
        }
    }
    for (var i = thread; i < count; i += THREADS) {
        if stays {
            pairs[first + i] = run[i];
        } else {
            other[first + i] = run[i];
        }
    }
    workgroupBarrier();
}

fn at(i: u32, in_other: bool) -> vec2<u32> {
    if in_other {
        return other[i];
    }
    return pairs[i];
}

/// Merges neighbouring runs of `length` pairs, from one buffer into the other.
fn merge(thread: u32, first: u32, count: u32, length: u32, from_other: bool) {
    for (var start = thread * STRIP; start < count; start += THREADS * STRIP) {
        // The two runs: a, and b, as ranges of the list.
        let a = start / (2u * length) * 2u * length;
        let b = min(a + length, count);
        let end = min(b + length, count);
        // Number of the first `start - a` merged pairs that are from run a.
        let before = start - a;
        var low = before - min(before, end - b);
        var high = min(before, b - a);
        while low < high {
            let middle = (low + high) / 2u;
            let left = at(first + a + middle, from_other);
            let right = at(first + b + before - middle - 1u, from_other);
            if is_before(right, left) {
                high = middle;
            } else {
                low = middle + 1u;
            }
        }
        var i = a + low;
        var j = b + before - low;
        for (var k = start; k < min(start + STRIP, end); k++) {
            var is_left = j >= end;
            if i < b && j < end {
                is_left = is_before(at(first + i, from_other), at(first + j, from_other));
            }
            let next = at(first + select(j, i, is_left), from_other);
            i += select(0u, 1u, is_left);
            j += select(1u, 0u, is_left);
            if from_other {
                pairs[first + k] = next;
            } else {
                other[first + k] = next;
            }
        }
    }
    storageBarrier();
    workgroupBarrier();
}

@compute @workgroup_size(256)
fn sort(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group.y * GRID + group.x;
    if tile >= tick.tiles {
        return;
    }
    if thread == 0u {
        own_list = vec2(firsts[tile], ends[tile] - firsts[tile]);
    }
    let list = workgroupUniformLoad(&own_list);
    let first = list.x;
    let count = list.y;
    var merges = 0u;
    for (var length = CHUNK; length < count; length *= 2u) {
        merges++;
    }
    var from_other = merges % 2u == 1u;
    for (var start = 0u; start < count; start += CHUNK) {
        sort_run(thread, first + start, min(CHUNK, count - start), !from_other);
    }
    storageBarrier();
    workgroupBarrier();
    for (var length = CHUNK; length < count; length *= 2u) {
        merge(thread, first, count, length, from_other);
        from_other = !from_other;
    }
}
