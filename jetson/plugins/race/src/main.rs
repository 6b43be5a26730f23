//! The plugin as a program: `vizflyt fly race` starts it.

fn main() -> std::process::ExitCode {
    vizflyt_sdk::run(vizflyt_race::Race::default())
}
