//! What may be wrong with an image to encode, and with bytes to decode.

use crate::header::{HEADER_BYTES, MAX_SIDE, MAX_SLICES, SLICE_HEADER_BYTES};

/// Why an image is not encoded. All are the caller's to mend; none depends on pixel values.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EncodeError {
    /// A side is 0 or too large.
    #[error("image size {0}x{1} is outside 1x1 to {MAX_SIDE}x{MAX_SIDE}")]
    Size(u32, u32),
    /// Colour of another size.
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
    /// Depth of another size.
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
    /// Alpha or object ids of another size.
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
    /// Quality out of range.
    #[error("JPEG quality {0} is outside 1 to 100")]
    Quality(u8),
    /// Slices out of range.
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
        /// Rows given; 0 if other parts were.
        found: u32,
        /// Rows due; 0 if none is.
        expected: u32,
    },
}

/// Why bytes are no image, or not the one the caller has room for.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// Fewer bytes than a header.
    #[error("RGB-D image is cut short at {0} of {HEADER_BYTES} header bytes")]
    Short(usize),
    /// Another kind of bytes.
    #[error("these bytes are no RGB-D image: they start with {0:02x?}")]
    Foreign([u8; 4]),
    /// A bitstream of another version.
    #[error("RGB-D bitstream version {0} is unknown; update the older of the two programs")]
    Version(u8),
    /// A mode of a part that this program does not know.
    #[error("RGB-D image has unknown {0} mode {1}; update the older of the two programs")]
    Mode(&'static str, u8),
    /// A side is 0 or too large.
    #[error("RGB-D image size {0}x{1} is outside 1x1 to {MAX_SIDE}x{MAX_SIDE}")]
    Size(u32, u32),
    /// Slices out of range.
    #[error("RGB-D image in {0} slices of rows; 1 to {expected} are possible", expected = .1)]
    Slices(u8, u8),
    /// A bound of the depth error out of range, or where there is no depth.
    #[error("RGB-D image has depth bound {0}e-6, which is none")]
    Bound(u32),
    /// More or fewer bytes than the headers name.
    #[error("RGB-D image has {found} bytes; its headers name {expected}")]
    Length {
        /// Bytes that the headers name, with themselves; as far as they are known.
        expected: u64,
        /// Bytes given.
        found: usize,
    },
    /// A slice that the image does not have, that came before, or without an image.
    #[error("slice {0} is none of this image's, or came before")]
    Slice(u16),
    /// A slice cut short, or with bytes to spare.
    #[error("slice has {found} bytes; its header of {SLICE_HEADER_BYTES} names {expected}")]
    SliceLength {
        /// Bytes that its header names, with itself.
        expected: u64,
        /// Bytes given.
        found: usize,
    },
    /// The caller asks for a part that is absent, or its room has another size.
    #[error("{part} goes into room for {found}, but the {width}x{height} image has {expected}")]
    Room {
        /// `colour`, `alpha` (bytes), `depth` or `ids` (pixels).
        part: &'static str,
        /// Length of the caller's slice.
        found: usize,
        /// Length needed; 0 if the part is absent.
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
        /// Bytes that its own table needs.
        expected: usize,
    },
    /// A block of depth that asks for more than 16 bits.
    #[error("depth is damaged: no block is stored as {0:#04x}")]
    DepthBlock(u8),
    /// An entropy-coded plane is damaged.
    #[error("{0} is damaged: its bits do not end where its pixels do")]
    Plane(&'static str),
    /// The part of object ids is damaged.
    #[error("ids are damaged: their runs do not end where their pixels do")]
    Ids,
}
