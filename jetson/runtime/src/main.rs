//! `vizflyt-jetson`: only `vizflyt fly`, for embedded computers that need no other command.

use std::io::IsTerminal;
use std::process::ExitCode;

use clap::Parser;
use vizflyt_process::{LogWriter, finish_output, never_wait_for_readers, print_error};
use vizflyt_runtime::{FlyArgs, fly};

#[derive(Parser)]
#[command(version, about)]
struct Program {
    #[command(flatten)]
    fly: FlyArgs,
}

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    if arguments.next().as_deref() == Some(vizflyt_guardian::SUBCOMMAND)
        && let Some(address) = arguments.next()
    {
        return vizflyt_guardian::run(&address);
    }
    never_wait_for_readers();
    tracing_subscriber::fmt()
        .with_writer(|| LogWriter)
        .with_ansi(std::io::stderr().is_terminal())
        .init();
    let code = match fly(Program::parse().fly) {
        Ok(end) if end.outcome().is_good() => ExitCode::SUCCESS,
        Ok(_) => ExitCode::from(3),
        Err(error) => {
            print_error(format_args!("vizflyt-jetson: {error:#}"));
            ExitCode::FAILURE
        }
    };
    finish_output();
    code
}
