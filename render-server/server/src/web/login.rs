//! The instructor's password: set by `vizflyt password`, asked for by `POST /api/login`.
//!
//! The file holds its Argon2id hash alone and is read at each login, so that a new password counts
//! at once (and ends every session). A try takes some 20 ms and 19 MiB on purpose; one is checked
//! at a time, few wait, and an address has ten tries, then one in three seconds.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use argon2::password_hash::phc::PasswordHash;
use argon2::{Argon2, Params, PasswordHasher, PasswordVerifier};
use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{ConnectInfo, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use ring::rand::{SecureRandom, SystemRandom};
use serde::{Deserialize, Serialize};
use tracing::warn;
use vizflyt_trust::{KeyError, KeysFolder};

use super::access::{self, Shown, Viewer};
use super::{Page, origin, refuse};
use crate::lock::lock;

/// Name of the password's file in the keys folder.
pub(super) const FILE: &str = "page-login.toml";

/// `page-login.toml`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct LoginFile {
    /// In PHC's string format: `$argon2id$v=19$m=19456,t=2,p=1$...`.
    password: String,
}

/// Sets the instructor's password of the server that uses `folder`; a running one takes it at once.
///
/// # Errors
/// A password too short or too long; a folder that cannot be written.
pub fn set_password(folder: &KeysFolder, password: &str) -> Result<(), KeyError> {
    let damaged = |what: String| KeyError::Damaged { path: folder.file(FILE), what };
    let length = password.chars().count();
    if length < MIN_LETTERS || password.len() > MAX_BYTES {
        return Err(damaged(format!(
            "a password has {MIN_LETTERS} letters at least and {MAX_BYTES} bytes at most, not \
             {length} letters; take four words that nobody else puts together"
        )));
    }
    let mut salt = [0; 16];
    SystemRandom::new()
        .fill(&mut salt)
        .map_err(|_| damaged("the system gives no random numbers".to_owned()))?;
    let hash = Argon2::default()
        .hash_password_with_salt(password.as_bytes(), &salt)
        .map_err(|error| damaged(error.to_string()))?;
    let file = LoginFile { password: hash.to_string() };
    let text = toml::to_string(&file).map_err(|error| damaged(error.to_string()))?;
    folder.write(FILE, &(HEAD.to_owned() + &text))
}

/// Returns the hash of the password; `None` if none is set.
fn read(folder: &KeysFolder) -> Result<Option<PasswordHash>, KeyError> {
    let damaged = |what: String| KeyError::Damaged {
        path: folder.file(FILE),
        what: format!("{what}; set a new password: vizflyt password"),
    };
    let Some(text) = folder.read_secret(FILE)? else { return Ok(None) };
    let file: LoginFile = toml::from_str(&text).map_err(|error| damaged(error.to_string()))?;
    let hash = PasswordHash::new(&file.password)
        .map_err(|error| damaged(format!("password is no Argon2 hash: {error}")))?;
    let params = Params::try_from(&hash).map_err(|error| damaged(error.to_string()))?;
    if params.m_cost() > MAX_KIB || params.t_cost() > MAX_PASSES {
        return Err(damaged(format!("a hash of {} KiB is refused", params.m_cost())));
    }
    Ok(Some(hash))
}

/// The session as the page receives it.
#[derive(Debug, Serialize)]
struct Standing<'a> {
    /// `instructor`, `team`, or nothing.
    role: Option<&'a str>,
    /// The team's vehicle.
    vehicle: Option<&'a str>,
    /// How it is known: `password`, `key`, or `here`, on the server's own computer.
    by: Option<&'a str>,
    /// What every request that changes something shows in `X-VizFlyt-Token`; none is needed `here`.
    token: Option<String>,
    /// Whether there is a password to log in with.
    password: bool,
}

/// `GET /api/session`: who the server takes the viewer for.
pub(super) async fn standing(
    State(page): State<Arc<Page>>,
    ConnectInfo(from): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
) -> Response {
    if let Err(refusal) = origin::check_host(&headers) {
        return refuse(&refusal);
    }
    respond(&page, page.access.judge(from.ip(), &headers).as_ref())
}

fn respond(page: &Page, shown: Option<&Shown>) -> Response {
    let standing = Standing {
        role: shown.map(|shown| match shown.viewer {
            Viewer::Instructor => "instructor",
            Viewer::Team(_) => "team",
        }),
        vehicle: shown.and_then(|shown| match &shown.viewer {
            Viewer::Team(name) => Some(name.as_str()),
            Viewer::Instructor => None,
        }),
        by: shown.map(Shown::by),
        token: shown.and_then(|shown| page.access.token(shown)),
        password: page.access.folder.stamp(FILE).is_some(),
    };
    let mut response = Json(standing).into_response();
    no_store(&mut response);
    response
}

fn no_store(response: &mut Response) {
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Attempt {
    password: String,
}

/// `POST /api/login`: exchanges the password for a session.
pub(super) async fn login(
    State(page): State<Arc<Page>>,
    ConnectInfo(from): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    let body = match body {
        Ok(body) => body,
        Err(rejection) => return rejection.into_response(),
    };
    {
        let (mut limiter, now) = (lock(&page.access.logins.limiter), Instant::now());
        if !limiter.may_try(now, from.ip()) {
            let mut response = (StatusCode::TOO_MANY_REQUESTS, TOO_MANY).into_response();
            response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from_static("3"));
            return response;
        }
        limiter.charge(now, from.ip());
    }
    let Ok(attempt) = serde_json::from_slice::<Attempt>(&body) else {
        return (StatusCode::BAD_REQUEST, "send {\"password\": \"...\"}").into_response();
    };
    if attempt.password.len() > MAX_BYTES {
        return (StatusCode::UNAUTHORIZED, WRONG).into_response();
    }
    // Few wait: whoever tries in numbers must not hold up memory or the processor.
    let Ok(_queue) = page.access.logins.queue.try_acquire() else {
        return (StatusCode::SERVICE_UNAVAILABLE, TOO_MANY).into_response();
    };
    let Ok(_turn) = page.access.logins.turn.acquire().await else {
        return StatusCode::SERVICE_UNAVAILABLE.into_response();
    };
    let folder = page.access.folder.clone();
    let checked = tokio::task::spawn_blocking(move || {
        let stamp = folder.stamp(FILE);
        let hash = read(&folder)?;
        let fits = hash.map(|hash| {
            Argon2::default().verify_password(attempt.password.as_bytes(), &hash).is_ok()
        });
        Ok::<_, KeyError>((fits, stamp))
    });
    let (fits, stamp) = match checked.await {
        Ok(Ok(checked)) => checked,
        Ok(Err(error)) => {
            warn!("page: {error}");
            return (StatusCode::INTERNAL_SERVER_ERROR, "the server's log has the reason")
                .into_response();
        }
        Err(_) => return StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    };
    match fits {
        None => (StatusCode::CONFLICT, NO_PASSWORD).into_response(),
        Some(false) => {
            warn!("page: a wrong password from {}", from.ip());
            (StatusCode::UNAUTHORIZED, WRONG).into_response()
        }
        Some(true) => {
            let cookie = match lock(&page.access.logins.sessions).begin(Instant::now(), stamp) {
                Ok(cookie) => cookie,
                Err(error) => return (StatusCode::INTERNAL_SERVER_ERROR, error).into_response(),
            };
            let set = access::cookie_line(access::SESSION, &cookie, None, &headers);
            let shown = Shown { viewer: Viewer::Instructor, session: Some(cookie), key: None };
            let mut response = respond(&page, Some(&shown));
            if let Ok(value) = HeaderValue::from_str(&set) {
                response.headers_mut().append(header::SET_COOKIE, value);
            }
            response
        }
    }
}

/// `POST /api/logout`: ends the session, and takes the key out of the browser too.
pub(super) async fn logout(State(page): State<Arc<Page>>, headers: HeaderMap) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    if let Some(cookie) = access::cookie(&headers, access::SESSION) {
        lock(&page.access.logins.sessions).end(cookie);
    }
    let mut response = StatusCode::NO_CONTENT.into_response();
    for name in [access::SESSION, access::KEY, access::TEAM_KEY] {
        if let Ok(value) = HeaderValue::from_str(&access::cookie_line(name, "", Some(0), &headers))
        {
            response.headers_mut().append(header::SET_COOKIE, value);
        }
    }
    no_store(&mut response);
    response
}

const HEAD: &str = "\
# The instructor's password for the server's page, hashed. Set another with `vizflyt password`; remove this file
# to let nobody log in by password.
";
const WRONG: &str = "this is not the password";
const NO_PASSWORD: &str =
    "no password is set; on the server's computer run `vizflyt password`, then log in";
const TOO_MANY: &str = "too many tries; wait some seconds, then try again";
/// NIST SP 800-63B-4, section 3.1.1.2: 15 where a password stands alone; a lab's lies behind its own
/// network, and tries are limited.
const MIN_LETTERS: usize = 10;
/// More is no password. [bytes]
const MAX_BYTES: usize = 256;
/// A quarter of a GiB: more is a slip of the hand. [KiB]
const MAX_KIB: u32 = 256 << 10;
const MAX_PASSES: u32 = 32;

#[cfg(test)]
pub(super) fn examples() -> Vec<serde_json::Value> {
    let full = Standing {
        role: Some("instructor"),
        vehicle: Some("vizflyt"),
        by: Some("password"),
        token: Some("f00d".to_owned()),
        password: true,
    };
    let sparse = Standing { role: None, vehicle: None, by: None, token: None, password: false };
    vec![serde_json::json!(full), serde_json::json!(sparse)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_password_is_kept_as_its_hash_and_checked_by_it() {
        let root = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        assert!(read(&folder).unwrap().is_none());
        for wrong in ["", "short", &"x".repeat(MAX_BYTES + 1)] {
            let error = set_password(&folder, wrong).unwrap_err().to_string();
            assert!(error.contains("10 letters at least"), "{error}");
        }
        set_password(&folder, "correct horse battery").unwrap();
        let text = folder.read_secret(FILE).unwrap().unwrap();
        assert!(text.contains("$argon2id$v=19$m=19456,t=2,p=1$") && !text.contains("horse"));
        let hash = read(&folder).unwrap().unwrap();
        let fits =
            |password: &str| Argon2::default().verify_password(password.as_bytes(), &hash).is_ok();
        assert!(fits("correct horse battery") && !fits("correct horse batterY") && !fits(""));
        // Another time, another salt.
        set_password(&folder, "correct horse battery").unwrap();
        assert_ne!(folder.read_secret(FILE).unwrap().unwrap(), text);
    }

    #[test]
    fn a_damaged_file_is_an_error_and_lets_nobody_in() {
        let root = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        for (text, expected) in [
            ("", "missing field"),
            ("password = \"open\"", "no Argon2 hash"),
            ("password = \"x\"\nuser = 1", "unknown field"),
            (
                "password = \"$argon2id$v=19$m=4194304,t=2,p=1$c2FsdHNhbHRzYWx0$aGFzaGhhc2hoYXNoaGFzaA\"",
                "4194304 KiB is refused",
            ),
        ] {
            folder.write(FILE, text).unwrap();
            let error = read(&folder).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
