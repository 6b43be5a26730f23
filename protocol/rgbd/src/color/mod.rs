//! Colour: baseline JPEG, or entropy-coded planes where it must be exact. `docs/BENCHMARKS.md` has
//! the comparison that chose it.
//!
//! A slice's JPEG is cut at the end of its scan's header: what comes before is the same for all
//! slices but for the number of rows, and goes into the image's header once; the scan goes into
//! the slice. Put together again they are a JPEG that any library decodes.

mod decode;
mod file;
mod jpeg;
mod lossless;
#[cfg(not(feature = "turbo"))]
mod pure;
#[cfg(feature = "turbo")]
mod turbo;

pub(crate) use decode::JpegSliceDecoder;
pub use file::{join_jpeg, split_jpeg};
pub(crate) use jpeg::JpegSliceEncoder;
pub use jpeg::encode_jpeg;
pub(crate) use lossless::{LosslessDecoder, LosslessEncoder};
#[cfg(not(feature = "turbo"))]
use pure as library;
#[cfg(feature = "turbo")]
use turbo as library;
