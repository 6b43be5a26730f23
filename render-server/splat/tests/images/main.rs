//! Images of the renderers, compared with an independent oracle, with each other, and for invalid input.

mod agreement;
mod compare;
mod corners;
mod cuts;
mod fisheye;
mod npz;
mod objects;
mod oracle;
mod poison;
mod renderers;
mod simd;
