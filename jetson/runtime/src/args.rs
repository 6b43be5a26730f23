//! Command line of `vizflyt fly`.

use std::ffi::OsString;
use std::fmt;
use std::net::{SocketAddr, ToSocketAddrs};
use std::path::PathBuf;
use std::str::FromStr;

use clap::{Args, ValueEnum};

use vizflyt_protocol::messages::Limits;
use vizflyt_trust::{Fingerprint, Identity, KeysFolder, Owner, Servers};

use crate::config::{self, JetsonConfig, LogConfig, VehicleConfig};
use crate::link::{LinkSettings, SigningFile, VISION_HZ};
use crate::log::{LogSettings, LoggedImages};
use vizflyt_guardian::port::MavlinkAddress;

/// Fly a plugin with images from the render server
///
/// The guard checks the plugin's setpoints and sends them to the autopilot.
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Example:\n  vizflyt fly ./target/release/my-plugin --server 192.168.10.2:4433 \\\n    \
                        --mavlink udpin:0.0.0.0:14550 --vehicle vizflyt\n\n\
                        The vehicle lands when the plugin ends, hangs or is killed, when poses stop,\n\
                        and on Ctrl-C. Options that are not given come from jetson.toml."
)]
pub struct FlyArgs {
    /// Plugin, started as a child process [default: `path` of [plugin] in jetson.toml]
    #[arg(value_name = "PLUGIN")]
    pub plugin: Option<OsString>,
    /// Arguments for the plugin, after `--`
    #[arg(last = true, value_name = "ARGUMENT")]
    pub plugin_arguments: Vec<OsString>,
    /// Wait for a plugin that you start yourself, instead of starting one
    ///
    /// For example `python my_plugin.py`, a debugger or a notebook. There is no timeout. At a breakpoint the vehicle
    /// holds.
    #[arg(long, help_heading = "Plugin", conflicts_with_all = ["plugin", "plugin_arguments"])]
    pub attach: bool,
    /// Map file for the plugin (map.json), for courses with a known map
    #[arg(long, help_heading = "Plugin", value_name = "FILE")]
    pub map: Option<PathBuf>,
    /// Time from take-off until the vehicle lands; 0: time limit of the arena
    #[arg(long, help_heading = "Flight", value_name = "SECONDS", default_value_t = 0.0)]
    pub seconds: f64,
    /// Maximum time until the vehicle is in the air; 0: no timeout
    #[arg(long, help_heading = "Flight", value_name = "SECONDS", default_value_t = 120.0)]
    pub ready_within: f64,
    /// Wait on the ground until `start` is pressed on the server's page
    #[arg(long, help_heading = "Flight")]
    pub wait: bool,
    /// Render server and keys
    #[command(flatten)]
    pub server: ServerArgs,
    /// Connection to the autopilot [default: udpin:0.0.0.0:14550]
    ///
    /// `udpin:ADDR:PORT` waits for packets, `udpout:HOST:PORT` sends first; also `tcpin:`, `tcpout:` and
    /// `serial:/dev/ttyTHS1:921600`, with `:rtscts` at the end for flow control.
    #[arg(long, help_heading = "Real lab", value_name = "ADDRESS")]
    pub mavlink: Option<MavlinkAddress>,
    /// Name of the vehicle in the localization system [default: vizflyt]
    #[arg(long, help_heading = "Real lab")]
    pub vehicle: Option<String>,
    /// File for the results of the flight, as JSON
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    pub report: Option<PathBuf>,
    /// Print one JSON object per line for programs, instead of text
    #[arg(long, help_heading = "Output")]
    pub json: bool,
    /// Flight log
    #[command(flatten)]
    pub log: LogArgs,
    /// Stream the log's channels live to Foxglove
    ///
    /// Listens on ADDR:PORT, by default on port 8765 of this computer only. Every viewer that can reach the port sees
    /// the flight.
    #[arg(long, help_heading = "Log", value_name = "ADDR:PORT", num_args = 0..=1, require_equals = true,
          default_missing_value = "127.0.0.1:8765")]
    pub foxglove: Option<SocketAddr>,
    /// Settings file of this computer
    ///
    /// [default: ./jetson.toml, ~/.config/vizflyt/jetson.toml or /etc/vizflyt/jetson.toml]
    #[arg(long, value_name = "FILE", conflicts_with = "no_config")]
    pub config: Option<PathBuf>,
    /// Ignore jetson.toml
    #[arg(long)]
    pub no_config: bool,
    /// End when standard input closes
    #[arg(long, hide = true)]
    pub lifeline: bool,
    /// Limits of this vehicle, from `jetson.toml`
    #[arg(skip = Limits::NONE)]
    pub limits: Limits,
    /// Settings from `jetson.toml`; [`FlyArgs::settle`] reads them.
    #[arg(skip)]
    pub jetson: JetsonConfig,
}

impl FlyArgs {
    /// Reads `jetson.toml` and uses its values for options that are not on the command line. Returns the path of the
    /// file, if one exists.
    ///
    /// # Errors
    /// Fails if the file is invalid, an address has no host, or there is no plugin.
    pub fn settle(&mut self) -> anyhow::Result<Option<PathBuf>> {
        let file = match &self.config {
            Some(file) => Some(file.clone()),
            None if self.no_config => None,
            None => config::find(),
        };
        if let Some(file) = &file {
            self.jetson = JetsonConfig::read(file)?;
        }
        let JetsonConfig { server, vehicle, plugin, .. } = &self.jetson;
        let parse_error = |error| anyhow::anyhow!("jetson.toml: {error}");
        // A server on the command line is a different server, so the keys in the file do not apply.
        if let (None, Some(server)) = (&self.server.at, server) {
            self.server.at = Some(server.address.parse().map_err(parse_error)?);
            self.server.fingerprint = self.server.fingerprint.or(server.fingerprint);
            self.server.keys = self.server.keys.take().or_else(|| server.keys.clone());
        }
        if let (None, Some(address)) = (&self.mavlink, &vehicle.mavlink) {
            self.mavlink = Some(address.parse().map_err(parse_error)?);
        }
        self.vehicle = self.vehicle.take().or_else(|| vehicle.name.clone());
        self.limits = self.limits.stricter(&self.jetson.limits.into());
        let named = plugin.path.clone().map(PathBuf::into_os_string);
        self.plugin = self.plugin.take().or(named);
        if self.plugin.is_none() && !self.attach {
            anyhow::bail!(
                "no plugin given: `vizflyt fly PLUGIN`, or `path` of [plugin] in jetson.toml"
            );
        }
        Ok(file)
    }

    /// Returns the command that starts the plugin, without the runtime's own argument; empty with `--attach`.
    pub fn plugin_command(&self) -> Vec<OsString> {
        if self.attach {
            return Vec::new();
        }
        self.plugin.iter().chain(&self.plugin_arguments).cloned().collect()
    }

    /// Returns the address of the autopilot.
    pub fn mavlink_address(&self) -> MavlinkAddress {
        self.mavlink.clone().unwrap_or_else(MavlinkAddress::usual)
    }

    /// Returns the link settings of `jetson.toml`.
    ///
    /// # Errors
    /// As [`link_settings`].
    pub fn link_settings(&self) -> anyhow::Result<LinkSettings> {
        link_settings(&self.jetson.vehicle, self.vehicle_name())
    }

    /// Returns the vehicle's name in the localization system.
    pub fn vehicle_name(&self) -> &str {
        self.vehicle.as_deref().unwrap_or("vizflyt")
    }
}

/// Flight log options.
#[derive(Args, Clone, Debug, Default)]
pub struct LogArgs {
    /// Images in the flight log: `reduced`, `full`, or `none` for no log
    ///
    /// `reduced` stores as many images as fit into 60 MB a minute, `full` stores all images, for a bit-exact replay.
    /// [default: `images` of [log] in jetson.toml, else reduced]
    #[arg(
        long = "log",
        help_heading = "Log",
        value_name = "reduced|full|none",
        hide_possible_values = true
    )]
    pub option: Option<LogOption>,
    /// Folder for flight logs (MCAP) [default: flights]
    #[arg(long, help_heading = "Log", value_name = "DIR")]
    pub log_dir: Option<PathBuf>,
    /// Also log depth as 16UC1, which all viewers show
    ///
    /// This adds 150 kB per image of 320x240.
    #[arg(long, help_heading = "Log")]
    pub log_depth: bool,
}

/// Value of `--log`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum LogOption {
    /// As many images as fit into 60 MB a minute.
    #[default]
    Reduced,
    /// All images.
    Full,
    /// No log.
    None,
}

impl LogOption {
    /// Returns which images are logged; `None` without a log.
    pub fn images(self) -> Option<LoggedImages> {
        match self {
            Self::Reduced => Some(LoggedImages::Reduced),
            Self::Full => Some(LoggedImages::Full),
            Self::None => None,
        }
    }

    /// Returns the value as typed on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Reduced => "reduced",
            Self::Full => "full",
            Self::None => "none",
        }
    }
}

impl LogArgs {
    /// Returns the options with which another `vizflyt fly` logs in the same way.
    pub fn to_command_line(&self) -> Vec<OsString> {
        let pairs = [
            ("--log", self.option.map(|option| option.name().into())),
            ("--log-dir", self.log_dir.clone().map(Into::into)),
        ];
        let given = pairs.into_iter().filter_map(|(name, value)| Some([name.into(), value?]));
        let depth = self.log_depth.then(|| "--log-depth".into());
        given.flatten().chain(depth).collect()
    }

    /// Returns the log settings; options that are not on the command line come from `config`.
    pub fn settings(&self, config: &LogConfig) -> LogSettings {
        let folder = self.log_dir.clone().unwrap_or_else(|| "flights".into());
        LogSettings {
            folder: (self.option != Some(LogOption::None)).then_some(folder),
            images: self.option.and_then(LogOption::images).or(config.images).unwrap_or_default(),
            depth: self.log_depth,
            retention: config.retention(),
        }
    }
}

/// Returns the link settings for the vehicle `name` from its section `[vehicle]`.
///
/// # Errors
/// Fails if the signing key cannot be used.
pub fn link_settings(vehicle: &VehicleConfig, name: &str) -> anyhow::Result<LinkSettings> {
    // If the host name is unavailable, the name of the vehicle is enough.
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let key = vehicle.signing_key.as_deref();
    Ok(LinkSettings {
        name: format!("{name} on {}", host.trim()),
        system: vehicle.system,
        vision_hz: vehicle.vision_hz.unwrap_or(*VISION_HZ.end()),
        signing: key.map(|path| SigningFile::new(path).open()).transpose()?,
    })
}

/// Render server, its fingerprint, and this computer's keys.
#[derive(Args, Clone, Debug)]
pub struct ServerArgs {
    /// Address of the render server, once paired with `vizflyt pair HOST:PORT`
    #[arg(long = "server", help_heading = "Real lab", value_name = "HOST:PORT")]
    pub at: Option<ServerAddress>,
    /// SHA-256 of the server's certificate [default: from pairing]
    #[arg(long, help_heading = "Real lab", value_name = "HEX")]
    pub fingerprint: Option<Fingerprint>,
    /// Folder of this computer's key and of servers.toml
    ///
    /// [default: $XDG_CONFIG_HOME/vizflyt or ~/.config/vizflyt]
    #[arg(long, help_heading = "Real lab", value_name = "DIR")]
    pub keys: Option<PathBuf>,
}

impl ServerArgs {
    /// Returns the address of the server.
    ///
    /// # Errors
    /// Fails if no server is configured.
    pub fn address(&self) -> anyhow::Result<&ServerAddress> {
        self.at.as_ref().ok_or_else(|| {
            anyhow::anyhow!("no server is known; give --server, or [server] in jetson.toml")
        })
    }

    /// Returns the fingerprint of the server and the identity of this computer.
    ///
    /// # Errors
    /// Fails without a server, if this computer is not paired with it, or if the keys cannot be used.
    pub fn known(&self) -> anyhow::Result<(Fingerprint, Identity)> {
        let at = self.address()?;
        let folder = KeysFolder::open(self.keys.as_deref())?;
        let identity = Identity::load_or_create(&folder, Owner::Runtime)?;
        if let Some(fingerprint) = self.fingerprint {
            return Ok((fingerprint, identity));
        }
        let resolved = at.address.to_string();
        let known = Servers::read(&folder)?.fingerprint(&[&at.typed, &resolved]);
        let fingerprint = known.ok_or_else(|| {
            anyhow::anyhow!(
                "this computer is not paired with the server {at}; run `vizflyt pair {at}` and type \
                 the code from the server's page"
            )
        })?;
        Ok((fingerprint, identity))
    }
}

/// A server's address, as typed and as resolved.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServerAddress {
    /// `HOST:PORT`.
    pub typed: String,
    /// First address that the name resolves to.
    pub address: SocketAddr,
}

impl FromStr for ServerAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut found = text.to_socket_addrs().map_err(|error| format!("{text}: {error}"))?;
        let address = found.next().ok_or_else(|| format!("{text} has no address"))?;
        Ok(Self { typed: text.to_owned(), address })
    }
}

impl fmt::Display for ServerAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.typed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{CommandFactory, Parser};

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        fly: FlyArgs,
    }

    #[test]
    fn parses_the_command_line() {
        Program::command().debug_assert();
        let fingerprint = Fingerprint::of(b"x").to_string();
        let line = ["fly", "python3", "--server", "127.0.0.1:4433", "--fingerprint", &fingerprint];
        let tail = ["--mavlink", "udpin:127.0.0.1:0", "--", "plugin.py", "--gain=2"];
        let args = Program::try_parse_from(line.iter().chain(&tail)).unwrap().fly;
        assert_eq!(args.plugin_command(), ["python3", "plugin.py", "--gain=2"]);
        assert_eq!(args.server.fingerprint, Some(Fingerprint::of(b"x")));
        assert_eq!(args.server.address().unwrap().address, ([127, 0, 0, 1], 4433).into());
        let wrong = Program::try_parse_from(line.iter().chain(&["--mavlink", "tcp:1"]));
        assert!(wrong.err().unwrap().to_string().contains("write udpin:"));
    }

    #[test]
    fn prefers_the_command_line_over_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("jetson.toml");
        let text = "[server]\naddress = \"127.0.0.1:1\"\nkeys = \"/keys\"\n\
                    [vehicle]\nname = \"one\"\nmavlink = \"udpin:127.0.0.1:2\"\n\
                    [plugin]\npath = \"avoid\"\n";
        std::fs::write(&file, text).unwrap();
        let settle = |more: &[&str]| {
            let line = ["fly", "--config", file.to_str().unwrap()];
            let mut args = Program::try_parse_from(line.iter().chain(more)).unwrap().fly;
            args.settle().map(|_| args)
        };
        let args = settle(&[]).unwrap();
        assert_eq!(args.server.address().unwrap().typed, "127.0.0.1:1");
        assert_eq!(args.server.keys, Some("/keys".into()));
        assert_eq!(args.mavlink_address().to_string(), "udpin:127.0.0.1:2");
        assert_eq!((args.vehicle_name(), args.plugin_command()), ("one", vec!["avoid".into()]));
        let args =
            settle(&["mine", "--server=127.0.0.1:3", "--vehicle=two", "--mavlink=udpin:[::1]:4"]);
        let args = args.unwrap();
        assert_eq!(args.server.address().unwrap().typed, "127.0.0.1:3");
        assert_eq!(args.server.keys, None, "another server has other keys");
        assert_eq!(args.mavlink_address().to_string(), "udpin:[::1]:4");
        assert_eq!((args.vehicle_name(), args.plugin_command()), ("two", vec!["mine".into()]));
        std::fs::write(&file, "").unwrap();
        let error = settle(&[]).err().unwrap().to_string();
        assert!(error.contains("no plugin given"), "{error}");
        assert_eq!(settle(&["mine"]).unwrap().mavlink_address().to_string(), "udpin:0.0.0.0:14550");
    }

    #[test]
    fn log_is_reduced_by_default() {
        let settle = |line: &[&str], config: &str| {
            let line = ["fly", "x"].iter().chain(line);
            let log = Program::try_parse_from(line).unwrap().fly.log;
            log.settings(&JetsonConfig::parse(config).unwrap().log)
        };
        let check = |line: &[&str], config: &str, folder: &str, images| {
            let found = settle(line, config);
            assert_eq!((found.folder, found.images), (Some(folder.into()), images), "{line:?}");
        };
        let full = "[log]\nimages = \"full\"\n";
        check(&[], "", "flights", LoggedImages::Reduced);
        check(&[], full, "flights", LoggedImages::Full);
        check(&["--log=full"], "", "flights", LoggedImages::Full);
        check(&["--log", "reduced", "--log-dir=d"], full, "d", LoggedImages::Reduced);
        assert_eq!(settle(&["--log=none", "--log-dir=d"], full).folder, None);
        // Rejects typing errors and folders.
        for wrong in ["--log=nnoe", "--log=some/folder"] {
            let error = Program::try_parse_from(["fly", "x", wrong]).err().unwrap().to_string();
            assert!(error.contains("[possible values: reduced, full, none]"), "{error}");
        }
        // A child process with the same options logs in the same way.
        let line = ["fly", "x", "--log=full", "--log-dir=d"];
        let args = Program::try_parse_from(line).unwrap().fly.log;
        assert_eq!(args.to_command_line(), ["--log", "full", "--log-dir", "d"]);
        let args = Program::try_parse_from(["fly", "x", "--log-depth"]).unwrap().fly.log;
        assert_eq!(args.to_command_line(), ["--log-depth"]);
        assert!(LogArgs::default().to_command_line().is_empty());
    }

    #[test]
    fn finds_the_fingerprint_by_pairing_or_option() {
        let root = tempfile::tempdir().unwrap();
        let keys = root.path().join("keys");
        let args = |fingerprint| ServerArgs {
            at: Some("127.0.0.1:4433".parse().unwrap()),
            fingerprint,
            keys: Some(keys.clone()),
        };
        let error = args(None).known().err().unwrap().to_string();
        assert!(error.contains("run `vizflyt pair 127.0.0.1:4433`"), "{error}");
        let (one, two) = (Fingerprint::of(b"1"), Fingerprint::of(b"2"));
        let folder = KeysFolder::open(Some(&keys)).unwrap();
        let address = "127.0.0.1:4433".to_owned();
        let server = vizflyt_trust::KnownServer { address, fingerprint: one };
        Servers::add(&folder, server).unwrap();
        let (found, identity) = args(None).known().unwrap();
        let (given, same) = args(Some(two)).known().unwrap();
        assert_eq!((found, given), (one, two));
        assert_eq!(identity.fingerprint(), same.fingerprint());
    }
}
