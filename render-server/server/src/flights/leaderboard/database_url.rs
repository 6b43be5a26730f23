//! Where the database is.

use std::fmt;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// A database of runs: a file, or a `PostgreSQL` server's URL.
#[derive(Clone, PartialEq, Eq)]
pub enum Database {
    /// `SQLite`; made if it is not there.
    File(PathBuf),
    /// `postgres://USER:PASSWORD@HOST/NAME`.
    Postgres(String),
}

impl Database {
    /// Returns the file where runs are stored by default, after the XDG base directory
    /// specification; `None` without a home.
    pub fn default_file() -> Option<PathBuf> {
        let set = |name: &str| {
            std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from)
        };
        let data = set("XDG_DATA_HOME").filter(|path| path.is_absolute());
        let data = data.or_else(|| Some(set("HOME")?.join(".local/share")))?;
        Some(data.join("vizflyt").join("leaderboard.sqlite"))
    }

    /// Returns the URL to open it by.
    pub(super) fn url(&self) -> String {
        match self {
            // The driver undoes percent-encoding; a `?` or `%` in a path would be read as options.
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
            // Why: writing to a String cannot fail.
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
            // A file of that name would hardly be meant.
            None if text.starts_with("sqlite:") => Err(UnknownDatabase("sqlite:".to_owned())),
            None if text.is_empty() => Err(UnknownDatabase(String::new())),
            None => Ok(Self::File(PathBuf::from(text))),
        }
    }
}

/// No database that is known.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is no database that is known; give a file, or postgres://USER:PASSWORD@HOST/NAME")]
pub struct UnknownDatabase(String);

/// A password is not shown.
impl fmt::Display for Database {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path) => write!(f, "{}", path.display()),
            Self::Postgres(url) => {
                let (scheme, rest) = url.split_once("://").unwrap_or(("postgres", url));
                // Of several @ the last ends the password.
                let place = rest.rsplit_once('@').map_or(rest, |(_, place)| place);
                // Options may hold a password too.
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
        assert!(error.contains("'mysql' is no database"), "{error}");
        for none in ["", "sqlite:runs.sqlite", "sqlite:///runs.sqlite"] {
            assert!(none.parse::<Database>().is_err(), "{none}");
        }
    }
}
