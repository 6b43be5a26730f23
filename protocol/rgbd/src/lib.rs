//! Self-describing bitstream of RGB-D images with any of colour, depth in u16 millimetres, alpha and object ids. Images
//! are divided into slices, so that encoding, sending, receiving and decoding overlap. The server encodes; the runtime
//! decodes directly into shared memory.
//!
//! ```text
//! ImageView -> Encoder -> header | slice | slice ... -> Decoder -> the caller's ImageMut
//!                         slice: header | colour | depth | alpha | ids
//! ```
//!
//! Read in this order:
//! - [`ImageView`], [`ImageMut`]: pixels
//! - [`Info`] and [`peek`]: the header; it contains all options, so a decoder needs no settings
//! - `color`: JPEG with its tables stored once, or lossless planes; [`encode_jpeg`] for single pictures
//! - [`depth`]: prediction, zig-zag and bit packing; a scalar reference and a fast path with identical output;
//!   [`DepthBound`] for lossy depth
//! - `plane`: entropy-coded planes, for small depth, alpha and lossless colour; `ids`: runs
//! - [`Encoder`], [`Decoder`]: keep one of each per stream. They own the scratch memory, so this crate allocates
//!   nothing per image after the first.
//!
//! ```
//! use vizflyt_rgbd::{Decoder, EncodeOptions, Encoder, RgbdView, peek};
//! let (rgb, depth_mm) = (vec![128; 8 * 6 * 3], (0..48).map(|n| 1000 + n).collect::<Vec<u16>>());
//! let view = RgbdView { width: 8, height: 6, rgb: &rgb, depth_mm: &depth_mm };
//! let mut bytes = Vec::new();
//! Encoder::new(EncodeOptions::default()).encode(&view, &mut bytes).unwrap();
//! assert_eq!((peek(&bytes).unwrap().width, peek(&bytes).unwrap().height), (8, 6));
//! let (mut rgb_out, mut depth_out) = (vec![0; rgb.len()], vec![0; depth_mm.len()]);
//! Decoder::new().decode(&bytes, &mut rgb_out, &mut depth_out).unwrap();
//! assert_eq!(depth_out, depth_mm);
//! ```

#![warn(missing_docs)]

mod bits;
mod color;
mod decode;
pub mod depth;
mod encode;
mod error;
mod header;
mod ids;
mod image;
mod plane;

pub use color::{encode_jpeg, join_jpeg, split_jpeg};
pub use decode::{Decoder, Progress};
pub use depth::bound::DepthBound;
pub use encode::{EncodeOptions, Encoder};
pub use error::{DecodeError, EncodeError};
pub use header::{
    ColorMode, DepthMode, HEADER_BYTES, Info, MAX_SIDE, MAX_SLICES, SLICE_HEADER_BYTES, peek,
    slice_len,
};
pub use image::{ImageMut, ImageView, Parts, RgbdView};
