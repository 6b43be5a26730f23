// One digit of a stable radix sort of (key, value) pairs: pass 3, and again in pass 4.
//
// `count` counts the digits of each group of keys, `rows` converts the counts of each digit to positions, `scatter`
// moves. Ranks within a group are computed with bit masks in workgroup memory: a thread sets its bit in its digit's
// mask, and its rank is the number of set bits below its own. No subgroup operations and no waiting for other
// workgroups: correct for any subgroup size.

struct Digit {
    shift: u32,
    /// Index into `sizes` of the number of keys.
    size: u32,
    padding: vec2<u32>,
}

@group(0) @binding(0) var<uniform> digit_of: Digit;
@group(0) @binding(1) var<storage, read> sizes: array<u32>;
@group(0) @binding(2) var<storage, read> keys_in: array<u32>;
@group(0) @binding(3) var<storage, read> values_in: array<u32>;
@group(0) @binding(4) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> values_out: array<u32>;
// Counts per digit and group; then per digit.
@group(0) @binding(6) var<storage, read_write> counts: array<u32>;

/// First pass: values are the indices of the keys, and EMPTY keys are dropped.
override FIRST: bool = false;

const ROUNDS = SORT_GROUP / 256u;

var<workgroup> tally: array<atomic<u32>, 256>;
/// Bit t of word w of digit d is set if thread 32 w + t has digit d. Stored word by word.
var<workgroup> masks: array<atomic<u32>, 2048>;
/// Position of the group's next key of each digit.
var<workgroup> places: array<u32, 256>;

fn is_in(key: u32) -> bool {
    return !FIRST || key != EMPTY;
}

fn digit(key: u32) -> u32 {
    return (key >> digit_of.shift) & 255u;
}

@compute @workgroup_size(256)
fn count(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let size = sizes[digit_of.size];
    let groups = (size + SORT_GROUP - 1u) / SORT_GROUP;
    atomicStore(&tally[thread], 0u);
    workgroupBarrier();
    for (var round = 0u; round < ROUNDS; round++) {
        let i = group.x * SORT_GROUP + round * 256u + thread;
        if i < size {
            let key = keys_in[i];
            if is_in(key) {
                atomicAdd(&tally[digit(key)], 1u);
            }
        }
    }
    workgroupBarrier();
    counts[thread * groups + group.x] = atomicLoad(&tally[thread]);
}

// One workgroup per digit.
@compute @workgroup_size(256)
fn rows(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let groups = (sizes[digit_of.size] + SORT_GROUP - 1u) / SORT_GROUP;
    let row = group.x * groups;
    var carry = 0u;
    for (var first = 0u; first < groups; first += 256u) {
        let i = first + thread;
        var count = 0u;
        if i < groups {
            count = counts[row + i];
        }
        let before = scan(thread, count);
        if i < groups {
            counts[row + i] = carry + before;
        }
        carry += scan_total;
        workgroupBarrier();
    }
    if thread == 0u {
        counts[256u * groups + group.x] = carry;
    }
}

@compute @workgroup_size(256)
fn scatter(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let size = sizes[digit_of.size];
    let groups = (size + SORT_GROUP - 1u) / SORT_GROUP;
    let smaller = scan(thread, counts[256u * groups + thread]);
    places[thread] = smaller + counts[thread * groups + group.x];
    for (var word = 0u; word < 8u; word++) {
        atomicStore(&masks[word * 256u + thread], 0u);
    }
    workgroupBarrier();
    let own_word = thread / 32u;
    let own_bit = 1u << (thread % 32u);
    for (var round = 0u; round < ROUNDS; round++) {
        let i = group.x * SORT_GROUP + round * 256u + thread;
        var key = EMPTY;
        var takes_part = false;
        if i < size {
            key = keys_in[i];
            takes_part = is_in(key);
        }
        let own_digit = digit(key);
        if takes_part {
            atomicOr(&masks[own_word * 256u + own_digit], own_bit);
        }
        workgroupBarrier();
        if takes_part {
            var place = places[own_digit];
            for (var word = 0u; word < own_word; word++) {
                place += countOneBits(atomicLoad(&masks[word * 256u + own_digit]));
            }
            place += countOneBits(atomicLoad(&masks[own_word * 256u + own_digit]) & (own_bit - 1u));
            keys_out[place] = key;
            if FIRST {
                values_out[place] = i;
            } else {
                values_out[place] = values_in[i];
            }
        }
        workgroupBarrier();
        // From here on, each thread processes the digit that equals its own index.
        var taken = 0u;
        for (var word = 0u; word < 8u; word++) {
            taken += countOneBits(atomicExchange(&masks[word * 256u + thread], 0u));
        }
        places[thread] += taken;
        workgroupBarrier();
    }
}
