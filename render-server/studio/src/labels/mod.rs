//! (rendered image, camera) -> labels of its pixels, and the bytes of their files. Functions of their arguments.
//!
//! ```text
//! RgbdImage -> layers   depth of surfaces, classes, ids of things
//! depth     -> normals, flow   in lanes, by the renderer's instruction sets
//! ids       -> rle      masks, as COCO writes them
//! layer     -> picture  PNG or JPEG, in memory
//! ```
//! Budget of all of it on one core, 320x240: 4 ms.

pub mod flow;
pub mod layers;
pub mod normals;
pub mod picture;
pub mod rle;
