//! The plugin as a program: `vizflyt fly avoid` starts it.

fn main() -> std::process::ExitCode {
    vizflyt_sdk::run(vizflyt_avoid::Avoid::default())
}
