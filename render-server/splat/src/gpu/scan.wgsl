// Exclusive prefix sum over the 256 threads of a workgroup, in workgroup memory alone: no subgroup
// operation, so it is right for subgroups of any size and for none. Sixteen runs of sixteen, for
// barriers cost more than short loops: three of them instead of seventeen.

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
    // Also keeps the next call from writing over what slower threads still read.
    workgroupBarrier();
    return before;
}
