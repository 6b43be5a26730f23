//! What renderers produce: against an independent oracle, against each other, and of poisoned input.

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
