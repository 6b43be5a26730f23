// Which tiles a splat touches: found once, by `project`, and read by `emit`, so that both count alike.
//
// Tiles are those of a rectangle, in cells of 8 columns and 4 rows: of a tile each in a rectangle no larger
// than that, of several in a larger one. A workgroup walks the tiles of its 256 splats together: each thread
// those of its own small rectangle, then all of them those of the large ones.

/// A splat in an image of so many tiles across.
struct Cover {
    /// The rectangle's first tile.
    first: u32,
    /// Columns; rows << 10; camera << 20.
    size: u32,
    /// A bit per cell, row by row, that the ellipse reaches.
    cells: u32,
    /// Camera z as bits, which order as the positive numbers do.
    key: u32,
}

const CELL_COLUMNS = 8u;
const CELL_ROWS = 4u;
const NO_TILE = 0xffffffffu;
/// Tiles of a rectangle that one thread walks alone.
const ALONE = 8u;

/// Is the cover of a slot without a splat.
fn nothing() -> Cover {
    return Cover(0u, 0u, 0u, 0u);
}

fn columns(cover: Cover) -> u32 {
    return cover.size & 1023u;
}

fn rows(cover: Cover) -> u32 {
    return cover.size >> 10u & 1023u;
}

/// Returns the tiles from column to column, and from row to row, of a cell.
fn cell_size(cover: Cover) -> vec2<u32> {
    return vec2(
        (columns(cover) + CELL_COLUMNS - 1u) / CELL_COLUMNS,
        (rows(cover) + CELL_ROWS - 1u) / CELL_ROWS,
    );
}

/// Returns a tile of the rectangle, counted row by row; NO_TILE where the ellipse does not reach its cell.
fn tile_of(cover: Cover, index: u32, tiles_x: u32) -> u32 {
    let at = vec2(index % columns(cover), index / columns(cover));
    let cell = at / cell_size(cover);
    let is_touched = (cover.cells >> (cell.y * CELL_COLUMNS + cell.x) & 1u) == 1u;
    return select(NO_TILE, cover.first + at.y * tiles_x + at.x, is_touched);
}

/// Returns the number of tiles of the rectangle, if the splat's own thread walks them.
fn tiles_alone(cover: Cover) -> u32 {
    let tiles = columns(cover) * rows(cover);
    return select(0u, tiles, tiles <= ALONE);
}

var<workgroup> large: array<Cover, 256>;
/// Tiles of large rectangles before each thread's.
var<workgroup> starts: array<u32, 256>;
var<workgroup> large_tiles: u32;

/// Notes each thread's rectangle if it is large; returns their tiles. Every thread must call it.
fn share(thread: u32, cover: Cover) -> u32 {
    let tiles = columns(cover) * rows(cover);
    let before = scan(thread, select(0u, tiles, tiles > ALONE));
    large[thread] = cover;
    starts[thread] = before;
    if thread == 0u {
        large_tiles = scan_total;
    }
    return workgroupUniformLoad(&large_tiles);
}

/// Returns whose rectangle a tile of `share` is of.
fn owner(tile: u32) -> u32 {
    // The last that starts at or before it: those without tiles start where the next does.
    var low = 0u;
    for (var step = 128u; step > 0u; step /= 2u) {
        if starts[low + step] <= tile {
            low += step;
        }
    }
    return low;
}
