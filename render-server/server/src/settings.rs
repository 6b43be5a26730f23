//! `vizflyt serve --config server.toml` and `--print-config`: conversion between options and a file.
//!
//! Every option is a key with its long name, with `_` for `-`; the arena is `arena`. The option's own parser
//! reads the value of a key, so that file and command line accept the same values. The command line overrides
//! the file. Paths in a file are relative to its folder.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::builder::ValueHint;
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Args, Command};
use toml::Spanned;
use toml::de::{DeTable, DeValue};
use vizflyt_toml::{TomlError, TomlErrors, error_at, unknown_among};

use crate::args::ServeArgs;

/// Options that are not settings.
const NO_KEYS: [&str; 5] = ["config", "print_config", "lifeline", "help", "version"];

/// Returns a command line of `serve`, completed with the settings of its file. `matches` is clap's result for
/// `line`. Without `--config` the line is unchanged.
///
/// # Errors
/// The file cannot be read; or all errors in it.
pub fn with_file(mut line: Vec<OsString>, matches: &ArgMatches) -> Result<Vec<OsString>> {
    let Some(path) = matches.get_one::<PathBuf>("config") else { return Ok(line) };
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let settings = read(&text, folder).with_context(|| format!("{} is wrong", path.display()))?;
    let is_said = |id: &str| matches.value_source(id) == Some(ValueSource::CommandLine);
    let added: Vec<Setting> =
        settings.into_iter().filter(|setting| !is_said(&setting.id)).collect();
    let has_arena = is_said(ARENA) || added.iter().any(|setting| setting.id == ARENA);
    if !has_arena && !matches.get_flag("print_config") {
        bail!("no arena: name one, or give `arena` in {}", path.display());
    }
    // Inserted before the user's arguments, which may contain a `--`.
    let at = line.iter().position(|word| word == "serve").map_or(1, |at| at + 1);
    line.splice(at..at, added.into_iter().flat_map(|setting| setting.arguments));
    Ok(line)
}

/// Returns the effective settings as TOML that [`with_file`] reads back; keys without a value are comments.
pub fn to_toml(matches: &ArgMatches) -> String {
    let mut text = String::new();
    for argument in command().get_arguments().filter(|argument| is_setting(argument)) {
        let id = argument.get_id().as_str();
        let help = argument.get_help().map(ToString::to_string).unwrap_or_default();
        text.extend(["# ", help.replace('\n', " ").as_str(), "\n"]);
        let key = key(argument);
        match value(argument, matches, id) {
            Some(value) => text.extend([key.as_str(), " = ", &value.to_string(), "\n\n"]),
            None => text.extend(["# ", key.as_str(), " =\n\n"]),
        }
    }
    text
}

const ARENA: &str = "arena";

/// Key of a file, as the equivalent arguments.
struct Setting {
    id: String,
    arguments: Vec<OsString>,
}

fn command() -> Command {
    ServeArgs::augment_args(Command::new("serve"))
}

fn is_setting(argument: &Arg) -> bool {
    !NO_KEYS.contains(&argument.get_id().as_str())
}

fn key(argument: &Arg) -> String {
    argument.get_long().unwrap_or(ARENA).replace('-', "_")
}

fn value(argument: &Arg, matches: &ArgMatches, id: &str) -> Option<toml::Value> {
    if matches!(argument.get_action(), ArgAction::SetTrue) {
        return Some(matches.get_flag(id).into());
    }
    let typed = |raw: &std::ffi::OsStr| {
        let text = raw.to_string_lossy().into_owned();
        let number = text.parse().map(toml::Value::Integer);
        number.or_else(|_| text.parse().map(toml::Value::Float)).unwrap_or(text.into())
    };
    let mut values = matches.get_raw(id)?.map(typed);
    if matches!(argument.get_action(), ArgAction::Append) {
        return Some(values.collect::<Vec<_>>().into());
    }
    values.next()
}

fn read(text: &str, folder: &Path) -> Result<Vec<Setting>, TomlErrors> {
    let (table, syntax) = DeTable::parse_recoverable(text);
    let at = |error: &toml::de::Error| error.span().map_or(0, |span| span.start);
    let mut errors: Vec<TomlError> =
        syntax.iter().map(|error| error_at(text, at(error), error.message().to_owned())).collect();
    let command = command();
    let arguments: Vec<&Arg> = command.get_arguments().filter(|a| is_setting(a)).collect();
    let mut settings = Vec::new();
    for (name, value) in table.get_ref() {
        let found = arguments.iter().find(|argument| key(argument) == **name.get_ref());
        let Some(argument) = found else {
            let keys: Vec<String> = arguments.iter().map(|argument| key(argument)).collect();
            let known: Vec<&str> = keys.iter().map(String::as_str).collect();
            let what = unknown_among(name.get_ref(), &known);
            errors.push(error_at(text, name.span().start, what));
            continue;
        };
        match setting(argument, value, folder) {
            Ok(setting) => settings.push(setting),
            Err(what) => {
                let what = format!("{}: {what}", name.get_ref());
                errors.push(error_at(text, value.span().start, what));
            }
        }
    }
    if errors.is_empty() { Ok(settings) } else { Err(TomlErrors::in_order(errors)) }
}

fn setting(argument: &Arg, value: &Spanned<DeValue<'_>>, folder: &Path) -> Result<Setting, String> {
    let id = argument.get_id().as_str().to_owned();
    let long = argument.get_long();
    if matches!(argument.get_action(), ArgAction::SetTrue) {
        let is_set = value.get_ref().as_bool().ok_or("write true or false")?;
        let arguments =
            if is_set { vec![format!("--{}", long.unwrap_or_default()).into()] } else { vec![] };
        return Ok(Setting { id, arguments });
    }
    let is_list = matches!(argument.get_action(), ArgAction::Append);
    let texts = match value.get_ref() {
        DeValue::Array(array) if is_list => {
            array.iter().map(|value| text_of(value.get_ref())).collect::<Result<Vec<_>, _>>()?
        }
        value => vec![text_of(value)?],
    };
    let is_path = matches!(argument.get_value_hint(), ValueHint::AnyPath | ValueHint::FilePath);
    let arguments = texts.into_iter().map(|text| {
        let is_elsewhere = text == "none" || text == "auto" || text.contains("://");
        let text =
            if is_path && !is_elsewhere { folder.join(text).into_os_string() } else { text.into() };
        let Some(long) = long else { return text };
        let mut whole = OsString::from(format!("--{long}="));
        whole.push(text);
        whole
    });
    let arguments: Vec<OsString> = arguments.collect();
    check(&arguments, long.is_some())?;
    Ok(Setting { id, arguments })
}

/// Checks values with the option's own parser.
fn check(arguments: &[OsString], is_flag: bool) -> Result<(), String> {
    let arena: &[OsString] = if is_flag { &["x".into()] } else { &[] };
    let line = [OsString::from("serve")].into_iter().chain(arguments.iter().chain(arena).cloned());
    let Err(error) = command().try_get_matches_from(line) else { return Ok(()) };
    let message = error.to_string();
    let first = message.lines().next().unwrap_or_default();
    Err(first.trim_start_matches("error: ").to_owned())
}

fn text_of(value: &DeValue<'_>) -> Result<String, String> {
    match value {
        DeValue::String(text) => Ok(text.to_string()),
        DeValue::Integer(number) => Ok(number.as_str().to_owned()),
        DeValue::Float(number) => Ok(number.as_str().to_owned()),
        other => Err(format!("write a string or a number, not {}", other.type_str())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matches(line: &[OsString]) -> ArgMatches {
        command().try_get_matches_from(line).unwrap()
    }

    /// Returns the arguments that result from a file and these arguments.
    fn settled(text: &str, arguments: &[&str]) -> Result<Vec<String>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("server.toml");
        std::fs::write(&path, text).unwrap();
        let mut line: Vec<OsString> = vec!["serve".into()];
        line.extend(arguments.iter().map(OsString::from));
        line.extend(["--config".into(), path.into_os_string()]);
        let line = with_file(line.clone(), &matches(&line))?;
        // clap must accept the result.
        matches(&line);
        let here = format!("{}/", folder.path().display());
        let added = 1..line.len() - 2 - arguments.len();
        Ok(line[added].iter().map(|text| text.to_string_lossy().replace(&here, "HERE/")).collect())
    }

    #[test]
    fn file_is_equivalent_to_flags_and_flags_override_it() {
        let text = "arena = 'hall/arena.toml'\nquality = 80\nvehicle = ['ant', 'bee']\n\
                    apart = true\njson = false\nmax_rate = 60.5\nleaderboard = 'none'\n";
        let line = settled(text, &[]).unwrap();
        assert_eq!(
            line,
            [
                "--apart",
                "HERE/hall/arena.toml",
                "--leaderboard=none",
                "--max-rate=60.5",
                "--quality=80",
                "--vehicle=ant",
                "--vehicle=bee",
            ]
        );
        let line = settled(text, &["other.toml", "--vehicle=cat", "--quality=70"]).unwrap();
        assert_eq!(line, ["--apart", "--leaderboard=none", "--max-rate=60.5"]);
        let line = settled("leaderboard = 'runs.sqlite'\n", &["x"]).unwrap();
        assert_eq!(line, ["--leaderboard=HERE/runs.sqlite"]);
        let line = settled("tls = 'auto'\n", &["x"]).unwrap();
        assert_eq!(line, ["--tls=auto"]);
        let line = settled("tls = 'page.pem'\ntls_key = '/k.pem'\n", &["x"]).unwrap();
        assert_eq!(line, ["--tls=HERE/page.pem", "--tls-key=/k.pem"]);
        let line = settled("up = '-y'\nleaderboard = 'postgres://lab@db/runs'\n", &["x"]).unwrap();
        assert_eq!(line, ["--leaderboard=postgres://lab@db/runs", "--up=-y"]);
    }

    #[test]
    fn reports_all_errors_at_once() {
        let text = "qualty = 80\nquality = 0\njson = 1\nmax_rate = [1]\nhttp = 'lab'\n\
                    vehicle = 'ant'\n[page]\n";
        let error = format!("{:#}", settled(text, &["x"]).unwrap_err());
        for part in [
            "line 1, column 1: unknown key 'qualty'; did you mean 'quality'?",
            "line 2, column 11: quality: invalid value '0'",
            "line 3, column 8: json: write true or false",
            "line 4, column 12: max_rate: write a string or a number, not array",
            "line 5, column 8: http: invalid value 'lab'",
            "line 7, column 2: unknown key 'page'",
        ] {
            assert!(error.contains(part), "{error:?} does not contain {part:?}");
        }
        assert!(!error.contains("vehicle: "), "one is a list, too: {error}");
        let error = format!("{:#}", settled("quality = 80\n", &[]).unwrap_err());
        assert!(error.contains("no arena: name one"), "{error}");
        let error = format!("{:#}", settled("quality = \n[", &["x"]).unwrap_err());
        assert!(error.contains("line 1, column"), "{error}");
        for no_key in NO_KEYS {
            assert!(settled(&format!("{no_key} = true\n"), &["x"]).is_err(), "{no_key}");
        }
    }

    #[test]
    fn printed_settings_are_read_back() {
        let line = ["serve", "a.toml", "--quality=70", "--vehicle=ant", "--vehicle=7", "--apart"];
        let printed = to_toml(&matches(&line.map(OsString::from)));
        let table: toml::Table = printed.parse().unwrap();
        assert_eq!(table["quality"].as_integer(), Some(70));
        assert_eq!(table["quic"].as_str(), Some("0.0.0.0:4433"), "a default");
        assert_eq!(table["apart"].as_bool(), Some(true));
        assert!(printed.contains("# scenes ="), "{printed}");
        let again = settled(&printed, &[]).unwrap();
        let again: Vec<OsString> =
            ["serve".into()].into_iter().chain(again.into_iter().map(Into::into)).collect();
        // Except the arena, whose path is relative to the file.
        let second: toml::Table = to_toml(&matches(&again)).parse().unwrap();
        let without = |mut table: toml::Table| {
            table.remove(ARENA);
            table
        };
        assert_eq!(without(second), without(table));
    }

    #[test]
    fn the_shipped_file_is_valid() {
        let text = include_str!("../server.toml");
        let line = settled(text, &[]).unwrap();
        assert!(line.iter().any(|word| word == "HERE/hall/arena.toml"), "{line:?}");
        // Every key is in it, at least as a comment.
        for argument in command().get_arguments().filter(|argument| is_setting(argument)) {
            let key = key(argument);
            let is_there = text.lines().any(|line| {
                line.trim_start_matches("# ").split_once(" =").is_some_and(|(name, _)| name == key)
            });
            assert!(is_there, "{key}");
        }
    }
}
