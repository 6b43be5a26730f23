//! Access to the page: instructor or team, by address, password or key.
//!
//! Loopback is the instructor's computer and needs no login, unless `--login always` is set. All other viewers log in
//! with the password ([`super::password`]), which makes them instructor, or open `/enter?key=...` once, which stores
//! the key in a cookie. A session or key determines the rights, independent of the address. The instructor's key opens
//! everything; a vehicle's key opens that vehicle's page and stop button. The table of routes ([`super::routes`])
//! states the rights that each route requires; [`super::guard`] checks them.
//!
//! Requests that change something also require the token that belongs to the cookie, which pages of other sites cannot
//! read (CSRF protection). The stop button requires no token, because it must work in any state of the page.

use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use axum::http::{HeaderMap, header};
use serde::{Deserialize, Serialize};
use tokio::sync::Semaphore;
use vizflyt_trust::{Fingerprint, KeyError, KeysFolder, secret};

use super::password;
use super::sessions::{Sessions, Tokens};
use crate::rate_limit::RateLimiter;
use vizflyt_process::lock;

/// Role of a page's viewer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Viewer {
    /// Access to everything.
    Instructor,
    /// Access to this vehicle's page and stop button.
    Team(String),
}

impl Viewer {
    /// Whether this viewer may see a vehicle.
    pub(crate) fn may_see(&self, vehicle: &str) -> bool {
        match self {
            Self::Instructor => true,
            Self::Team(own) => own == vehicle,
        }
    }
}

/// The page's keys, stored by their hash, so that a lookup leaks nothing about a key by its duration.
#[derive(Debug, Default)]
pub struct PageKeys {
    viewers: HashMap<Fingerprint, Viewer>,
    file: KeysFile,
}

/// Contents of `page-keys.toml`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct KeysFile {
    instructor: String,
    #[serde(default)]
    vehicles: BTreeMap<String, String>,
}

impl PageKeys {
    /// Reads the keys of a folder, and creates missing ones for `vehicles`.
    ///
    /// # Errors
    /// If the file cannot be read, parsed or written.
    pub fn keep(folder: &KeysFolder, vehicles: &[&str]) -> Result<Self, KeyError> {
        let damaged = |what: String| KeyError::Damaged { path: folder.file(FILE), what };
        let found = folder.read_secret(FILE)?;
        let is_new = found.is_none();
        let mut file: KeysFile = match found {
            Some(text) => toml::from_str(&text).map_err(|error| damaged(error.to_string()))?,
            None => KeysFile { instructor: secret().map_err(damaged)?, ..KeysFile::default() },
        };
        let mut is_changed = is_new;
        for vehicle in vehicles {
            if !file.vehicles.contains_key(*vehicle) {
                file.vehicles.insert((*vehicle).to_owned(), secret().map_err(damaged)?);
                is_changed = true;
            }
        }
        let mut viewers = HashMap::new();
        let team = |(name, key): (&String, &String)| (key.clone(), Viewer::Team(name.clone()));
        let all = file.vehicles.iter().map(team);
        for (key, viewer) in all.chain([(file.instructor.clone(), Viewer::Instructor)]) {
            if key.len() < MIN_KEY || !key.bytes().all(|byte| byte.is_ascii_alphanumeric()) {
                let what = format!(
                    "a key has {MIN_KEY} or more letters and digits; remove a wrong one and restart to create a new one"
                );
                return Err(damaged(what));
            }
            if viewers.insert(Fingerprint::of(key.as_bytes()), viewer).is_some() {
                return Err(damaged("two keys are the same; remove one of them".to_owned()));
            }
        }
        if is_changed {
            let text = toml::to_string(&file).map_err(|error| damaged(error.to_string()))?;
            folder.write(FILE, &(HEAD.to_owned() + &text))?;
        }
        Ok(Self { viewers, file })
    }

    /// Returns pairs of recipient and link, for the instructor and each of `vehicles`.
    pub fn links(&self, page: &str, vehicles: &[&str]) -> Vec<(String, String)> {
        let link = |key: &str| format!("{page}/enter?key={key}");
        let mut links = vec![("instructor".to_owned(), link(&self.file.instructor))];
        for name in vehicles {
            if let Some(key) = self.file.vehicles.get(*name) {
                links.push((format!("team of '{name}'"), link(key)));
            }
        }
        links
    }

    fn viewer(&self, key: &str) -> Option<&Viewer> {
        self.viewers.get(&Fingerprint::of(key.as_bytes()))
    }
}

/// Connections that must log in
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Login {
    /// From other computers; this computer is the instructor's
    #[default]
    Remote,
    /// Always, also here: for shared computers, or behind a proxy
    Always,
}

/// Keys, sessions and login settings that determine the rights of a viewer.
#[derive(Debug)]
pub struct Access {
    keys: PageKeys,
    login: Login,
    pub(super) folder: KeysFolder,
    pub(super) logins: Arc<Logins>,
}

/// Sessions and login attempts; kept when the scene changes.
#[derive(Debug)]
pub struct Logins {
    pub(super) sessions: Mutex<Sessions>,
    tokens: Tokens,
    pub(super) limiter: Mutex<RateLimiter>,
    /// Passwords that wait to be checked; `turn` admits one at a time.
    pub(super) queue: Semaphore,
    pub(super) turn: Semaphore,
}

impl Logins {
    /// Returns the state without sessions.
    ///
    /// # Errors
    /// If the system's random number generator fails.
    pub fn new() -> Result<Arc<Self>, String> {
        Ok(Arc::new(Self {
            sessions: Mutex::default(),
            tokens: Tokens::new()?,
            limiter: Mutex::default(),
            queue: Semaphore::new(MAX_WAITING),
            turn: Semaphore::new(1),
        }))
    }
}

/// Viewer of a request, and the credentials it showed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Shown {
    pub(super) viewer: Viewer,
    /// Cookies; both `None` for a viewer on the server's own computer.
    pub(super) session: Option<String>,
    pub(super) key: Option<String>,
}

impl Shown {
    /// Returns how the viewer was identified.
    pub(super) fn by(&self) -> &'static str {
        match (&self.session, &self.key) {
            (Some(_), _) => "password",
            (None, Some(_)) => "key",
            (None, None) => "here",
        }
    }
}

impl Access {
    /// Reads the keys, and creates missing ones for `vehicles`.
    ///
    /// # Errors
    /// As [`PageKeys::keep`].
    pub fn new(
        folder: &KeysFolder,
        vehicles: &[&str],
        login: Login,
        logins: Arc<Logins>,
    ) -> Result<Self, KeyError> {
        Ok(Self { keys: PageKeys::keep(folder, vehicles)?, login, folder: folder.clone(), logins })
    }

    pub fn keys(&self) -> &PageKeys {
        &self.keys
    }

    /// Returns the viewer that a key identifies; `None` if the key is wrong.
    pub(super) fn viewer_of(&self, key: &str) -> Option<&Viewer> {
        self.keys.viewer(key)
    }

    /// Returns the viewer of a request; `None` if it has no access.
    pub(super) fn judge(&self, from: IpAddr, headers: &HeaderMap) -> Option<Shown> {
        if let Some(session) = cookie(headers, SESSION) {
            let password = self.folder.stamp(password::FILE);
            if lock(&self.logins.sessions).is_live(Instant::now(), password, session) {
                let session = Some(session.to_owned());
                return Some(Shown { viewer: Viewer::Instructor, session, key: None });
            }
        }
        // The instructor's key first: it includes the rights of every team key.
        let keys = [KEY, TEAM_KEY].map(|name| cookie(headers, name));
        let mut known =
            keys.into_iter().flatten().filter_map(|key| Some((self.keys.viewer(key)?, key)));
        if let Some((viewer, key)) = known.next() {
            return Some(Shown {
                viewer: viewer.clone(),
                session: None,
                key: Some(key.to_owned()),
            });
        }
        if keys.iter().any(Option::is_some) {
            return None;
        }
        (self.login == Login::Remote && from.to_canonical().is_loopback()).then_some(Shown {
            viewer: Viewer::Instructor,
            session: None,
            key: None,
        })
    }

    /// Whether the credentials are still valid: a session may have ended since.
    pub(super) fn holds(&self, shown: &Shown) -> bool {
        shown.session.as_ref().is_none_or(|session| {
            let password = self.folder.stamp(password::FILE);
            lock(&self.logins.sessions).is_live(Instant::now(), password, session)
        })
    }

    /// Returns the token for these credentials; `None` if none is required.
    pub(super) fn token(&self, shown: &Shown) -> Option<String> {
        let cookie = shown.session.as_ref().or(shown.key.as_ref())?;
        Some(self.logins.tokens.of(cookie))
    }

    /// Whether the request contains the token for these credentials.
    pub(super) fn has_token(&self, shown: &Shown, headers: &HeaderMap) -> bool {
        let Some(cookie) = shown.session.as_ref().or(shown.key.as_ref()) else { return true };
        let token = headers.get(TOKEN).and_then(|token| token.to_str().ok());
        token.is_some_and(|token| self.logins.tokens.fits(cookie, token))
    }
}

/// Returns the `Set-Cookie` line: `HttpOnly`, so that scripts cannot read it, and `SameSite=Strict`, so that pages of
/// other sites cannot send it. `Secure` if the page was opened over TLS, also through a proxy. A client could forge
/// that header, but would affect only its own cookie.
pub(super) fn cookie_line(
    name: &str,
    value: &str,
    age_s: Option<u32>,
    headers: &HeaderMap,
) -> String {
    let text = |name: &str| headers.get(name).and_then(|value| value.to_str().ok());
    let is_secure = text("origin").is_some_and(|origin| origin.starts_with("https://"))
        || text(FORWARDED_PROTO) == Some("https");
    let age = age_s.map_or_else(String::new, |age_s| format!("; Max-Age={age_s}"));
    let secure = if is_secure { "; Secure" } else { "" };
    format!("{name}={value}; Path=/{age}; HttpOnly; SameSite=Strict{secure}")
}

/// Returns the first cookie of this name. Duplicates are harmless: each is checked in the same way.
pub(super) fn cookie<'a>(headers: &'a HeaderMap, wanted: &str) -> Option<&'a str> {
    let lines = headers.get_all(header::COOKIE).iter().filter_map(|line| line.to_str().ok());
    let mut pairs = lines.flat_map(|line| line.split(';')).filter_map(|pair| {
        let (name, value) = pair.trim().split_once('=')?;
        (name == wanted).then_some(value)
    });
    pairs.next()
}

pub(super) const NO_KEY: &str = "this page needs a key: open the address that the instructor gave you, which ends in \
     /enter?key=..., or log in with the instructor's password";
const FILE: &str = "page-keys.toml";
const HEAD: &str = "\
# Keys of the server's page. Log in with http://SERVER/enter?key=KEY. To replace a key, remove its line and restart the
# server; the old key is then invalid.
";
/// Cookie of the instructor's key. Earlier versions also stored a team's key in it.
pub(super) const KEY: &str = "vizflyt_key";
/// Cookie of a team's key.
pub(super) const TEAM_KEY: &str = "vizflyt_team_key";
/// Cookie of a session, until the browser closes.
pub(super) const SESSION: &str = "vizflyt_session";
/// Header by which a proxy, or the page's TLS listener, marks a request that arrived over TLS.
pub(super) const FORWARDED_PROTO: &str = "x-forwarded-proto";
/// Header of the token.
const TOKEN: &str = "x-vizflyt-token";
/// Maximum number of waiting logins; more indicate an attack.
const MAX_WAITING: usize = 8;
/// 80 bits of entropy, also for a key written by hand.
const MIN_KEY: usize = 16;

#[cfg(test)]
#[path = "access/tests.rs"]
mod tests;
