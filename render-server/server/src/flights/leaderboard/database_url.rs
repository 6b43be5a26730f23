//! Address of the database.

use std::fmt;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Database of runs: a file, or the URL of a `PostgreSQL` server.
#[derive(Clone, PartialEq, Eq)]
pub enum Database {
    /// `SQLite`; created if it does not exist.
    File(PathBuf),
    /// `postgres://USER:PASSWORD@HOST/NAME`.
    Postgres(String),
}

impl Database {
    /// Returns the default file, by the XDG base directory specification; `None` without a home directory.
    pub fn default_file() -> Option<PathBuf> {
        let set = |name: &str| {
            std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from)
        };
        let data = set("XDG_DATA_HOME").filter(|path| path.is_absolute());
        let data = data.or_else(|| Some(set("HOME")?.join(".local/share")))?;
        Some(data.join("vizflyt").join("leaderboard.sqlite"))
    }

    /// Returns the URL for the driver.
    pub(super) fn url(&self) -> String {
        match self {
            // The driver decodes percent-encoding; a `?` or `%` in a path would be parsed as options.
            Self::File(path) => format!("sqlite://{}?mode=rwc", encoded(path)),
            Self::Postgres(url) => url.clone(),
        }
    }
}

fn encoded(path: &Path) -> String {
    path.as_os_str().as_encoded_bytes().iter().fold(String::new(), |mut out, &byte| {
        if byte.is_ascii_alphanumeric() || b"-._~/".contains(&byte) {
            out.push(char::from(byte));
        } else {
            // Writing to a String cannot fail.
            let _ = write!(out, "%{byte:02X}");
        }
        out
    })
}

impl FromStr for Database {
    type Err = UnknownDatabase;

    fn from_str(text: &str) -> Result<Self, UnknownDatabase> {
        match text.split_once("://") {
            Some(("postgres" | "postgresql", _)) => Ok(Self::Postgres(text.to_owned())),
            Some((scheme, _)) => Err(UnknownDatabase(scheme.to_owned())),
            // Probably not meant as the name of a file.
            None if text.starts_with("sqlite:") => Err(UnknownDatabase("sqlite:".to_owned())),
            None if text.is_empty() => Err(UnknownDatabase(String::new())),
            None => Ok(Self::File(PathBuf::from(text))),
        }
    }
}

/// Unsupported database.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is not a supported database; give a file, or postgres://USER:PASSWORD@HOST/NAME")]
pub struct UnknownDatabase(String);

/// Hides the password.
impl fmt::Display for Database {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path) => write!(f, "{}", path.display()),
            Self::Postgres(url) => {
                let (scheme, rest) = url.split_once("://").unwrap_or(("postgres", url));
                // The last of several @ ends the password.
                let place = rest.rsplit_once('@').map_or(rest, |(_, place)| place);
                // Options may contain a password too.
                let place = place.split('?').next().unwrap_or("");
                write!(f, "{scheme}://{place}")
            }
        }
    }
}

impl fmt::Debug for Database {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Database({self})")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_files_and_servers_and_hides_passwords() {
        let file: Database = "class of 26.sqlite".parse().unwrap();
        assert_eq!(file.url(), "sqlite://class%20of%2026.sqlite?mode=rwc");
        let server: Database =
            "postgres://me:se@cret@db.example:5432/runs?password=x".parse().unwrap();
        assert_eq!(server.to_string(), "postgres://db.example:5432/runs");
        assert!(!format!("{server:?}").contains("cret"));
        let error = "mysql://x".parse::<Database>().unwrap_err().to_string();
        assert!(error.contains("'mysql' is not a supported database"), "{error}");
        for none in ["", "sqlite:runs.sqlite", "sqlite:///runs.sqlite"] {
            assert!(none.parse::<Database>().is_err(), "{none}");
        }
    }
}
