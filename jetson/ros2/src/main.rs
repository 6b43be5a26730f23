//! `vizflyt-ros2`: only `vizflyt ros2`, for an embedded computer that needs nothing else.

use std::io::IsTerminal;
use std::process::ExitCode;

use clap::Parser;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::prelude::*;
use vizflyt_ros2::{LOG_LEVEL, Ros2Args, run};

#[derive(Parser)]
#[command(version, about)]
struct Program {
    #[command(flatten)]
    ros2: Ros2Args,
}

fn main() -> ExitCode {
    let program = Program::parse();
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal());
    let filter: Targets = LOG_LEVEL.parse().expect("a valid filter");
    tracing_subscriber::registry().with(lines.with_filter(filter)).init();
    match run(&program.ros2) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("vizflyt-ros2: {error:#}");
            ExitCode::FAILURE
        }
    }
}
