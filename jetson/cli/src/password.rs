//! `vizflyt password`: sets the instructor's password of the server's page.

use std::io::{BufRead, IsTerminal, Read, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use clap::Args;
use nix::sys::termios::{LocalFlags, SetArg, Termios, tcgetattr, tcsetattr};
use vizflyt_process::{print_error, print_line};
use vizflyt_trust::KeysFolder;

/// Set the instructor's password for the server's page
///
/// Run this command on the server's computer. A running server uses the new password immediately
/// and ends all sessions of the old one.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt password                        prompts for the password twice
  pass show lab | vizflyt password        reads the first line of standard input")]
pub(crate) struct PasswordArgs {
    /// Folder of the server's keys
    ///
    /// [default: $XDG_CONFIG_HOME/vizflyt or ~/.config/vizflyt]
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
}

/// Sets the password.
pub(crate) fn run(args: &PasswordArgs) -> Result<ExitCode> {
    let folder = KeysFolder::open(args.keys.as_deref())?;
    let password = if std::io::stdin().is_terminal() {
        let first = ask("password: ")?;
        if ask("once more: ")? != first {
            bail!("the two passwords differ; try again");
        }
        first
    } else {
        line()?
    };
    vizflyt_server::web::set_password(&folder, &password)?;
    print_line("the password is set: log in on the page, at the bottom");
    Ok(ExitCode::SUCCESS)
}

/// Prompts at the terminal without echo.
fn ask(question: &str) -> Result<String> {
    let mut error = std::io::stderr();
    write!(error, "{question}").and_then(|()| error.flush()).context("cannot prompt")?;
    let hidden = Hidden::begin()?;
    let password = line();
    drop(hidden);
    print_error("");
    password
}

fn line() -> Result<String> {
    let mut line = String::new();
    // Bounded: a wrong file on standard input must not fill the memory.
    let mut input = std::io::stdin().lock().take(4096);
    input.read_line(&mut line).context("cannot read the password")?;
    Ok(line.trim_end_matches(['\r', '\n']).to_owned())
}

/// Disables the terminal's echo until dropped.
struct Hidden(Termios);

impl Hidden {
    fn begin() -> Result<Self> {
        let former = tcgetattr(std::io::stdin()).context("cannot disable the terminal's echo")?;
        let mut hiding = former.clone();
        hiding.local_flags.remove(LocalFlags::ECHO);
        tcsetattr(std::io::stdin(), SetArg::TCSAFLUSH, &hiding)
            .context("cannot disable the terminal's echo")?;
        Ok(Self(former))
    }
}

impl Drop for Hidden {
    fn drop(&mut self) {
        let _ = tcsetattr(std::io::stdin(), SetArg::TCSANOW, &self.0);
    }
}
