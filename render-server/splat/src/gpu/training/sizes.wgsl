// What the device counts on its own, so that nothing is read back in mid-frame.

/// Indices into `sizes`; `read.rs` reads the same.
const REGIONS_WANTED = 0u;
/// Slots in use, BLOCK per region.
const SLOTS = 1u;
/// Splats that touch an image.
const VISIBLE = 2u;
const PAIRS_WANTED = 3u;
/// Pairs in use.
const PAIRS = 4u;

/// First words of the indirect dispatches, three each, in `dispatches`.
const SORT_SLOTS = 0u;
const SORT_VISIBLE = 4u;
const BIN = 8u;
const SORT_PAIRS = 12u;

/// Keys per workgroup of the sort.
const SORT_GROUP = 2048u;
