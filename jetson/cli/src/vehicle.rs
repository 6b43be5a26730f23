//! `vizflyt vehicle`: what is set up on the vehicle once. And how commands find an autopilot.

use std::fs::File;
use std::io::Read;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::{Args, Subcommand};
use vizflyt_protocol::mavlink::SigningKey;
use vizflyt_runtime::airframe::Visit;
use vizflyt_runtime::args::link_settings;
use vizflyt_runtime::config::{self, JetsonConfig};
use vizflyt_runtime::link::port::MavlinkAddress;
use vizflyt_runtime::link::{LinkSettings, SigningFile};

use crate::terminal::tell;

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
    /// Finds the autopilot, and greets it.
    pub(crate) fn visit(&self) -> Result<Visit> {
        self.visit_with(|_| {})
    }

    /// As [`Self::visit`], over a wire that nobody else has.
    fn visit_by_wire(&self) -> Result<Visit> {
        self.visit_with(|settings| {
            if let Some(signing) = &mut settings.signing {
                signing.trusts_wire = true;
            }
        })
    }

    fn visit_with(&self, change: impl Fn(&mut LinkSettings)) -> Result<Visit> {
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
        let mut settings = link_settings(&vehicle, name)?;
        change(&mut settings);
        Ok(Visit::open(&address, settings)?)
    }
}

/// What is set up on the vehicle once.
#[derive(Args, Debug)]
pub(crate) struct VehicleArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand, Debug)]
enum What {
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
    let What::Sign(args) = &args.what;
    let Some(path) = &args.key else {
        args.autopilot.visit_by_wire()?.sign(None)?;
        tell("signing is off; take `signing_key` out of jetson.toml");
        return Ok(ExitCode::SUCCESS);
    };
    let file = SigningFile::new(path);
    if !path.exists() {
        let mut bytes = [0; 32];
        File::open("/dev/urandom")
            .and_then(|mut random| random.read_exact(&mut bytes))
            .context("no random numbers for a key")?;
        file.create(&SigningKey::new(bytes))?;
        tell(format!("key      {} (new; only you can read it)", path.display()));
    }
    let signing = file.open()?;
    let mut visit = args.autopilot.visit_by_wire()?;
    visit.sign(Some(&signing))?;
    tell(format!("given    to system {}", visit.link().system().unwrap_or(0)));
    tell(format!("now set signing_key = \"{}\" under [vehicle] in jetson.toml", path.display()));
    Ok(ExitCode::SUCCESS)
}
