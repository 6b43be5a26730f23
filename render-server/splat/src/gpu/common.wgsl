// Definitions shared by all passes; prepended to each of them.

/// Sizes of a tick, for all its cameras.
struct Tick {
    cameras: u32,
    parts: u32,
    /// Number of blocks of all parts.
    blocks: u32,
    /// Number of tiles of all cameras.
    tiles: u32,
    /// Capacity in regions of BLOCK slots.
    regions: u32,
    /// Capacity in (tile, slot) pairs.
    pairs: u32,
    has_ids: u32,
    /// Maximum error of the position of splats. [px]
    max_error: f32,
}

/// Camera as seen from one part of the scene. `GpuView` of `view.rs` has the same layout in Rust.
struct View {
    /// Row of the rotation into the camera's axes; x of the camera's centre.
    row_x: vec4<f32>,
    /// Same for y.
    row_y: vec4<f32>,
    /// Same for z.
    row_z: vec4<f32>,
    /// fx fy cx cy. [px]
    focal: vec4<f32>,
    /// Bounds of the slopes at which a splat is linearised: minimum x, y, maximum x, y.
    slopes: vec4<f32>,
    /// First four coefficients of the lens, in the order of OpenCV.
    lens: vec4<f32>,
    /// Fifth coefficient; maximum slope of the lens; near plane [m]; 1 if the part is anti-aliased.
    more: vec4<f32>,
    /// Background after light and fog.
    background: vec4<f32>,
    /// Factor of every colour; log2 of the fog's attenuation per metre.
    light: vec4<f32>,
    /// Colour of the fog.
    fog: vec4<f32>,
    /// Width, height [px], tiles across, first tile.
    size: vec4<u32>,
    /// Lens model, 1 if the part is present, first pixel, id.
    flags: vec4<u32>,
    /// A splat at p may be visible if all `normal . (p - centre) + reach * weight >= offset`.
    planes: array<vec4<f32>, 5>,
    weights: array<vec4<f32>, 2>,
}

/// Splats per block, and threads per workgroup.
const BLOCK = 256u;
/// Side of a tile. [px]
const TILE = 16u;
/// log2(1/255): minimum level of a visible splat.
const MIN_LEVEL = -7.9943535;
/// Key of a slot without a splat.
const EMPTY = 0xffffffffu;

/// Splat on the image plane. Training stores the three fields in separate buffers.
struct Projected {
    /// Mean x, y [px], shear, falloff along x [1/px^2].
    shape: vec4<f32>,
    /// Falloff along y, level, id, dy of the ellipse's rightmost point.
    extent: vec4<f32>,
    /// Red, green, blue, camera z [m].
    colour: vec4<f32>,
}
