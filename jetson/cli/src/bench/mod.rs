//! `vizflyt bench`: how fast this machine renders, streams and decodes, and what its images need; what the
//! bridge adds to a packet's way.

mod bandwidth;
mod bridge;
mod decode;
mod imaging;
mod render;
mod sensors;
mod sheet;
mod stream;

use std::process::ExitCode;

use anyhow::Result;
use clap::{Args, Subcommand};

/// Measures this machine.
#[derive(Args, Debug)]
pub(crate) struct BenchArgs {
    #[command(subcommand)]
    command: BenchCommand,
}

#[derive(Subcommand, Debug)]
enum BenchCommand {
    Bandwidth(bandwidth::BandwidthArgs),
    Bridge(bridge::BridgeBenchArgs),
    Decode(decode::DecodeArgs),
    Imaging(imaging::ImagingArgs),
    Render(render::RenderArgs),
    Sensors(sensors::SensorsArgs),
    Stream(stream::StreamArgs),
}

/// Runs `vizflyt bench`.
pub(crate) fn run(args: BenchArgs) -> Result<ExitCode> {
    match args.command {
        BenchCommand::Bandwidth(args) => bandwidth::run(&args)?,
        BenchCommand::Bridge(args) => bridge::run(&args)?,
        BenchCommand::Decode(args) => decode::run(&args)?,
        BenchCommand::Imaging(args) => imaging::run(&args)?,
        BenchCommand::Render(args) => render::run(&args)?,
        BenchCommand::Sensors(args) => sensors::run(&args)?,
        BenchCommand::Stream(args) => stream::run(&args)?,
    }
    Ok(ExitCode::SUCCESS)
}
