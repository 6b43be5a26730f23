//! The unit tests of the instruction sets once more, beside the images: `tests/arm/run` has both built for ARM64 then,
//! without all the unit tests of the crate.

use vizflyt_splat::simd::{InstructionSet, Kernel, Simd};

#[path = "../../src/cpu/simd/tests.rs"]
mod sets;
