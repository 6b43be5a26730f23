//! Headers: parts and size of an image, and lengths of its slices.

use core::ops::Range;

use vizflyt_protocol::geometry::Intrinsics;
use zerocopy::byteorder::little_endian::{U16, U32};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::depth::bound::DepthBound;
use crate::error::DecodeError;
use crate::image::Parts;

/// Maximum side of an image, which bounds every buffer. [px]
pub const MAX_SIDE: u32 = Intrinsics::MAX_SIDE_PX;
/// Maximum number of slices of an image.
pub const MAX_SLICES: u8 = 64;
/// Length of the header at the beginning of an image. [bytes]
pub const HEADER_BYTES: usize = size_of::<Header>();
/// Length of the header at the beginning of a slice. [bytes]
pub const SLICE_HEADER_BYTES: usize = size_of::<SliceHeader>();
/// Maximum length of JPEG tables in the header. [bytes]
const MAX_TABLES_BYTES: usize = 2048;
/// Slices begin at multiples of this number of rows: the height of the largest JPEG block (4:2:0), and whole blocks of
/// depth. [px]
const SLICE_STEP_ROWS: u32 = 16;

/// Storage of colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum ColorMode {
    /// Baseline JPEG with full chroma resolution.
    #[default]
    Jpeg444 = 1,
    /// Baseline JPEG with half the chroma resolution in both directions: a quarter smaller, with colour bleeding at
    /// edges.
    Jpeg420 = 2,
    /// Lossless colour.
    Lossless = 3,
}

/// Compression of depth, which is exact or rounded to a [`DepthBound`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum DepthMode {
    /// Fast compression: [`crate::depth`].
    Fast = 1,
    /// Entropy coding: a quarter smaller, several times slower: [`crate::plane`].
    Small = 2,
}

/// Contents of an image's header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Info {
    /// Image width. [px]
    pub width: u32,
    /// Image height. [px]
    pub height: u32,
    /// Storage of colour; `None` if absent.
    pub color: Option<ColorMode>,
    /// Compression of depth; `None` if absent.
    pub depth: Option<DepthMode>,
    /// Maximum error of depth; `None` for lossless depth.
    pub depth_bound: Option<DepthBound>,
    /// Whether the image has alpha.
    pub has_alpha: bool,
    /// Whether the image has object ids.
    pub has_ids: bool,
    /// Number of slices, from top to bottom.
    pub slices: u8,
    /// Length of the header including JPEG tables. [bytes]
    pub header_len: usize,
}

impl Info {
    /// Returns the rows of a slice; empty if the image does not have this slice.
    pub fn slice_rows(&self, slice: u8) -> Range<u32> {
        let step = slice_step(self.height, self.slices);
        let at = |n: u32| (n * step).min(self.height);
        at(u32::from(slice))..at(u32::from(slice) + 1)
    }

    /// Returns the parts of the image.
    pub fn parts(&self) -> Parts {
        Parts {
            color: self.color.is_some(),
            depth: self.depth.is_some(),
            alpha: self.has_alpha,
            ids: self.has_ids,
        }
    }
}

/// Returns the number of slices of an image with this height, if `wanted` are requested.
pub(crate) fn slice_count(height: u32, wanted: u8) -> u8 {
    height.div_ceil(slice_step(height, wanted)) as u8
}

fn slice_step(height: u32, slices: u8) -> u32 {
    height.div_ceil(u32::from(slices)).next_multiple_of(SLICE_STEP_ROWS)
}

/// Header in the bitstream. `tables_len` bytes of JPEG tables follow, then the slices.
#[derive(Clone, Copy, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
pub(crate) struct Header {
    magic: [u8; 4],
    version: u8,
    color_mode: u8,
    depth_mode: u8,
    alpha_mode: u8,
    ids_mode: u8,
    slices: u8,
    tables_len: U16,
    width: U16,
    height: U16,
    depth_bound: U32,
}

const MAGIC: [u8; 4] = *b"VZRD";
const VERSION: u8 = 2;
const ABSENT: u8 = 0;
const PRESENT: u8 = 1;

impl Header {
    pub(crate) fn new(info: &Info) -> Self {
        Self {
            magic: MAGIC,
            version: VERSION,
            color_mode: info.color.map_or(ABSENT, |mode| mode as u8),
            depth_mode: info.depth.map_or(ABSENT, |mode| mode as u8),
            alpha_mode: if info.has_alpha { PRESENT } else { ABSENT },
            ids_mode: if info.has_ids { PRESENT } else { ABSENT },
            slices: info.slices,
            tables_len: U16::new((info.header_len - HEADER_BYTES) as u16),
            width: U16::new(info.width as u16),
            height: U16::new(info.height as u16),
            depth_bound: U32::new(info.depth_bound.map_or(0, DepthBound::millionths)),
        }
    }
}

/// Parses the header; `bytes` must contain at least the first [`HEADER_BYTES`].
///
/// # Errors
/// Any [`DecodeError`] about headers. Does not check that the slices are complete.
pub fn peek(bytes: &[u8]) -> Result<Info, DecodeError> {
    let (header, _) =
        Header::read_from_prefix(bytes).map_err(|_| DecodeError::Short(bytes.len()))?;
    if header.magic != MAGIC {
        return Err(DecodeError::Foreign(header.magic));
    }
    if header.version != VERSION {
        return Err(DecodeError::Version(header.version));
    }
    let color = match header.color_mode {
        ABSENT => None,
        1 => Some(ColorMode::Jpeg444),
        2 => Some(ColorMode::Jpeg420),
        3 => Some(ColorMode::Lossless),
        other => return Err(DecodeError::Mode("colour", other)),
    };
    let depth = match header.depth_mode {
        ABSENT => None,
        1 => Some(DepthMode::Fast),
        2 => Some(DepthMode::Small),
        other => return Err(DecodeError::Mode("depth", other)),
    };
    let present = |part, mode| match mode {
        ABSENT => Ok(false),
        PRESENT => Ok(true),
        other => Err(DecodeError::Mode(part, other)),
    };
    let (width, height) = (u32::from(header.width.get()), u32::from(header.height.get()));
    let side = 1..=MAX_SIDE;
    if !side.contains(&width) || !side.contains(&height) {
        return Err(DecodeError::Size(width, height));
    }
    let slices = header.slices;
    if !(1..=MAX_SLICES).contains(&slices) || slice_count(height, slices) != slices {
        let possible = slice_count(height, slices.clamp(1, MAX_SLICES));
        return Err(DecodeError::Slices(slices, possible));
    }
    let depth_bound = match header.depth_bound.get() {
        0 => None,
        millionths => {
            let bound = DepthBound::from_millionths(millionths);
            Some(bound.filter(|_| depth.is_some()).ok_or(DecodeError::Bound(millionths))?)
        }
    };
    let tables_len = usize::from(header.tables_len.get());
    let has_tables = matches!(color, Some(ColorMode::Jpeg444 | ColorMode::Jpeg420));
    if tables_len > if has_tables { MAX_TABLES_BYTES } else { 0 } {
        return Err(DecodeError::Color(format!("{tables_len} bytes of JPEG tables")));
    }
    Ok(Info {
        width,
        height,
        color,
        depth,
        depth_bound,
        has_alpha: present("alpha", header.alpha_mode)?,
        has_ids: present("ids", header.ids_mode)?,
        slices,
        header_len: HEADER_BYTES + tables_len,
    })
}

/// Header of a slice in the bitstream. The parts follow in this order, without gaps.
#[derive(Clone, Copy, Default, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
pub(crate) struct SliceHeader {
    pub(crate) index: U16,
    pub(crate) reserved: U16,
    pub(crate) color_len: U32,
    pub(crate) depth_len: U32,
    pub(crate) alpha_len: U32,
    pub(crate) ids_len: U32,
}

/// A slice split into its parts.
pub(crate) struct SliceParts<'a> {
    pub(crate) index: u16,
    pub(crate) color: &'a [u8],
    pub(crate) depth: &'a [u8],
    pub(crate) alpha: &'a [u8],
    pub(crate) ids: &'a [u8],
}

impl SliceHeader {
    fn len(&self) -> u64 {
        let parts = [self.color_len, self.depth_len, self.alpha_len, self.ids_len];
        SLICE_HEADER_BYTES as u64 + parts.iter().map(|len| u64::from(len.get())).sum::<u64>()
    }
}

/// Returns the length of the slice at the beginning of `bytes`, including its header; `None` with fewer than
/// [`SLICE_HEADER_BYTES`]. The length comes from the sender: check it against a limit before allocating memory.
pub fn slice_len(bytes: &[u8]) -> Option<u64> {
    SliceHeader::read_from_prefix(bytes).ok().map(|(header, _)| header.len())
}

/// Splits one complete slice into its parts.
pub(crate) fn split_slice(bytes: &[u8]) -> Result<SliceParts<'_>, DecodeError> {
    let wrong = |expected| DecodeError::SliceLength { expected, found: bytes.len() };
    let (header, rest) =
        SliceHeader::read_from_prefix(bytes).map_err(|_| wrong(SLICE_HEADER_BYTES as u64))?;
    if header.len() != bytes.len() as u64 {
        return Err(wrong(header.len()));
    }
    if header.reserved.get() != 0 {
        return Err(DecodeError::Mode("slice", header.reserved.get().to_le_bytes()[0].max(1)));
    }
    // The sum of the lengths equals the length of `rest`.
    let (color, rest) = rest.split_at(header.color_len.get() as usize);
    let (depth, rest) = rest.split_at(header.depth_len.get() as usize);
    let (alpha, ids) = rest.split_at(header.alpha_len.get() as usize);
    Ok(SliceParts { index: header.index.get(), color, depth, alpha, ids })
}
