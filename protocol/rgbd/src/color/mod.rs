//! Colour: baseline JPEG, or entropy-coded planes where it must be exact. `docs/BENCHMARKS.md` has
//! the comparison that chose it.
//!
//! A slice's JPEG is cut at the end of its scan's header: what comes before is the same for all
//! slices but for the number of rows, and goes into the image's header once; the scan goes into
//! the slice. A decoder puts them together again, so any JPEG library serves at either end.

mod encode;
mod file;
mod jpeg;
mod lossless;
#[cfg(not(feature = "turbo"))]
mod pure;
#[cfg(feature = "turbo")]
mod turbo;

pub(crate) use encode::JpegSliceEncoder;
pub use encode::encode_jpeg;
pub use file::{join_jpeg, split_jpeg};
pub(crate) use jpeg::JpegSliceDecoder;
pub(crate) use lossless::{LosslessDecoder, LosslessEncoder};
#[cfg(not(feature = "turbo"))]
use pure as library;
#[cfg(feature = "turbo")]
use turbo as library;
