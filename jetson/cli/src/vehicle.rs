//! `vizflyt vehicle`: sets up the vehicle once; and sessions with its autopilot for other commands.

use std::fs::File;
use std::io::Read;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::{Args, Subcommand};
use vizflyt_guardian::port::MavlinkAddress;
use vizflyt_process::print_line;
use vizflyt_protocol::mavlink::SigningKey;
use vizflyt_runtime::airframe::ParamSession;
use vizflyt_runtime::args::link_settings;
use vizflyt_runtime::config::{self, JetsonConfig};
use vizflyt_runtime::link::{LinkSettings, SigningFile};

/// Which autopilot.
#[derive(Args, Debug)]
pub(crate) struct AutopilotArgs {
    /// The autopilot: udpin:ADDR:PORT, udpout:, tcpin:, tcpout:HOST:PORT or serial:PATH:BAUD
    /// [default: [vehicle] of jetson.toml, or udpin:0.0.0.0:14550]
    #[arg(long, value_name = "ADDRESS")]
    mavlink: Option<MavlinkAddress>,
    /// The settings of this computer
    /// [default: ./jetson.toml, ~/.config/vizflyt/jetson.toml or /etc/vizflyt/jetson.toml]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

impl AutopilotArgs {
    /// Opens a session with the autopilot.
    pub(crate) fn open_session(&self) -> Result<ParamSession> {
        self.open_session_with(|_| {})
    }

    /// As [`Self::open_session`], over a wire that nobody else uses: unsigned packets are accepted.
    fn open_wired_session(&self) -> Result<ParamSession> {
        self.open_session_with(|settings| {
            if let Some(signing) = &mut settings.signing {
                signing.accepts_unsigned = true;
            }
        })
    }

    fn open_session_with(&self, change: impl Fn(&mut LinkSettings)) -> Result<ParamSession> {
        let (address, mut settings) = self.link()?;
        change(&mut settings);
        Ok(ParamSession::open(&address, settings)?)
    }

    /// Returns the autopilot at an address, with what this computer's settings say of it otherwise.
    pub(crate) fn at(mavlink: MavlinkAddress, config: Option<PathBuf>) -> Self {
        Self { mavlink: Some(mavlink), config }
    }

    /// Returns where it is, and how to talk to it.
    ///
    /// # Errors
    /// Settings that cannot be read.
    pub(crate) fn link(&self) -> Result<(MavlinkAddress, LinkSettings)> {
        let file = self.config.clone().or_else(config::find);
        let vehicle = match file {
            Some(file) => JetsonConfig::read(&file)?.vehicle,
            None => config::VehicleConfig::default(),
        };
        let address = match (&self.mavlink, &vehicle.mavlink) {
            (Some(address), _) => address.clone(),
            (None, Some(text)) => text.parse().map_err(anyhow::Error::msg)?,
            (None, None) => MavlinkAddress::usual(),
        };
        let name = vehicle.name.as_deref().unwrap_or("vizflyt");
        Ok((address, link_settings(&vehicle, name)?))
    }
}

/// What is set up on the vehicle once.
#[derive(Args, Debug)]
pub(crate) struct VehicleArgs {
    #[command(subcommand)]
    command: VehicleCommand,
}

#[derive(Subcommand, Debug)]
enum VehicleCommand {
    /// Makes a key for MAVLink 2 signing, and gives it to the autopilot; from then on each refuses what
    /// the other did not sign.
    ///
    /// Give it over USB or another wire that nobody listens to: the key travels in the clear. The
    /// autopilot does not confirm it; with `signing_key` in jetson.toml, the next start shows.
    #[command(after_help = "Examples:
  vizflyt vehicle sign --mavlink serial:/dev/ttyACM0 --key /etc/vizflyt/mavlink.key
  vizflyt vehicle sign --mavlink serial:/dev/ttyACM0 --off
Then, in jetson.toml:
  [vehicle]
  signing_key = \"/etc/vizflyt/mavlink.key\"")]
    Sign(SignArgs),
}

#[derive(Args, Debug)]
struct SignArgs {
    #[command(flatten)]
    autopilot: AutopilotArgs,
    /// The key's file: made if it is not there, sent again if it is
    #[arg(long, value_name = "FILE", required_unless_present = "off")]
    key: Option<PathBuf>,
    /// Takes signing back: the autopilot accepts everyone again
    #[arg(long, conflicts_with = "key")]
    off: bool,
}

/// Sets up.
pub(crate) fn run(args: &VehicleArgs) -> Result<ExitCode> {
    let VehicleCommand::Sign(args) = &args.command;
    let Some(path) = &args.key else {
        args.autopilot.open_wired_session()?.sign(None)?;
        print_line("signing is off; take `signing_key` out of jetson.toml");
        return Ok(ExitCode::SUCCESS);
    };
    let file = SigningFile::new(path);
    if !path.exists() {
        let mut bytes = [0; 32];
        File::open("/dev/urandom")
            .and_then(|mut random| random.read_exact(&mut bytes))
            .context("no random numbers for a key")?;
        file.create(&SigningKey::new(bytes))?;
        print_line(format!("key      {} (new; only you can read it)", path.display()));
    }
    let signing = file.open()?;
    let mut session = args.autopilot.open_wired_session()?;
    session.sign(Some(&signing))?;
    print_line(format!("given    to system {}", session.link().system().unwrap_or(0)));
    print_line(format!(
        "now set signing_key = \"{}\" under [vehicle] in jetson.toml",
        path.display()
    ));
    Ok(ExitCode::SUCCESS)
}
