// Tiles that a splat touches: computed once, by `project`, and read by `emit`, so that both count the same tiles.
//
// The tiles form a rectangle that is divided into at most 8 x 4 cells. A cell is one tile in a rectangle of at most
// 8 x 4 tiles, otherwise several tiles. A workgroup processes the tiles of its 256 splats
// together: first each thread those of its own small rectangle, then all threads those of the large rectangles.

/// Touched tiles of a splat.
struct Cover {
    /// First tile of the rectangle.
    first: u32,
    /// Columns; rows << 10; camera << 20.
    size: u32,
    /// Bits of the cells that the ellipse reaches, row by row.
    cells: u32,
    /// Camera z as bits; for positive numbers their order is the same.
    key: u32,
}

const CELL_COLUMNS = 8u;
const CELL_ROWS = 4u;
const NO_TILE = 0xffffffffu;
/// Maximum number of tiles of a rectangle that one thread processes.
const ALONE = 8u;

/// Returns the cover of a slot without a splat.
fn nothing() -> Cover {
    return Cover(0u, 0u, 0u, 0u);
}

fn columns(cover: Cover) -> u32 {
    return cover.size & 1023u;
}

fn rows(cover: Cover) -> u32 {
    return cover.size >> 10u & 1023u;
}

/// Returns the size of a cell in tiles: columns and rows.
fn cell_size(cover: Cover) -> vec2<u32> {
    return vec2(
        (columns(cover) + CELL_COLUMNS - 1u) / CELL_COLUMNS,
        (rows(cover) + CELL_ROWS - 1u) / CELL_ROWS,
    );
}

/// Returns a tile of the rectangle, numbered row by row; NO_TILE if the ellipse does not reach its cell.
fn tile_of(cover: Cover, index: u32, tiles_x: u32) -> u32 {
    let at = vec2(index % columns(cover), index / columns(cover));
    let cell = at / cell_size(cover);
    let is_touched = (cover.cells >> (cell.y * CELL_COLUMNS + cell.x) & 1u) == 1u;
    return select(NO_TILE, cover.first + at.y * tiles_x + at.x, is_touched);
}

/// Returns the number of tiles of the rectangle, if the splat's own thread processes them.
fn tiles_alone(cover: Cover) -> u32 {
    let tiles = columns(cover) * rows(cover);
    return select(0u, tiles, tiles <= ALONE);
}

var<workgroup> large: array<Cover, 256>;
/// Number of tiles of large rectangles before each thread's.
var<workgroup> starts: array<u32, 256>;
var<workgroup> large_tiles: u32;

/// Stores each thread's rectangle if it is large; returns their number of tiles. Every thread must call it.
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

/// Returns the thread whose rectangle contains a tile of `share`.
fn owner(tile: u32) -> u32 {
    // The last one that starts at or before it: threads without tiles start where the next thread does.
    var low = 0u;
    for (var step = 128u; step > 0u; step /= 2u) {
        if starts[low + step] <= tile {
            low += step;
        }
    }
    return low;
}
