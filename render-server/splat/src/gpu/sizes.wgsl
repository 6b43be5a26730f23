// Counts of the device, so that nothing is read back within a tick.

/// Indices into `sizes`; `read.rs` uses the same.
const REGIONS_WANTED = 0u;
/// Slots in use, BLOCK per region.
const SLOTS = 1u;
/// Splats that touch an image.
const VISIBLE = 2u;
const PAIRS_WANTED = 3u;
/// Pairs in use.
const PAIRS = 4u;
