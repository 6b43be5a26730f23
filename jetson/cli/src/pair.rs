//! `vizflyt pair`: exchanges identities between this computer and a server, once, by a short code.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use clap::Args;
use vizflyt_process::print_line;
use vizflyt_protocol::messages::Grant;
use vizflyt_runtime::args::ServerAddress;
use vizflyt_trust::KeysFolder;
use vizflyt_trust::pairing::Code;

/// Pair this computer with a render server by a short code
///
/// On the server's page, `pair a computer` shows a code of six digits. `vizflyt serve --pair`
/// prints one in the terminal.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt pair 192.168.10.2:4433                      prompts for the code
  vizflyt pair lab:4433 --code 123456 --name jetson-3")]
pub(crate) struct PairArgs {
    /// Address of the server
    #[arg(value_name = "HOST:PORT")]
    server: ServerAddress,
    /// Code that the server shows; without this option the command prompts for it
    #[arg(long, value_name = "DIGITS")]
    code: Option<Code>,
    /// Name of this computer on the server [default: its host name]
    #[arg(long)]
    name: Option<String>,
    /// Folder of this computer's key and of servers.toml
    ///
    /// [default: $XDG_CONFIG_HOME/vizflyt or ~/.config/vizflyt]
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
}

pub(crate) fn run(args: &PairArgs) -> Result<ExitCode> {
    let folder = KeysFolder::open(args.keys.as_deref())?;
    let code = match args.code {
        Some(code) => code,
        None => ask()?,
    };
    let name = args.name.clone().unwrap_or_else(host_name);
    let paired = vizflyt_runtime::pair(&folder, &args.server, code, &name)?;
    let right = match &paired.grant {
        Grant::Instructor => "every vehicle".to_owned(),
        Grant::Team { vehicles } => {
            let names: Vec<_> = vehicles.iter().map(|name| format!("'{name}'")).collect();
            names.join(", ")
        }
    };
    print_line(format!(
        "paired with {}: this computer, '{name}', may fly and watch {right}",
        args.server
    ));
    print_line(format!("identity of the server: {}", paired.server));
    Ok(ExitCode::SUCCESS)
}

fn ask() -> Result<Code> {
    if std::io::stdin().is_terminal() {
        let mut out = std::io::stdout();
        write!(out, "code: ")
            .and_then(|()| out.flush())
            .context("cannot prompt for the code; pass --code")?;
    }
    let mut line = String::new();
    std::io::stdin().read_line(&mut line).context("cannot read the code; pass --code")?;
    match line.trim().parse() {
        Ok(code) => Ok(code),
        Err(error) => bail!("{error}"),
    }
}

fn host_name() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let name: String = name.trim().chars().take(32).collect();
    if name.is_empty() { "computer".to_owned() } else { name }
}
