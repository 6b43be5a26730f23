// Exclusive prefix sum over the 256 threads of a workgroup, in workgroup memory alone: no subgroup
// operation, so it is right for subgroups of any size and for none.

var<workgroup> scanned: array<u32, 256>;
var<workgroup> scan_total: u32;

/// Returns the sum of `value` over all threads before this one. Every thread must call it.
fn scan(thread: u32, value: u32) -> u32 {
    var sum = value;
    scanned[thread] = sum;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step <<= 1u) {
        var before = 0u;
        if thread >= step {
            before = scanned[thread - step];
        }
        workgroupBarrier();
        sum += before;
        scanned[thread] = sum;
        workgroupBarrier();
    }
    if thread == 255u {
        scan_total = sum;
    }
    // Also keeps the next call from writing over what slower threads still read.
    workgroupBarrier();
    return sum - value;
}
