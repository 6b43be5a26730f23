//! What a renderer may use, and the size of a tile.

/// Side of a tile; `TILE` in `common.wgsl`. [px]
pub(super) const TILE_PX: u32 = 16;

/// What a renderer may use and starts with; the defaults suit every scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Greatest size of a buffer that shaders see; the adapter's own limit holds too.
    pub binding_bytes: u64,
    /// Regions of 256 slots to begin with; grown where an image needs more.
    pub regions: u32,
    /// (Tile, splat) pairs to begin with; grown where an image needs more.
    pub pairs: u32,
    /// Whether pixels are written to the host's memory, if the adapter can; else they are copied there.
    pub writes_to_host: bool,
}

impl Default for Budget {
    /// 70 MB of slots, 32 MB of pairs.
    fn default() -> Self {
        Self { binding_bytes: u64::MAX, regions: 4096, pairs: 1 << 21, writes_to_host: true }
    }
}
