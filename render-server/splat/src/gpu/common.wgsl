// What all passes share. Put before each of them.

/// Sizes of a tick: all its cameras at once.
struct Tick {
    cameras: u32,
    parts: u32,
    /// Blocks of all parts.
    blocks: u32,
    /// Tiles of all cameras.
    tiles: u32,
    /// Regions there is room for, of BLOCK slots each.
    regions: u32,
    /// (Tile, slot) pairs there is room for.
    pairs: u32,
    has_ids: u32,
    /// How far splats may be rendered from where they are. [px]
    max_error: f32,
}

/// A camera as one part of the scene sees it. `view.rs` holds the same in Rust.
struct View {
    /// Row of the rotation to the camera's axes; the camera's centre, x.
    row_x: vec4<f32>,
    /// ... y.
    row_y: vec4<f32>,
    /// ... z.
    row_z: vec4<f32>,
    /// fx fy cx cy. [px]
    focal: vec4<f32>,
    /// Slopes between which a splat is linearised: least x, y, greatest x, y.
    slopes: vec4<f32>,
    /// The lens's first four coefficients, in the order of OpenCV.
    lens: vec4<f32>,
    /// Its fifth; the greatest slope it images; near plane [m]; 1 if the part is anti-aliased.
    more: vec4<f32>,
    /// What is seen of it through the air.
    background: vec4<f32>,
    /// Factor of every colour; log2 of what fog takes per metre.
    light: vec4<f32>,
    /// Colour of fog.
    fog: vec4<f32>,
    /// Width, height [px], tiles across, first tile.
    size: vec4<u32>,
    /// Lens model, 1 if the part is there, first pixel, id.
    flags: vec4<u32>,
    /// A splat at p may be seen where all `normal . (p - centre) + reach * weight >= offset`.
    planes: array<vec4<f32>, 5>,
    weights: array<vec4<f32>, 2>,
}

/// Splats of a block, threads of a workgroup.
const BLOCK = 256u;
/// Side of a tile. [px]
const TILE = 16u;
/// log2(1/255): below this level a splat is not seen.
const MIN_LEVEL = -7.9943535;
/// The key of a slot without a splat.
const EMPTY = 0xffffffffu;

/// A splat on the image plane. Training keeps the three in buffers of their own.
struct Projected {
    /// Mean x, y [px], shear, falloff along x [1/px^2].
    shape: vec4<f32>,
    /// Falloff along y, level, id, dy of the ellipse's rightmost point.
    extent: vec4<f32>,
    /// Red, green, blue, camera z [m].
    colour: vec4<f32>,
}
