//! `vizflyt bench`: measures rendering, streaming and decoding on this machine, the bandwidth of
//! images, and the latency of the bridge.

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

/// Measure this machine: rendering, streaming, decoding, bridge
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
