//! `vizflyt vehicle`: sets up the vehicle; also sessions with its autopilot for other commands.

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

#[derive(Args, Debug)]
pub(crate) struct AutopilotArgs {
    /// Address: udpin:ADDR:PORT, udpout:, tcpin:, tcpout:HOST:PORT or serial:PATH:BAUD
    ///
    /// [default: [vehicle] of jetson.toml, or udpin:0.0.0.0:14550]
    #[arg(long, help_heading = "Vehicle", value_name = "ADDRESS")]
    mavlink: Option<MavlinkAddress>,
    /// Settings file of this computer
    ///
    /// [default: ./jetson.toml, ~/.config/vizflyt/jetson.toml or /etc/vizflyt/jetson.toml]
    #[arg(long, help_heading = "Vehicle", value_name = "FILE")]
    config: Option<PathBuf>,
}

impl AutopilotArgs {
    /// Opens a session with the autopilot.
    pub(crate) fn open_session(&self) -> Result<ParamSession> {
        self.open_session_with(|_| {})
    }

    /// Like [`Self::open_session`], for a private cable: accepts unsigned packets.
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

    /// Returns an autopilot at this address, with all other settings of this computer.
    pub(crate) fn at(mavlink: MavlinkAddress, config: Option<PathBuf>) -> Self {
        Self { mavlink: Some(mavlink), config }
    }

    /// Returns the address and link settings.
    ///
    /// # Errors
    /// If the settings cannot be read.
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

/// Set up the vehicle: key for MAVLink signing
#[derive(Args, Debug)]
pub(crate) struct VehicleArgs {
    #[command(subcommand)]
    command: VehicleCommand,
}

#[derive(Subcommand, Debug)]
enum VehicleCommand {
    /// Make a key for MAVLink 2 signing, and send it to the autopilot
    ///
    /// From then on, autopilot and runtime reject packets that the other has not signed.
    ///
    /// Send the key over USB or another private cable: it is transmitted unencrypted. The autopilot
    /// does not confirm it. If `signing_key` is set in jetson.toml, the next connection shows
    /// whether it was accepted.
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
    /// Key file; created if it does not exist, otherwise sent again
    #[arg(long, help_heading = "Signing", value_name = "FILE", required_unless_present = "off")]
    key: Option<PathBuf>,
    /// Turn signing off: the autopilot accepts unsigned packets again
    #[arg(long, help_heading = "Signing", conflicts_with = "key")]
    off: bool,
}

/// Runs `vizflyt vehicle`.
pub(crate) fn run(args: &VehicleArgs) -> Result<ExitCode> {
    let VehicleCommand::Sign(args) = &args.command;
    let Some(path) = &args.key else {
        args.autopilot.open_wired_session()?.sign(None)?;
        print_line("signing is off; remove `signing_key` from jetson.toml");
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
    print_line(format!("sent     to system {}", session.link().system().unwrap_or(0)));
    print_line(format!(
        "now set signing_key = \"{}\" under [vehicle] in jetson.toml",
        path.display()
    ));
    Ok(ExitCode::SUCCESS)
}
