//! Resource limits of a renderer, and the size of a tile.

/// Side of a tile; `TILE` in `common.wgsl`. [px]
pub(super) const TILE_PX: u32 = 16;

/// Resource limits and initial sizes of a renderer; the defaults suit every scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Maximum size of a buffer that shaders access; the adapter's own limit also applies.
    pub binding_bytes: u64,
    /// Initial number of regions of 256 slots; grows if an image needs more.
    pub regions: u32,
    /// Initial number of (tile, splat) pairs; grows if an image needs more.
    pub pairs: u32,
    /// Whether shaders write pixels directly to host memory, if the adapter supports it. Otherwise pixels are copied.
    pub writes_to_host: bool,
}

impl Default for Budget {
    /// 70 MB of slots, 32 MB of pairs.
    fn default() -> Self {
        Self { binding_bytes: u64::MAX, regions: 4096, pairs: 1 << 21, writes_to_host: true }
    }
}
