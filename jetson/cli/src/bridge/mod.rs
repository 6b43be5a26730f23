//! `vizflyt bridge`: the Wi-Fi bridge of a vehicle, on this computer or over the network.

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

/// The Wi-Fi bridge of a vehicle.
#[derive(Args, Debug)]
pub(crate) struct BridgeArgs {
    #[command(subcommand)]
    command: BridgeCommand,
}

#[derive(Subcommand, Debug)]
#[allow(clippy::large_enum_variant)] // Why: there is one of it, for a moment.
enum BridgeCommand {
    /// Runs the bridge's firmware on this computer, between a pseudo-terminal or serial port and its sockets.
    Emulate(EmulateArgs),
    /// Counters of a bridge: what passed, what was lost, and why.
    Stats(configure::StatsArgs),
    /// Shows and changes a bridge's settings.
    Configure(configure::ConfigureArgs),
    /// Signs a bridge's firmware, and brings it over the network.
    Firmware(firmware::FirmwareArgs),
}

/// Runs what was asked for.
pub(crate) fn run(args: BridgeArgs) -> Result<()> {
    match args.command {
        BridgeCommand::Emulate(args) => emulate::run(&args),
        BridgeCommand::Stats(args) => configure::stats(&args),
        BridgeCommand::Configure(args) => configure::configure(&args),
        BridgeCommand::Firmware(args) => firmware::run(&args),
    }
}
