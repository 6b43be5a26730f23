//! The list of commands in groups, shell completions and manual pages.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::{Args, Command};
use clap_complete::Shell;

/// Commands by purpose, in the order of `vizflyt --help`.
const GROUPS: [(&str, &[&str]); 5] = [
    ("Fly", &["demo", "new", "fly", "replay", "stats", "sim"]),
    ("Teach", &["grade", "submit", "grade-class", "leaderboard"]),
    ("Scenes and data", &["scene", "arena", "dataset", "gym", "export", "evaluate"]),
    (
        "Lab",
        &[
            "serve",
            "pair",
            "password",
            "doctor",
            "vehicle",
            "tags",
            "bridge",
            "lab",
            "crazyflie",
            "ros2",
        ],
    ),
    ("Help and tools", &["docs", "bench", "completions", "help"]),
];

/// Returns `command` with a help page that lists its subcommands in [`GROUPS`].
pub(crate) fn grouped(command: Command) -> Command {
    let mut list = String::new();
    for (title, names) in GROUPS {
        let _ = writeln!(list, "{title}:");
        for name in names {
            let about = match command.find_subcommand(name) {
                Some(subcommand) => {
                    subcommand.get_about().map(ToString::to_string).unwrap_or_default()
                }
                None if *name == "help" => "Print the help of a command".to_owned(),
                // Left out of this build.
                None => continue,
            };
            let _ = writeln!(list, "  {name:<11}  {about}");
        }
        list.push('\n');
    }
    command.help_template(format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n\n{list}Options:\n{{options}}{{after-help}}"
    ))
}

/// Arguments of `vizflyt completions`.
#[derive(Args, Debug)]
pub(crate) struct CompletionsArgs {
    /// Shell to complete commands and options in
    shell: Shell,
}

/// Prints the completions of `command` for a shell.
pub(crate) fn print_completions(args: &CompletionsArgs, mut command: Command) -> Result<ExitCode> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command, "vizflyt", &mut script);
    std::io::stdout().write_all(&script).context("cannot print the completions")?;
    Ok(ExitCode::SUCCESS)
}

/// Arguments of `vizflyt man`.
#[derive(Args, Debug)]
pub(crate) struct ManArgs {
    /// Folder for the manual pages
    folder: PathBuf,
}

/// Writes a manual page of `command` and of each subcommand: `vizflyt.1`, `vizflyt-fly.1`, ...
pub(crate) fn write_manual(args: &ManArgs, command: Command) -> Result<ExitCode> {
    let folder = &args.folder;
    std::fs::create_dir_all(folder)
        .and_then(|()| clap_mangen::generate_to(command, folder))
        .with_context(|| format!("cannot write manual pages to {}", folder.display()))?;
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    /// Columns of a terminal.
    const COLUMNS: usize = 80;

    #[test]
    fn lists_each_command_in_one_group() {
        let command = crate::Cli::command();
        let listed: Vec<&str> =
            GROUPS.iter().flat_map(|(_, names)| names.iter().copied()).collect();
        for subcommand in command.get_subcommands().filter(|subcommand| !subcommand.is_hide_set()) {
            let name = subcommand.get_name();
            let count = listed.iter().filter(|&&other| other == name).count();
            assert_eq!(count, 1, "{name}");
        }
        let help = grouped(command).render_help().to_string();
        for line in help.lines().filter(|line| line.starts_with("  ") && !line.contains("--")) {
            assert!(line.chars().count() <= COLUMNS, "{line}");
        }
    }

    #[test]
    fn first_lines_of_help_have_at_most_80_characters() {
        fn check(command: &Command, path: &str) {
            let about = command.get_about().map(ToString::to_string).unwrap_or_default();
            assert!((1..=COLUMNS).contains(&about.chars().count()), "{path}: {about}");
            for argument in command.get_arguments().filter(|argument| !argument.is_hide_set()) {
                let help = argument.get_help().map(ToString::to_string).unwrap_or_default();
                let length = help.chars().count();
                assert!((1..=COLUMNS).contains(&length), "{path} {}: {help}", argument.get_id());
            }
            for subcommand in
                command.get_subcommands().filter(|subcommand| !subcommand.is_hide_set())
            {
                check(subcommand, &format!("{path} {}", subcommand.get_name()));
            }
        }
        check(&crate::Cli::command(), "vizflyt");
    }

    #[test]
    fn completions_and_manual_pages_know_all_commands() {
        let mut script = Vec::new();
        clap_complete::generate(Shell::Bash, &mut crate::Cli::command(), "vizflyt", &mut script);
        let script = String::from_utf8(script).unwrap();
        assert!(script.contains("grade-class") && script.contains("--max-rate"));
        let folder = tempfile::tempdir().unwrap();
        let args = ManArgs { folder: folder.path().join("man1") };
        write_manual(&args, crate::Cli::command()).unwrap();
        let page = std::fs::read_to_string(folder.path().join("man1/vizflyt-fly.1")).unwrap();
        assert!(page.contains("SYNOPSIS") && page.contains("plugin"), "{page}");
    }
}
