//! Colour: baseline JPEG, or entropy-coded planes for lossless colour. `docs/BENCHMARKS.md` contains the comparison
//! behind this choice.
//!
//! A slice's JPEG is split after its scan header. The bytes before are the same for all slices except for the number of
//! rows, and are stored once in the image's header. The scan is stored in the slice. Joined, they are a JPEG that any
//! library decodes.

mod decode;
mod encode;
mod file;
mod jpeg;
mod lossless;

pub(crate) use decode::JpegSliceDecoder;
pub(crate) use encode::JpegSliceEncoder;
pub use encode::encode_jpeg;
pub use file::{join_jpeg, split_jpeg};
pub(crate) use lossless::{LosslessDecoder, LosslessEncoder};
