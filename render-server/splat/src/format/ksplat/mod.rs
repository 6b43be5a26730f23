//! `.ksplat`: mkkellogg's GaussianSplats3D viewer.
//!
//! A header of 4096 bytes, one of 1024 per section, then the sections' data. Splats of a section
//! lie in buckets of a cube in space each: first the full ones, then the others, whose sizes are
//! listed. There is no magic, but the header has enough that must agree.
//!
//! | | level 0 | level 1 | level 2 |
//! |---|---|---|---|
//! | centre | f32 | u16 from the bucket's centre | u16 |
//! | standard deviations, linear | f32 | f16 | f16 |
//! | quaternion wxyz | f32 | f16 | f16 |
//! | red, green, blue (0.5 + c0 h), opacity, linear | u8 | u8 | u8 |
//! | harmonics, band by band, channel-major within | f32 | f16 | u8 between the header's bounds |
//!
//! Degree 0 to 2; axes as in the PLY it was made from.

mod read;
mod write;

pub(super) use read::{decode, is_ksplat};
pub(super) use write::{MAX_SH_DEGREE, encode};

/// The file's header. [byte]
const HEADER_BYTES: usize = 4096;
/// A section's header. [byte]
const SECTION_BYTES: usize = 1024;
/// A bucket's centre, three f32. [byte]
const BUCKET_BYTES: usize = 12;
/// The middle of the u16 that position within a bucket is written as, where a file has none.
const DEFAULT_RANGE: u32 = 32767;
/// Bounds of level 2's harmonics where a file has none.
const DEFAULT_HARMONIC: f32 = 1.5;

/// Where the parts of a splat start at a level of compression. [byte]
#[derive(Clone, Copy)]
struct Row {
    scale: usize,
    rotation: usize,
    colour: usize,
    harmonics: usize,
    /// Size of a harmonic.
    harmonic: usize,
}

impl Row {
    const LEVELS: [Self; 3] = [
        Self { scale: 12, rotation: 24, colour: 40, harmonics: 44, harmonic: 4 },
        Self { scale: 6, rotation: 12, colour: 20, harmonics: 24, harmonic: 2 },
        Self { scale: 6, rotation: 12, colour: 20, harmonics: 24, harmonic: 1 },
    ];

    /// Returns the size of a splat. [byte]
    fn bytes(&self, sh_degree: u8) -> usize {
        self.harmonics + ((usize::from(sh_degree) + 1).pow(2) - 1) * 3 * self.harmonic
    }
}

/// Returns which of a splat's harmonics, as stored, is coefficient `k` (not 0) of a channel.
fn harmonic_index(k: usize, channel: usize) -> usize {
    match k {
        1..=3 => channel * 3 + k - 1,
        4..=8 => 9 + channel * 5 + k - 4,
        _ => 24 + channel * 7 + k - 9,
    }
}
