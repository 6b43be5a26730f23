//! One self-describing bitstream for an RGB-D image: colour as JPEG, depth as lossless u16
//! millimetres. The server encodes, the runtime decodes straight into shared memory.
//!
//! ```text
//! RgbdView -> Encoder -> Header | JPEG | depth -> Decoder -> caller's rgb and depth slices
//! ```
//!
//! Read in this order:
//! - [`Info`] and [`peek`]: the header, 24 bytes;
//! - [`encode_jpeg`] for colour;
//! - [`depth`]: banded prediction, zig-zag residuals, bit-packed blocks; a scalar reference and a
//!   fast path that give the same bytes;
//! - [`Encoder`], [`Decoder`]: the two ends. Keep one of each per stream: they own the scratch
//!   memory, so that nothing of ours is allocated per image after the first.
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

mod codec;
mod color;
pub mod depth;
mod header;

pub use codec::{DecodeError, Decoder, EncodeError, EncodeOptions, Encoder, RgbdView};
pub use color::encode_jpeg;
pub use header::{DepthMode, Info, MAX_SIDE, peek};
