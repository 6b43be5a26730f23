//! Packets: fixed little-endian layouts that are read in place, and framing of messages on a stream.

pub mod feed;
pub mod framing;
mod image;
mod observation;
mod preamble;

pub use image::{ImageHeader, ImageTrailer, InvalidImageHeader, InvalidImageTrailer};
pub use observation::{
    CameraHeader, ImuRecord, InvalidObservation, MAX_IMU, ObservationHeader, ObservationLayout,
    PLANE_ALIGN,
};
pub use preamble::{PeerRole, Preamble, PreambleError};
