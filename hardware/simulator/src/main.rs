//! The simulated lab as a separate program, identical to `vizflyt sim`.

use std::io::IsTerminal;

use clap::Parser;
use vizflyt_simulator::{SimArgs, run};

#[derive(Parser)]
#[command(name = "vizflyt-simulator", version, about)]
struct Command {
    #[command(flatten)]
    args: SimArgs,
}

fn main() -> anyhow::Result<()> {
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .init();
    run(Command::parse().args)
}
