//! The `vizflyt` program. All code is in the library, which compiles in parallel with its
//! dependencies.

use std::process::ExitCode;

fn main() -> ExitCode {
    vizflyt::main()
}
