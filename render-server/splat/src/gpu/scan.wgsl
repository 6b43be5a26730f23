// Exclusive prefix sum over the 256 threads of a workgroup, in workgroup memory only: no subgroup operations, so it
// is correct for any subgroup size and without subgroups. Sixteen runs of sixteen, because barriers cost more than
// short loops: three barriers instead of seventeen.

const RUN = 16u;

var<workgroup> scanned: array<u32, 256>;
var<workgroup> run_totals: array<u32, 16>;
var<workgroup> scan_total: u32;

/// Returns the sum of `value` over all threads before this one. Every thread must call it.
fn scan(thread: u32, value: u32) -> u32 {
    scanned[thread] = value;
    workgroupBarrier();
    if thread < RUN {
        var sum = 0u;
        for (var i = thread * RUN; i < (thread + 1u) * RUN; i++) {
            let next = scanned[i];
            scanned[i] = sum;
            sum += next;
        }
        run_totals[thread] = sum;
    }
    workgroupBarrier();
    var before = scanned[thread];
    for (var run = 0u; run < thread / RUN; run++) {
        before += run_totals[run];
    }
    if thread == 255u {
        scan_total = before + value;
    }
    // Also prevents the next call from overwriting values that slower threads still read.
    workgroupBarrier();
    return before;
}
