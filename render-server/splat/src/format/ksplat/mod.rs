//! `.ksplat`: format of mkkellogg's viewer GaussianSplats3D.
//!
//! A file has a header of 4096 bytes, a header of 1024 bytes per section, then the data of the
//! sections. The splats of a section are grouped in buckets, one per cube of space: first the full
//! buckets, then the others, whose sizes are listed. There is no magic number; a file is detected
//! by consistent values in its header.
//!
//! | | level 0 | level 1 | level 2 |
//! |---|---|---|---|
//! | centre | f32 | u16 from the bucket's centre | u16 |
//! | standard deviations, linear | f32 | f16 | f16 |
//! | quaternion wxyz | f32 | f16 | f16 |
//! | red, green, blue (0.5 + c0 h), opacity, linear | u8 | u8 | u8 |
//! | harmonics, band by band, channel-major within | f32 | f16 | u8 between the header's bounds |
//!
//! Degree 0 to 2. Axes are those of the source PLY.

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
/// Default of the quantisation range: half the range of the u16 that stores a position within a
/// bucket.
const DEFAULT_RANGE: u32 = 32767;
/// Default bounds of the harmonics of level 2.
const DEFAULT_HARMONIC: f32 = 1.5;

/// Offsets of the parts of a splat, for a level of compression. [byte]
#[derive(Clone, Copy)]
struct Row {
    scale: usize,
    rotation: usize,
    colour: usize,
    harmonics: usize,
    /// Size of one harmonic. [byte]
    harmonic: usize,
}

impl Row {
    const LEVELS: [Self; 3] = [
        Self { scale: 12, rotation: 24, colour: 40, harmonics: 44, harmonic: 4 },
        Self { scale: 6, rotation: 12, colour: 20, harmonics: 24, harmonic: 2 },
        Self { scale: 6, rotation: 12, colour: 20, harmonics: 24, harmonic: 1 },
    ];

    /// Returns the size of one splat. [byte]
    fn bytes(&self, sh_degree: u8) -> usize {
        self.harmonics + ((usize::from(sh_degree) + 1).pow(2) - 1) * 3 * self.harmonic
    }
}

/// Returns the index in the file of coefficient `k` (not 0) of a channel.
fn harmonic_index(k: usize, channel: usize) -> usize {
    match k {
        1..=3 => channel * 3 + k - 1,
        4..=8 => 9 + channel * 5 + k - 4,
        _ => 24 + channel * 7 + k - 9,
    }
}
