//! The headers: what an image holds, how large it is, where each slice ends.

use core::ops::Range;

use vizflyt_protocol::geometry::Intrinsics;
use zerocopy::byteorder::little_endian::{U16, U32};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::depth::bound::DepthBound;
use crate::error::DecodeError;
use crate::image::Parts;

/// Largest side of an image; bounds every buffer. [px]
pub const MAX_SIDE: u32 = Intrinsics::MAX_SIDE_PX;
/// Most slices of an image.
pub const MAX_SLICES: u8 = 64;
/// Bytes of the header that every image begins with.
pub const HEADER_BYTES: usize = size_of::<Header>();
/// Bytes of the header that every slice begins with.
pub const SLICE_HEADER_BYTES: usize = size_of::<SliceHeader>();
/// Most bytes of JPEG tables in the header.
const MAX_TABLES_BYTES: usize = 2048;
/// Slices begin at multiples of so many rows: the tallest JPEG block (4:2:0), and whole blocks of
/// depth. [px]
const SLICE_STEP_ROWS: u32 = 16;

/// How colour is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum ColorMode {
    /// Baseline JPEG, chroma in full resolution.
    #[default]
    Jpeg444 = 1,
    /// Baseline JPEG, chroma halved both ways: a quarter smaller, colours bleed at edges.
    Jpeg420 = 2,
    /// Every value comes back.
    Lossless = 3,
}

/// How depth is packed; what is packed is exact, or rounded to a [`DepthBound`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum DepthMode {
    /// Quick: [`crate::depth`].
    Fast = 1,
    /// Entropy coded: a quarter smaller, several times slower: [`crate::plane`].
    Small = 2,
}

/// What a bitstream says of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Info {
    /// Image width. [px]
    pub width: u32,
    /// Image height. [px]
    pub height: u32,
    /// How it holds colour; `None` if it does not.
    pub color: Option<ColorMode>,
    /// How it holds depth; `None` if it does not.
    pub depth: Option<DepthMode>,
    /// How far depth may be off; `None`: not at all.
    pub depth_bound: Option<DepthBound>,
    /// Whether it holds alpha.
    pub has_alpha: bool,
    /// Whether it holds object ids.
    pub has_ids: bool,
    /// Slices, from top to bottom.
    pub slices: u8,
    /// Bytes before the first slice.
    pub header_len: usize,
}

impl Info {
    /// Returns the rows of a slice; empty if there is no such slice.
    pub fn slice_rows(&self, slice: u8) -> Range<u32> {
        let step = slice_step(self.height, self.slices);
        let at = |n: u32| (n * step).min(self.height);
        at(u32::from(slice))..at(u32::from(slice) + 1)
    }

    /// Returns which parts the image has.
    pub fn parts(&self) -> Parts {
        Parts {
            color: self.color.is_some(),
            depth: self.depth.is_some(),
            alpha: self.has_alpha,
            ids: self.has_ids,
        }
    }
}

/// Returns how many slices an image of so many rows is cut into when `wanted` are asked for.
pub(crate) fn slice_count(height: u32, wanted: u8) -> u8 {
    height.div_ceil(slice_step(height, wanted)) as u8
}

fn slice_step(height: u32, slices: u8) -> u32 {
    height.div_ceil(u32::from(slices)).next_multiple_of(SLICE_STEP_ROWS)
}

/// The layout on the wire; `tables_len` bytes of JPEG tables follow, then the slices.
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

/// Reads the header, of which `bytes` hold at least the first [`HEADER_BYTES`].
///
/// # Errors
/// Any [`DecodeError`] about headers; not whether the slices are whole.
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

/// The layout on the wire; the parts follow in this order, without gaps.
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

/// A slice cut into its parts.
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

/// Returns the length of the slice that begins so, with its header; `None` if fewer than
/// [`SLICE_HEADER_BYTES`] are there. The length is what a sender says: compare it with a limit
/// before making room for it.
pub fn slice_len(bytes: &[u8]) -> Option<u64> {
    SliceHeader::read_from_prefix(bytes).ok().map(|(header, _)| header.len())
}

/// Cuts a slice, given whole and alone.
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
    // The lengths add up to that of `rest`.
    let (color, rest) = rest.split_at(header.color_len.get() as usize);
    let (depth, rest) = rest.split_at(header.depth_len.get() as usize);
    let (alpha, ids) = rest.split_at(header.alpha_len.get() as usize);
    Ok(SliceParts { index: header.index.get(), color, depth, alpha, ids })
}
