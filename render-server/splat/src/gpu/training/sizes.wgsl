// Counts of the device, so that nothing is read back within a step.

/// Indices into `sizes`; `read.rs` uses the same.
const REGIONS_WANTED = 0u;
/// Slots in use, BLOCK per region.
const SLOTS = 1u;
/// Splats that touch an image.
const VISIBLE = 2u;
const PAIRS_WANTED = 3u;
/// Pairs in use.
const PAIRS = 4u;

/// Index of the first of three words of each indirect dispatch in `dispatches`.
const SORT_SLOTS = 0u;
const SORT_VISIBLE = 4u;
const BIN = 8u;
const SORT_PAIRS = 12u;

/// Keys per workgroup of the sort.
const SORT_GROUP = 2048u;
