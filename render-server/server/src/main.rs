//! `vizflyt-server`: only the render server, without the rest of `vizflyt`.

use std::io::{IsTerminal, Write};

use clap::{CommandFactory, FromArgMatches, Parser};
use vizflyt_process::{LogWriter, finish_output, never_wait_for_readers};
use vizflyt_server::settings;

#[derive(Parser)]
#[command(version, about)]
struct Cli {
    #[command(flatten)]
    serve: vizflyt_server::ServeArgs,
}

fn main() -> anyhow::Result<()> {
    tracing_subscriber::fmt()
        .with_writer(|| LogWriter)
        .with_ansi(std::io::stderr().is_terminal())
        .init();
    let matches = Cli::command().get_matches();
    let line = settings::with_file(std::env::args_os().collect(), &matches)?;
    let matches = Cli::command().get_matches_from(line);
    if matches.get_flag("print_config") {
        // A closed pipe is not an error.
        let _ = std::io::stdout().write_all(settings::to_toml(&matches).as_bytes());
        return Ok(());
    }
    never_wait_for_readers();
    let result = vizflyt_server::serve(Cli::from_arg_matches(&matches)?.serve);
    finish_output();
    result
}
