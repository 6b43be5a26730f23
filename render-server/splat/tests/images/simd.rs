//! Unit tests of the instruction sets, repeated next to the image tests: `tests/arm/run` can then build both for
//! ARM64 without all unit tests of the crate.

use vizflyt_splat::simd::{InstructionSet, Kernel, Simd};

#[path = "../../src/cpu/simd/tests.rs"]
mod sets;
