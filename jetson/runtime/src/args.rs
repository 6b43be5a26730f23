//! The command line of `vizflyt fly`.

use std::ffi::OsString;
use std::fmt;
use std::net::{SocketAddr, ToSocketAddrs};
use std::path::PathBuf;
use std::str::FromStr;

use clap::Args;

use vizflyt_protocol::messages::Limits;
use vizflyt_trust::{Fingerprint, Identity, KeysFolder, Owner, Servers};

use crate::link::udp::MavlinkAddress;

/// Flies a plugin: images from the render server to it, its setpoints through the guard to the
/// autopilot.
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Example:\n  vizflyt fly ./target/release/my-plugin --server 192.168.10.2:4433 \\\n    \
                        --mavlink udpin:0.0.0.0:14550 --vehicle vizflyt\n\n\
                        The vehicle lands when the plugin ends, hangs or is killed, when poses stop,\n\
                        and on Ctrl-C."
)]
pub struct FlyArgs {
    /// The plugin: a program; started as a child process
    #[arg(value_name = "PLUGIN")]
    pub plugin: OsString,
    /// Arguments for the plugin, after `--`
    #[arg(last = true, value_name = "ARGUMENT")]
    pub plugin_arguments: Vec<OsString>,
    /// The render server, and how it is known
    #[command(flatten)]
    pub server: ServerArgs,
    /// The autopilot: `udpin:ADDR:PORT` waits for it, `udpout:HOST:PORT` calls it
    #[arg(long, value_name = "ADDRESS", default_value = "udpin:0.0.0.0:14550")]
    pub mavlink: MavlinkAddress,
    /// The vehicle's name in the localization system
    #[arg(long, default_value = "vizflyt")]
    pub vehicle: String,
    /// Folder for flight logs (MCAP)
    #[arg(long, value_name = "DIR", default_value = "flights")]
    pub log: PathBuf,
    /// Shows the log's channels live to Foxglove, on this computer's port 8765 or at ADDR:PORT;
    /// whoever reaches it sees the flight
    #[arg(long, value_name = "ADDR:PORT", num_args = 0..=1, require_equals = true,
          default_missing_value = "127.0.0.1:8765")]
    pub foxglove: Option<SocketAddr>,
    /// Writes the report (JSON) there
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
    /// Lands this long after take-off; 0 leaves it to the arena
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0)]
    pub seconds: f64,
    /// Gives up if not in the air after this long; 0 waits for ever
    #[arg(long, value_name = "SECONDS", default_value_t = 120.0)]
    pub ready_within: f64,
    /// This vehicle's own limits, from `jetson.toml`
    #[arg(skip = Limits::NONE)]
    pub limits: Limits,
    /// Prints one JSON object per line for programs, instead of lines for people
    #[arg(long)]
    pub json: bool,
    /// Ends when standard input does, so that it never outlives a killed parent
    #[arg(long, hide = true)]
    pub lifeline: bool,
    /// The settings of this computer, jetson.toml
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
}

impl FlyArgs {
    /// Returns the command that starts the plugin, before the runtime's own argument.
    pub fn plugin_command(&self) -> Vec<OsString> {
        let mut command = vec![self.plugin.clone()];
        command.extend(self.plugin_arguments.iter().cloned());
        command
    }
}

/// Which server, how this computer knows it, and who this computer is.
#[derive(Args, Clone, Debug)]
pub struct ServerArgs {
    /// The render server's address; `vizflyt pair HOST:PORT` makes it known once
    #[arg(long = "server", value_name = "HOST:PORT")]
    pub at: ServerAddress,
    /// SHA-256 of the server's certificate [default: the one this computer is paired with]
    #[arg(long, value_name = "HEX")]
    pub fingerprint: Option<Fingerprint>,
    /// Folder of this computer's key and of servers.toml
    /// [default: $XDG_CONFIG_HOME/vizflyt or ~/.config/vizflyt]
    #[arg(long, value_name = "DIR")]
    pub keys: Option<PathBuf>,
}

impl ServerArgs {
    /// Returns who the server is and who we are.
    ///
    /// # Errors
    /// A server that this computer is not paired with; keys that cannot be used.
    pub fn known(&self) -> anyhow::Result<(Fingerprint, Identity)> {
        let folder = KeysFolder::open(self.keys.as_deref())?;
        let identity = Identity::keep(&folder, Owner::Runtime)?;
        if let Some(fingerprint) = self.fingerprint {
            return Ok((fingerprint, identity));
        }
        let resolved = self.at.address.to_string();
        let known = Servers::read(&folder)?.fingerprint(&[&self.at.typed, &resolved]);
        let fingerprint = known.ok_or_else(|| {
            anyhow::anyhow!(
                "this computer is not paired with the server {0}; run `vizflyt pair {0}` and type \
                 the code from the server's page",
                self.at
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
    /// The first address it has.
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
    fn the_command_line_is_consistent_and_reads() {
        Program::command().debug_assert();
        let fingerprint = Fingerprint::of(b"x").to_string();
        let line = ["fly", "python3", "--server", "127.0.0.1:4433", "--fingerprint", &fingerprint];
        let tail = ["--mavlink", "udpin:127.0.0.1:0", "--", "plugin.py", "--gain=2"];
        let args = Program::try_parse_from(line.iter().chain(&tail)).unwrap().fly;
        assert_eq!(args.plugin_command(), ["python3", "plugin.py", "--gain=2"]);
        assert_eq!(args.server.fingerprint, Some(Fingerprint::of(b"x")));
        assert_eq!(args.server.at.address, ([127, 0, 0, 1], 4433).into());
        let wrong = Program::try_parse_from(line.iter().chain(&["--mavlink", "tcp:1"]));
        assert!(wrong.err().unwrap().to_string().contains("write udpin:"));
    }

    #[test]
    fn a_server_is_known_by_pairing_or_by_hand() {
        let root = tempfile::tempdir().unwrap();
        let keys = root.path().join("keys");
        let args = |fingerprint| ServerArgs {
            at: "127.0.0.1:4433".parse().unwrap(),
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
