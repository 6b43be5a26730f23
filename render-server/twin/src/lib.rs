//! Images with known poses -> a twin: 3D Gaussian splats, trained on any processor.

mod bin;
mod blend;
pub mod gaussians;
pub mod planes;
mod project;
pub mod random;
pub mod reference;
mod render;
mod view;

pub use gaussians::Gaussians;
pub use planes::Planes;
pub use project::Style;
pub use render::{Renderer, channel};
pub use view::View;
