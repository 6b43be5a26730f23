//! `vizflyt-jetson`: `vizflyt fly` alone, for an embedded computer that needs nothing else.

use std::io::IsTerminal;
use std::process::ExitCode;

use clap::Parser;
use tracing_subscriber::EnvFilter;
use vizflyt_runtime::{FlyArgs, fly};

#[derive(Parser)]
#[command(version, about)]
struct Program {
    #[command(flatten)]
    fly: FlyArgs,
}

fn main() -> ExitCode {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .init();
    match fly(Program::parse().fly) {
        Ok(outcome) if outcome.is_good() => ExitCode::SUCCESS,
        Ok(_) => ExitCode::from(3),
        Err(error) => {
            eprintln!("vizflyt-jetson: {error:#}");
            ExitCode::FAILURE
        }
    }
}
