//! What the cameras see: newest motions in, rendered ticks out.
//!
//! ```text
//! in   the newest motions of all vehicles, from the pose thread; which cameras are wanted
//! out  rendered ticks (RGB, depth, object ids), to the encode thread and then to the previews
//! ```

pub mod cameras;
pub mod dynamic_objects;
pub mod environment;
pub mod rendered;
mod renderer;
pub mod thread;

pub use renderer::{RendererKind, choose};
