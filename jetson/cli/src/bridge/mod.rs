//! `vizflyt bridge`: the Wi-Fi bridge of a vehicle, emulated on this computer or over the network.

mod ask;
mod configure;
mod emulate;
mod firmware;
mod flash;
mod page;
mod port;

pub(crate) use self::emulate::{EmulateArgs, Emulation};

use anyhow::Result;
use clap::{Args, Subcommand};

/// Emulate, inspect and configure the Wi-Fi bridge of a vehicle
#[derive(Args, Debug)]
pub(crate) struct BridgeArgs {
    #[command(subcommand)]
    command: BridgeCommand,
}

#[derive(Subcommand, Debug)]
#[allow(clippy::large_enum_variant)] // Why: only one value exists, for a short time.
enum BridgeCommand {
    /// Emulate the bridge on this computer, between a serial port and sockets
    Emulate(EmulateArgs),
    /// Show the counters of a bridge: packets passed, packets lost, and why
    Stats(configure::StatsArgs),
    /// Show and change the settings of a bridge
    Configure(configure::ConfigureArgs),
    /// Sign firmware for a bridge, and upload it over the network
    Firmware(firmware::FirmwareArgs),
}

/// Runs `vizflyt bridge`.
pub(crate) fn run(args: BridgeArgs) -> Result<()> {
    match args.command {
        BridgeCommand::Emulate(args) => emulate::run(&args),
        BridgeCommand::Stats(args) => configure::stats(&args),
        BridgeCommand::Configure(args) => configure::configure(&args),
        BridgeCommand::Firmware(args) => firmware::run(&args),
    }
}
