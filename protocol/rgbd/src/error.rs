//! Errors of encoding and decoding.

use crate::header::{HEADER_BYTES, MAX_SIDE, MAX_SLICES, SLICE_HEADER_BYTES};

/// Why an image is not encoded. All errors depend on the arguments, none on pixel values.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EncodeError {
    /// A side is 0 or too large.
    #[error("image size {0}x{1} is outside 1x1 to {MAX_SIDE}x{MAX_SIDE}")]
    Size(u32, u32),
    /// Colour has the wrong length.
    #[error("colour has {found} bytes; {width}x{height} needs {expected}")]
    Rgb {
        /// Bytes given.
        found: usize,
        /// Bytes needed.
        expected: usize,
        /// Image width. [px]
        width: u32,
        /// Image height. [px]
        height: u32,
    },
    /// Depth has the wrong length.
    #[error("depth has {found} pixels; {width}x{height} needs {expected}")]
    Depth {
        /// Pixels given.
        found: usize,
        /// Pixels needed.
        expected: usize,
        /// Image width. [px]
        width: u32,
        /// Image height. [px]
        height: u32,
    },
    /// Alpha or object ids have the wrong length.
    #[error("{part} has {found} pixels; {width}x{height} needs {expected}")]
    Plane {
        /// `alpha` or `ids`.
        part: &'static str,
        /// Pixels given.
        found: usize,
        /// Pixels needed.
        expected: usize,
        /// Image width. [px]
        width: u32,
        /// Image height. [px]
        height: u32,
    },
    /// The JPEG quality is out of range.
    #[error("JPEG quality {0} is outside 1 to 100")]
    Quality(u8),
    /// The number of slices is out of range.
    #[error("{0} slices are outside 1 to {MAX_SLICES}")]
    Slices(u8),
    /// The rows are not those of the next slice.
    #[error(
        "a slice of {width}x{found} rows was given where {expected} rows are due; start the \
         image, then give slices from the top, each of the parts it was started with"
    )]
    Rows {
        /// Width given. [px]
        width: u32,
        /// Rows given; 0 if the parts differ.
        found: u32,
        /// Rows expected; 0 if no slice is expected.
        expected: u32,
    },
}

/// Why bytes cannot be decoded into the caller's buffers.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// The bytes are shorter than a header.
    #[error("RGB-D image is cut short at {0} of {HEADER_BYTES} header bytes")]
    Short(usize),
    /// The bytes are not an RGB-D image.
    #[error("not an RGB-D image: the bytes start with {0:02x?}")]
    Foreign([u8; 4]),
    /// The bitstream has an unknown version.
    #[error("RGB-D bitstream version {0} is unknown; update the older of the two programs")]
    Version(u8),
    /// A part has an unknown mode.
    #[error("RGB-D image has unknown {0} mode {1}; update the older of the two programs")]
    Mode(&'static str, u8),
    /// A side is 0 or too large.
    #[error("RGB-D image size {0}x{1} is outside 1x1 to {MAX_SIDE}x{MAX_SIDE}")]
    Size(u32, u32),
    /// The number of slices is out of range.
    #[error("RGB-D image in {0} slices of rows; 1 to {expected} are possible", expected = .1)]
    Slices(u8, u8),
    /// The bound of the depth error is out of range, or the image has no depth.
    #[error("RGB-D image has invalid depth bound {0}e-6")]
    Bound(u32),
    /// The number of bytes differs from the lengths in the headers.
    #[error("RGB-D image has {found} bytes; its headers name {expected}")]
    Length {
        /// Length by the headers received, including the headers.
        expected: u64,
        /// Bytes given.
        found: usize,
    },
    /// The image does not have this slice, the slice was decoded before, or no image was started.
    #[error("slice {0} is not part of this image, or was decoded before")]
    Slice(u16),
    /// The length of a slice differs from its header.
    #[error("slice has {found} bytes; its header of {SLICE_HEADER_BYTES} names {expected}")]
    SliceLength {
        /// Length by the header, including the header.
        expected: u64,
        /// Bytes given.
        found: usize,
    },
    /// The image does not have a requested part, or the buffer has another size.
    #[error("the buffer for {part} has {found}, but the {width}x{height} image has {expected}")]
    Room {
        /// `colour`, `alpha` (bytes), `depth` or `ids` (pixels).
        part: &'static str,
        /// Length of the caller's buffer.
        found: usize,
        /// Length of the part; 0 if it is absent.
        expected: usize,
        /// Image width. [px]
        width: u32,
        /// Image height. [px]
        height: u32,
    },
    /// The colour part is damaged.
    #[error("colour is damaged: {0}")]
    Color(String),
    /// The depth part is damaged.
    #[error("depth is damaged: {found} bytes where its blocks need {expected}")]
    Depth {
        /// Bytes of the part.
        found: usize,
        /// Bytes needed according to the table of blocks.
        expected: usize,
    },
    /// A block of depth has more than 16 bits.
    #[error("depth is damaged: no block is stored as {0:#04x}")]
    DepthBlock(u8),
    /// An entropy-coded plane is damaged.
    #[error("{0} is damaged: its bits do not end where its pixels do")]
    Plane(&'static str),
    /// The part of object ids is damaged.
    #[error("ids are damaged: their runs do not end where their pixels do")]
    Ids,
}
