//! Who may see and do what on the page. Every request passes here before its route.
//!
//! Loopback is the instructor's own computer and needs no key. Everyone else shows one, once, by
//! opening `/enter?key=...`, and has it in a cookie from then on; who shows a key is judged by it,
//! wherever it comes from. The instructor's key opens everything, a vehicle's key that vehicle's
//! page and stop button. A route that nobody thought of is the instructor's.

use std::collections::{BTreeMap, HashMap};
use std::fmt::Write;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use axum::extract::{ConnectInfo, Query, Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use tracing::warn;
use vizflyt_trust::{Fingerprint, KeyError, KeysFolder, secret};

use super::{Page, origin, refuse};

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
            if key.len() < LEAST_KEY || !key.bytes().all(|byte| byte.is_ascii_alphanumeric()) {
                let what = format!(
                    "a key is {LEAST_KEY} letters and digits or more; remove a wrong one and start again for a new one"
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

    /// Returns who asks; `None` for a stranger.
    fn judge(&self, from: IpAddr, headers: &HeaderMap) -> Option<Viewer> {
        match cookie(headers) {
            Some(key) => self.viewer(key).cloned(),
            None => from.to_canonical().is_loopback().then_some(Viewer::Instructor),
        }
    }
}

/// What a request takes.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Need {
    /// Nothing: the page's own files, which hold no secret.
    Nothing,
    /// Any key.
    Key,
    /// This vehicle.
    Vehicle(String),
    /// All vehicles.
    Everything,
}

impl Need {
    fn of(method: &Method, uri: &Uri) -> Self {
        let is_reading = matches!(*method, Method::GET | Method::HEAD);
        let path: Vec<&str> = uri.path().trim_start_matches('/').split('/').collect();
        let vehicle = |name: Option<String>| name.map_or(Self::Everything, Self::Vehicle);
        match *path {
            ["" | "enter"] if is_reading => Self::Nothing,
            // A file: `app.js`.
            [name] if is_reading && name.contains('.') => Self::Nothing,
            ["ws"] | ["api", "stats"] if is_reading => vehicle(asked(uri)),
            ["api", "map" | "vehicles"] if is_reading => Self::Key,
            ["api", "vehicles", name, "cameras"] if is_reading => vehicle(decoded(name)),
            ["api", "vehicles", name, "estop"] if *method == Method::POST => vehicle(decoded(name)),
            _ => Self::Everything,
        }
    }

    fn is_met_by(&self, viewer: &Viewer) -> bool {
        match (self, viewer) {
            (Self::Nothing | Self::Key, _) | (_, Viewer::Instructor) => true,
            (Self::Vehicle(name), viewer) => viewer.may_see(name),
            (Self::Everything, Viewer::Team(_)) => false,
        }
    }
}

/// Lets a request through to its route, or answers it.
pub(super) async fn guard(
    State(page): State<Arc<Page>>,
    ConnectInfo(from): ConnectInfo<SocketAddr>,
    mut request: Request,
    next: Next,
) -> Response {
    let need = Need::of(request.method(), request.uri());
    if need == Need::Nothing {
        return next.run(request).await;
    }
    // Reading too: a stranger's name that resolves to us would read as loopback.
    if let Err(refusal) = origin::check_host(request.headers()) {
        return refuse(&refusal);
    }
    match page.keys.judge(from.ip(), request.headers()) {
        Some(viewer) if need.is_met_by(&viewer) => {
            request.extensions_mut().insert(viewer);
            next.run(request).await
        }
        Some(_) => (StatusCode::FORBIDDEN, "this key is for another vehicle").into_response(),
        None => (StatusCode::UNAUTHORIZED, NO_KEY).into_response(),
    }
}

/// What `/enter` is asked with.
#[derive(Debug, Deserialize)]
pub(super) struct Entering {
    #[serde(default)]
    key: String,
}

/// Exchanges a key for a cookie. A wrong key takes the cookie away: so one can also leave.
pub(super) async fn enter(
    State(page): State<Arc<Page>>,
    Query(entering): Query<Entering>,
) -> Response {
    let (key, status, to) = match page.keys.viewer(&entering.key) {
        Some(Viewer::Instructor) => (entering.key.as_str(), StatusCode::SEE_OTHER, "/".to_owned()),
        Some(Viewer::Team(name)) => {
            (entering.key.as_str(), StatusCode::SEE_OTHER, format!("/?vehicle={}", encoded(name)))
        }
        None => {
            warn!("page: somebody came with a wrong key");
            ("", StatusCode::UNAUTHORIZED, String::new())
        }
    };
    let age_s = if key.is_empty() { 0 } else { COOKIE_S };
    // `Strict`: no other page can send it along. The page is plain HTTP, so no `Secure`.
    let cookie = format!("{COOKIE}={key}; Path=/; Max-Age={age_s}; HttpOnly; SameSite=Strict");
    let mut response = (status, if key.is_empty() { NO_KEY } else { "" }).into_response();
    let headers = response.headers_mut();
    for (name, value) in [(header::SET_COOKIE, cookie), (header::LOCATION, to)] {
        if let Ok(value) = HeaderValue::from_str(&value)
            && !value.is_empty()
        {
            headers.insert(name, value);
        }
    }
    headers.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    response
}

/// Returns the key in the request's cookies; of several the first, as nothing is won by another.
fn cookie(headers: &HeaderMap) -> Option<&str> {
    let lines = headers.get_all(header::COOKIE).iter().filter_map(|line| line.to_str().ok());
    let mut pairs = lines.flat_map(|line| line.split(';')).filter_map(|pair| {
        let (name, value) = pair.trim().split_once('=')?;
        (name == COOKIE).then_some(value)
    });
    pairs.next()
}

/// Returns the one vehicle that the query names; `None` without, or with several.
fn asked(uri: &Uri) -> Option<String> {
    let pairs = uri.query()?.split('&').map(|pair| pair.split_once('=').unwrap_or((pair, "")));
    // A key that needs decoding might be read as `vehicle` by the route: not taken for granted.
    let mut names = None;
    for (key, value) in pairs {
        match key {
            "vehicle" if names.is_none() => names = Some(value),
            key if key == "vehicle" || key.contains('%') => return None,
            _ => {}
        }
    }
    decoded(&names?.replace('+', " "))
}

/// Undoes percent-encoding (RFC 3986, section 2.1); `None` if it is none.
fn decoded(text: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.bytes();
    while let Some(byte) = rest.next() {
        if byte != b'%' {
            bytes.push(byte);
            continue;
        }
        let digit = |byte: Option<u8>| char::from(byte?).to_digit(16);
        bytes.push((digit(rest.next())? * 16 + digit(rest.next())?) as u8);
    }
    String::from_utf8(bytes).ok()
}

fn encoded(text: &str) -> String {
    text.bytes().fold(String::new(), |mut out, byte| {
        if byte.is_ascii_alphanumeric() || b"-._~".contains(&byte) {
            out.push(char::from(byte));
        } else {
            // Why: writing to a String cannot fail.
            let _ = write!(out, "%{byte:02X}");
        }
        out
    })
}

const FILE: &str = "page-keys.toml";
const HEAD: &str = "\
# Keys of the server's page: whoever has one opens it by http://SERVER/enter?key=KEY. Remove a line and start
# the server again for a new key; all who had the old one are out.
";
const COOKIE: &str = "vizflyt_key";
/// A term. [s]
const COOKIE_S: u32 = 180 * 24 * 3600;
const NO_KEY: &str = "this page needs a key: open the address that the instructor gave you, which ends in \
     /enter?key=...; on the server's own computer open the page as http://127.0.0.1";
/// 80 bits, should somebody write one by hand.
const LEAST_KEY: usize = 16;

#[cfg(test)]
#[path = "access/tests.rs"]
mod tests;
