//! Colour: baseline JPEG, or entropy-coded planes where it must be exact. `docs/BENCHMARKS.md` has
//! the comparison that chose it.
//!
//! A slice's JPEG is cut at the end of its scan's header: what comes before is the same for all
//! slices but for the number of rows, and goes into the image's header once; the scan goes into
//! the slice. Put together again they are a JPEG that any library decodes.

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
