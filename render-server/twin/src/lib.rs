//! Trains a twin (3D Gaussian splats) from images with known poses, on the processor or on a graphics card.

pub mod adam;
pub mod adjust;
pub mod align;
mod bin;
mod blend;
pub mod carve;
pub mod dataset;
pub mod gaussians;
mod gpu;
pub mod loss;
mod neighbours;
pub mod passes;
pub mod planes;
mod project;
pub mod random;
pub mod reference;
mod relocate;
mod render;
mod smooth;
mod ssim;
mod times;
pub mod train;
pub mod verdict;
mod view;

pub use dataset::Dataset;
pub use gaussians::Gaussians;
pub use passes::Passes;
pub use planes::Planes;
pub use project::Style;
pub use render::{Renderer, channel};
pub use times::Times;
pub use train::{Options, Trainer};
pub use view::View;
