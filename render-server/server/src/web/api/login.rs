//! `/enter`, `/api/login`, `/api/logout`, `/api/session`: identification of the viewer, and its begin and end.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use argon2::{Argon2, PasswordVerifier};
use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{ConnectInfo, Query, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use tracing::warn;
use vizflyt_trust::KeyError;

use crate::web::access::{self, KEY, NO_KEY, Shown, TEAM_KEY, Viewer, cookie_line};
use crate::web::http::refuse;
use crate::web::origin;
use crate::web::password::{FILE, MAX_BYTES, read};
use crate::web::percent::encoded;
use crate::web::state::Page;
use vizflyt_process::lock;

#[derive(Debug, Deserialize)]
pub(in crate::web) struct Entering {
    #[serde(default)]
    key: String,
}

/// Exchanges a key for a cookie. Any site can send a browser to this address, so the browser keeps its rights: a wrong
/// key changes nothing, and a team's key is stored in another cookie than the instructor's.
pub(in crate::web) async fn enter(
    State(page): State<Arc<Page>>,
    Query(entering): Query<Entering>,
    headers: HeaderMap,
) -> Response {
    if let Err(refusal) = origin::check_navigation(&headers) {
        return refuse(&refusal);
    }
    let (name, to) = match page.access.viewer_of(&entering.key) {
        Some(Viewer::Instructor) => (KEY, "/".to_owned()),
        Some(Viewer::Team(name)) => (TEAM_KEY, format!("/?vehicle={}", encoded(name))),
        None => {
            warn!("page: a request to /enter had a wrong key");
            let no_store = [(header::CACHE_CONTROL, "no-store")];
            return (StatusCode::UNAUTHORIZED, no_store, NO_KEY).into_response();
        }
    };
    let cookie = cookie_line(name, &entering.key, Some(COOKIE_S), &headers);
    let mut response = StatusCode::SEE_OTHER.into_response();
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

#[derive(Debug, Serialize)]
struct Standing<'a> {
    /// `instructor`, `team`, or nothing.
    role: Option<&'a str>,
    /// Vehicle of the team.
    vehicle: Option<&'a str>,
    /// Identification: `password`, `key`, or `here` on the server's own computer.
    by: Option<&'a str>,
    /// Token that every request that changes something sends in `X-VizFlyt-Token`; not required for `here`.
    token: Option<String>,
    /// Whether a password is set.
    password: bool,
}

/// `GET /api/session`: role of the viewer.
pub(in crate::web) async fn standing(
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
pub(in crate::web) async fn login(
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
    // The queue is short: an attack must not use up memory or processor.
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

/// `POST /api/logout`: ends the session, and deletes the browser's key.
pub(in crate::web) async fn logout(State(page): State<Arc<Page>>, headers: HeaderMap) -> Response {
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

/// Lifetime of a key's cookie: one semester. [s]
const COOKIE_S: u32 = 180 * 24 * 3600;
const WRONG: &str = "this is not the password";
const NO_PASSWORD: &str =
    "no password is set; on the server's computer run `vizflyt password`, then log in";
const TOO_MANY: &str = "too many tries; wait some seconds, then try again";

#[cfg(test)]
pub(in crate::web) fn examples() -> Vec<serde_json::Value> {
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
