//! `vizflyt`. All of it is in the library, which compiles while those that it links still do.

use std::process::ExitCode;

fn main() -> ExitCode {
    vizflyt::main()
}
