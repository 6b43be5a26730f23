//! The simulated lab as a separate program, identical to `vizflyt sim`.

use std::io::IsTerminal;

use clap::Parser;
use vizflyt_process::{LogWriter, finish_output, never_wait_for_readers};
use vizflyt_simulator::{SimArgs, run};

#[derive(Parser)]
#[command(name = "vizflyt-simulator", version, about)]
struct Command {
    #[command(flatten)]
    args: SimArgs,
}

fn main() -> anyhow::Result<()> {
    tracing_subscriber::fmt()
        .with_writer(|| LogWriter)
        .with_ansi(std::io::stderr().is_terminal())
        .init();
    let args = Command::parse().args;
    never_wait_for_readers();
    let result = run(args);
    finish_output();
    result
}
