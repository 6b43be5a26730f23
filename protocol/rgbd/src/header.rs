//! The bitstream's header: what it holds, how large, and where each part ends.

use vizflyt_protocol::geometry::Intrinsics;
use zerocopy::byteorder::little_endian::U32;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::codec::DecodeError;

/// Largest side of an image; bounds every buffer. [px]
pub const MAX_SIDE: u32 = Intrinsics::MAX_SIDE_PX;

/// How depth is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum DepthMode {
    /// Lossless, quick: [`crate::depth`].
    Fast = 1,
}

/// What a bitstream says of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Info {
    /// Image width. [px]
    pub width: u32,
    /// Image height. [px]
    pub height: u32,
    /// Whether it holds colour, as JPEG.
    pub has_color: bool,
    /// How it holds depth; `None` if it does not.
    pub depth_mode: Option<DepthMode>,
    /// Bytes of the colour part.
    pub color_len: usize,
    /// Bytes of the depth part.
    pub depth_len: usize,
}

/// The layout on the wire; colour and depth follow, in this order, without gaps.
#[derive(Clone, Copy, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
pub(crate) struct Header {
    magic: [u8; 4],
    version: u8,
    color_mode: u8,
    depth_mode: u8,
    reserved: u8,
    width: U32,
    height: U32,
    color_len: U32,
    depth_len: U32,
}

const MAGIC: [u8; 4] = *b"VZRD";
const VERSION: u8 = 1;
const ABSENT: u8 = 0;
const COLOR_JPEG: u8 = 1;

impl Header {
    pub(crate) const SIZE: usize = size_of::<Self>();

    pub(crate) fn new(info: &Info) -> Self {
        Self {
            magic: MAGIC,
            version: VERSION,
            color_mode: if info.has_color { COLOR_JPEG } else { ABSENT },
            depth_mode: info.depth_mode.map_or(ABSENT, |mode| mode as u8),
            reserved: 0,
            width: info.width.into(),
            height: info.height.into(),
            color_len: U32::new(info.color_len as u32),
            depth_len: U32::new(info.depth_len as u32),
        }
    }
}

/// Reads the header and checks that exactly the parts it names follow.
///
/// # Errors
/// Any [`DecodeError`] but those about the caller's slices and the parts' insides.
pub fn peek(bytes: &[u8]) -> Result<Info, DecodeError> {
    parse(bytes).map(|(info, _, _)| info)
}

/// Reads the header; returns it with the colour part and the depth part.
pub(crate) fn parse(bytes: &[u8]) -> Result<(Info, &[u8], &[u8]), DecodeError> {
    let (header, rest) =
        Header::read_from_prefix(bytes).map_err(|_| DecodeError::Short(bytes.len()))?;
    if header.magic != MAGIC {
        return Err(DecodeError::Foreign(header.magic));
    }
    if header.version != VERSION {
        return Err(DecodeError::Version(header.version));
    }
    let has_color = match header.color_mode {
        ABSENT => false,
        COLOR_JPEG => true,
        other => return Err(DecodeError::Mode("colour", other)),
    };
    let depth_mode = match header.depth_mode {
        ABSENT => None,
        mode if mode == DepthMode::Fast as u8 => Some(DepthMode::Fast),
        other => return Err(DecodeError::Mode("depth", other)),
    };
    if header.reserved != 0 {
        return Err(DecodeError::Mode("reserved", header.reserved));
    }
    let (width, height) = (header.width.get(), header.height.get());
    let side = 1..=MAX_SIDE;
    if !side.contains(&width) || !side.contains(&height) {
        return Err(DecodeError::Size(width, height));
    }
    let (color_len, depth_len) = (header.color_len.get() as usize, header.depth_len.get() as usize);
    let absent_yet_long = !has_color && color_len > 0 || depth_mode.is_none() && depth_len > 0;
    if absent_yet_long || rest.len() as u64 != color_len as u64 + depth_len as u64 {
        return Err(DecodeError::Length {
            expected: Header::SIZE as u64 + color_len as u64 + depth_len as u64,
            found: bytes.len(),
        });
    }
    let (color, depth) = rest.split_at(color_len);
    Ok((Info { width, height, has_color, depth_mode, color_len, depth_len }, color, depth))
}
