//! `vizflyt password`: sets the instructor's password of the server's page.

use std::io::{BufRead, IsTerminal, Read, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use clap::Args;
use nix::sys::termios::{LocalFlags, SetArg, Termios, tcgetattr, tcsetattr};
use vizflyt_process::{print_error, print_line};
use vizflyt_trust::KeysFolder;

/// Sets the password by which the instructor logs in on the server's page.
///
/// Run it on the server's computer. A server that runs takes the new password at once, and whoever had
/// logged in with the former one is out.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt password                        asks for it twice
  pass show lab | vizflyt password        takes the first line of standard input")]
pub(crate) struct PasswordArgs {
    /// Folder of the server's keys [default: $XDG_CONFIG_HOME/vizflyt or ~/.config/vizflyt]
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
}

/// Sets it.
pub(crate) fn run(args: &PasswordArgs) -> Result<ExitCode> {
    let folder = KeysFolder::open(args.keys.as_deref())?;
    let password = if std::io::stdin().is_terminal() {
        let first = ask("password: ")?;
        if ask("once more: ")? != first {
            bail!("these were two different passwords; try again");
        }
        first
    } else {
        line()?
    };
    vizflyt_server::web::set_password(&folder, &password)?;
    print_line("the password is set: log in on the page, at the bottom");
    Ok(ExitCode::SUCCESS)
}

/// Asks at the terminal, which shows nothing of what is typed.
fn ask(question: &str) -> Result<String> {
    let mut error = std::io::stderr();
    write!(error, "{question}").and_then(|()| error.flush()).context("cannot ask")?;
    let hidden = Hidden::begin()?;
    let password = line();
    drop(hidden);
    print_error("");
    password
}

fn line() -> Result<String> {
    let mut line = String::new();
    // Bounded: a file that is no password must not fill the memory.
    let mut input = std::io::stdin().lock().take(4096);
    input.read_line(&mut line).context("cannot read the password")?;
    Ok(line.trim_end_matches(['\r', '\n']).to_owned())
}

/// A terminal that shows nothing of what is typed, until dropped.
struct Hidden(Termios);

impl Hidden {
    fn begin() -> Result<Self> {
        let former = tcgetattr(std::io::stdin()).context("cannot hide what is typed")?;
        let mut hiding = former.clone();
        hiding.local_flags.remove(LocalFlags::ECHO);
        tcsetattr(std::io::stdin(), SetArg::TCSAFLUSH, &hiding)
            .context("cannot hide what is typed")?;
        Ok(Self(former))
    }
}

impl Drop for Hidden {
    fn drop(&mut self) {
        let _ = tcsetattr(std::io::stdin(), SetArg::TCSANOW, &self.0);
    }
}
