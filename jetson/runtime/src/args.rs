//! The command line of `vizflyt fly`.

use std::ffi::OsString;
use std::net::{SocketAddr, ToSocketAddrs};
use std::path::PathBuf;

use clap::Args;

use crate::link::udp::MavlinkAddress;
use crate::stream::Fingerprint;

/// Flies a plugin: images from the render server to it, its setpoints through the guard to the
/// autopilot.
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Example:\n  vizflyt fly ./target/release/my-plugin --server 192.168.10.2:4433 \\\n    \
                        --fingerprint 3f…9c --mavlink udpin:0.0.0.0:14550 --vehicle vizflyt\n\n\
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
    /// The render server's address
    #[arg(long, value_name = "HOST:PORT", value_parser = resolve)]
    pub server: SocketAddr,
    /// SHA-256 of the server's certificate; the server prints it at start
    #[arg(long, value_name = "HEX")]
    pub fingerprint: Fingerprint,
    /// The autopilot: `udpin:ADDR:PORT` waits for it, `udpout:HOST:PORT` calls it
    #[arg(long, value_name = "ADDRESS", default_value = "udpin:0.0.0.0:14550")]
    pub mavlink: MavlinkAddress,
    /// The vehicle's name in the localization system
    #[arg(long, default_value = "vizflyt")]
    pub vehicle: String,
    /// Folder for flight logs (MCAP)
    #[arg(long, value_name = "DIR", default_value = "flights")]
    pub log: PathBuf,
    /// Writes the report (JSON) there
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
    /// Lands this long after take-off; 0 leaves it to the arena
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0)]
    pub seconds: f64,
    /// Gives up if not in the air after this long; 0 waits for ever
    #[arg(long, value_name = "SECONDS", default_value_t = 120.0)]
    pub ready_within: f64,
    /// Prints one JSON object per line for programs, instead of lines for people
    #[arg(long)]
    pub json: bool,
    /// Ends when standard input does, so that it never outlives a killed parent
    #[arg(long, hide = true)]
    pub lifeline: bool,
}

impl FlyArgs {
    /// Returns the command that starts the plugin, before the runtime's own argument.
    pub fn plugin_command(&self) -> Vec<OsString> {
        let mut command = vec![self.plugin.clone()];
        command.extend(self.plugin_arguments.iter().cloned());
        command
    }
}

fn resolve(text: &str) -> Result<SocketAddr, String> {
    let mut found = text.to_socket_addrs().map_err(|error| format!("{text}: {error}"))?;
    found.next().ok_or_else(|| format!("{text} has no address"))
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
        assert_eq!(args.fingerprint, Fingerprint::of(b"x"));
        let wrong = Program::try_parse_from(line.iter().chain(&["--mavlink", "tcp:1"]));
        assert!(wrong.err().unwrap().to_string().contains("write udpin:"));
    }
}
