//! Who looks at the page: the instructor, or a team, by address, password or key.
//!
//! Loopback is the instructor's own computer and needs no login, unless `--login always` asks for
//! one there too. Everyone else logs in with the password ([`super::password`]) and is the instructor,
//! or shows a key, once, by opening `/enter?key=...`, and has it in a cookie from then on. Who shows
//! a session or a key is judged by it, wherever it comes from. The instructor's key opens
//! everything, a vehicle's key that vehicle's page and stop button. What each route takes is stated
//! where it is made ([`super::routes`]), and checked by [`super::guard`].
//!
//! What changes something also takes the token that belongs to the cookie, which no other site's
//! page can read; all but the stop button, which must work whatever state a page is in.

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

/// Who looks at the page.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Viewer {
    /// Everything.
    Instructor,
    /// This vehicle's page and stop button.
    Team(String),
}

impl Viewer {
    /// Whether this one may see a vehicle.
    pub(crate) fn may_see(&self, vehicle: &str) -> bool {
        match self {
            Self::Instructor => true,
            Self::Team(own) => own == vehicle,
        }
    }
}

/// The page's keys, by their hash: looking one up takes the same time whatever it is.
#[derive(Debug, Default)]
pub struct PageKeys {
    viewers: HashMap<Fingerprint, Viewer>,
    file: KeysFile,
}

/// `page-keys.toml`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct KeysFile {
    instructor: String,
    #[serde(default)]
    vehicles: BTreeMap<String, String>,
}

impl PageKeys {
    /// Reads the keys of a folder, and makes those that are missing for `vehicles`.
    ///
    /// # Errors
    /// A file that cannot be used.
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
                    "a key is {MIN_KEY} letters and digits or more; remove a wrong one and start again for a new one"
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

    /// Returns the addresses to hand out for `vehicles`: who it is for, and the address.
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

/// Where loopback must log in as well.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Login {
    /// From other computers; who sits at this one is the instructor
    #[default]
    Remote,
    /// Here too: for a computer that students use, or behind a proxy
    Always,
}

/// All that decides who may do what.
#[derive(Debug)]
pub struct Access {
    keys: PageKeys,
    login: Login,
    pub(super) folder: KeysFolder,
    pub(super) logins: Arc<Logins>,
}

/// Who has logged in, and who tries to; outlives a change of scene.
#[derive(Debug)]
pub struct Logins {
    pub(super) sessions: Mutex<Sessions>,
    tokens: Tokens,
    pub(super) limiter: Mutex<RateLimiter>,
    /// Passwords that wait to be checked, and the one that is.
    pub(super) queue: Semaphore,
    pub(super) turn: Semaphore,
}

impl Logins {
    /// Makes that of a server that nobody has logged in to yet.
    ///
    /// # Errors
    /// If the system gives no random numbers.
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

/// Who asks, and what it showed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Shown {
    pub(super) viewer: Viewer,
    /// Cookies; neither on the server's own computer.
    pub(super) session: Option<String>,
    pub(super) key: Option<String>,
}

impl Shown {
    /// Returns how it is known.
    pub(super) fn by(&self) -> &'static str {
        match (&self.session, &self.key) {
            (Some(_), _) => "password",
            (None, Some(_)) => "key",
            (None, None) => "here",
        }
    }
}

impl Access {
    /// Reads the keys, and makes those that are missing for `vehicles`.
    ///
    /// # Errors
    /// Keys that cannot be used ([`PageKeys::keep`]).
    pub fn new(
        folder: &KeysFolder,
        vehicles: &[&str],
        login: Login,
        logins: Arc<Logins>,
    ) -> Result<Self, KeyError> {
        Ok(Self { keys: PageKeys::keep(folder, vehicles)?, login, folder: folder.clone(), logins })
    }

    /// Returns the page's keys.
    pub fn keys(&self) -> &PageKeys {
        &self.keys
    }

    /// Returns whom a key lets in; `None` if it is wrong.
    pub(super) fn viewer_of(&self, key: &str) -> Option<&Viewer> {
        self.keys.viewer(key)
    }

    /// Returns who asks; `None` for a stranger.
    pub(super) fn judge(&self, from: IpAddr, headers: &HeaderMap) -> Option<Shown> {
        if let Some(session) = cookie(headers, SESSION) {
            let password = self.folder.stamp(password::FILE);
            if lock(&self.logins.sessions).is_live(Instant::now(), password, session) {
                let session = Some(session.to_owned());
                return Some(Shown { viewer: Viewer::Instructor, session, key: None });
            }
        }
        // The instructor's first: whoever has it loses nothing by a team's.
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

    /// Whether what was shown still counts: a session may have ended meanwhile.
    pub(super) fn holds(&self, shown: &Shown) -> bool {
        shown.session.as_ref().is_none_or(|session| {
            let password = self.folder.stamp(password::FILE);
            lock(&self.logins.sessions).is_live(Instant::now(), password, session)
        })
    }

    /// Returns the token that goes with what was shown; `None` if none is needed.
    pub(super) fn token(&self, shown: &Shown) -> Option<String> {
        let cookie = shown.session.as_ref().or(shown.key.as_ref())?;
        Some(self.logins.tokens.of(cookie))
    }

    /// Whether the request bears the token that goes with what was shown.
    pub(super) fn has_token(&self, shown: &Shown, headers: &HeaderMap) -> bool {
        let Some(cookie) = shown.session.as_ref().or(shown.key.as_ref()) else { return true };
        let token = headers.get(TOKEN).and_then(|token| token.to_str().ok());
        token.is_some_and(|token| self.logins.tokens.fits(cookie, token))
    }
}

/// Returns the line that sets a cookie: out of reach of scripts, and never sent along by another
/// site's page. `Secure` where the page was opened over TLS, as behind a proxy; what a client says
/// of that is accepted, since it is its own cookie.
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

/// Returns a cookie of the request; of several of the name the first, as nothing is won by another.
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
# Keys of the server's page: whoever has one opens it by http://SERVER/enter?key=KEY. Remove a line and start
# the server again for a new key; all who had the old one are out.
";
/// The cookie of the instructor's key; of a team's, where an earlier version has set it.
pub(super) const KEY: &str = "vizflyt_key";
/// The cookie of a team's key.
pub(super) const TEAM_KEY: &str = "vizflyt_team_key";
/// The cookie of a session; it ends with the browser's.
pub(super) const SESSION: &str = "vizflyt_session";
/// By which a proxy, or our own listener, says that the client speaks TLS.
pub(super) const FORWARDED_PROTO: &str = "x-forwarded-proto";
/// The header that bears the token.
const TOKEN: &str = "x-vizflyt-token";
/// More logins at once are nobody's.
const MAX_WAITING: usize = 8;
/// 80 bits, should somebody write one by hand.
const MIN_KEY: usize = 16;

#[cfg(test)]
#[path = "access/tests.rs"]
mod tests;
