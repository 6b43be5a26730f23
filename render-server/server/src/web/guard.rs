//! Rights that each route requires, and the check of every request before its route.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::body::{HttpBody, to_bytes};
use axum::extract::{ConnectInfo, MatchedPath, Request, State};
use axum::http::{Method, StatusCode, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tokio::time::timeout;

use super::access::{NO_KEY, Viewer};
use super::http::refuse;
use super::listener::ConnectionPlace;
use super::origin;
use super::percent::decoded;
use super::state::Page;

/// Right that a route requires.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Takes {
    /// No right: static files, which contain no secret.
    Nothing,
    /// Any key or login.
    Key,
    /// The right to a vehicle: `{vehicle}` of the path, otherwise `vehicle` of the query.
    Vehicle,
    /// The right to all vehicles: instructor only.
    Everything,
}

/// Right that one request requires.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Need {
    Nothing,
    Key,
    /// The right to this vehicle.
    Vehicle(String),
    Everything,
}

impl Need {
    /// Returns the right that a request requires. `path` is the route's template, with `{vehicle}` for a name.
    fn of(takes: Takes, path: &str, uri: &Uri) -> Self {
        match takes {
            Takes::Nothing => Self::Nothing,
            Takes::Key => Self::Key,
            Takes::Everything => Self::Everything,
            Takes::Vehicle => {
                let name = match path.split('/').position(|part| part == "{vehicle}") {
                    Some(at) => uri.path().split('/').nth(at).and_then(decoded),
                    None => asked(uri),
                };
                name.map_or(Self::Everything, Self::Vehicle)
            }
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

/// Requirements of a route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Rule {
    pub(super) takes: Takes,
    /// Whether the request must have the token of the viewer's cookie.
    pub(super) token: bool,
}

/// Requirements of all routes.
#[derive(Debug)]
pub(super) struct Rights(HashMap<(Method, &'static str), Rule>);

impl Rights {
    /// Collects method, path and requirements of every route.
    pub(super) fn of_routes(routes: impl Iterator<Item = (Method, &'static str, Rule)>) -> Self {
        Self(routes.map(|(method, path, rule)| ((method, path), rule)).collect())
    }

    /// Returns the requirements of the route `path`; the strictest if it is not in the table.
    pub(super) fn of(&self, method: &Method, path: &str) -> Rule {
        let known = self.0.iter().find(|((m, p), _)| m == method && *p == path);
        known.map_or(Rule::STRICTEST, |(_, rule)| *rule)
    }
}

/// Passes a request on to its route, or rejects it.
pub(super) async fn guard(
    State((page, rights)): State<(Arc<Page>, Arc<Rights>)>,
    ConnectInfo(from): ConnectInfo<SocketAddr>,
    mut request: Request,
    next: Next,
) -> Response {
    // The connection is older than this scene: close it, so that the browser's next one reaches the new scene.
    if page.rooms.stop.is_set() {
        let close = [(header::CONNECTION, "close")];
        return (StatusCode::SERVICE_UNAVAILABLE, close, "the server ends or changes its scene")
            .into_response();
    }
    let path = request.extensions().get::<MatchedPath>().map_or("", MatchedPath::as_str);
    let method = if request.method() == Method::HEAD { &Method::GET } else { request.method() };
    let rule = rights.of(method, path);
    let need = Need::of(rule.takes, path, request.uri());
    if need == Need::Nothing {
        return run(request, None, next).await;
    }
    // Also for reading: a foreign name that resolves to this address (DNS rebinding) would count as loopback.
    if let Err(refusal) = origin::check_host(request.headers()) {
        return refuse(&refusal);
    }
    match page.access.judge(from.ip(), request.headers()) {
        Some(shown) if !need.is_met_by(&shown.viewer) => {
            (StatusCode::FORBIDDEN, "this key is for another vehicle").into_response()
        }
        Some(shown) if rule.token && !page.access.has_token(&shown, request.headers()) => {
            (StatusCode::FORBIDDEN, NO_TOKEN).into_response()
        }
        Some(shown) => {
            let viewer = shown.viewer.clone();
            request.extensions_mut().insert(viewer.clone());
            request.extensions_mut().insert(shown);
            run(request, Some(&viewer), next).await
        }
        None => (StatusCode::UNAUTHORIZED, NO_KEY).into_response(),
    }
}

/// Reads the body of a request and calls its route. Until the body has arrived, the connection counts as waiting, so
/// that a slow client does not block others.
async fn run(request: Request, viewer: Option<&Viewer>, next: Next) -> Response {
    let place = request.extensions().get::<ConnectionPlace>().cloned();
    let (parts, mut body) = request.into_parts();
    if !body.is_end_stream() {
        body = match timeout(BODY_WITHIN, to_bytes(body, MAX_BODY)).await {
            Ok(Ok(bytes)) => bytes.into(),
            // The body is too long, or the client has closed the connection and does not read the answer.
            Ok(Err(_)) => return (StatusCode::PAYLOAD_TOO_LARGE, TOO_LARGE).into_response(),
            Err(_) => {
                let close = [(header::CONNECTION, "close")];
                return (StatusCode::REQUEST_TIMEOUT, close, TOO_SLOW).into_response();
            }
        };
    }
    if let Some(place) = &place {
        place.serve(viewer);
    }
    let response = next.run(Request::from_parts(parts, body)).await;
    if let Some(place) = &place {
        place.wait();
    }
    response
}

impl Rule {
    /// Default: instructor only, with token.
    pub(super) const STRICTEST: Self = Self { takes: Takes::Everything, token: true };
}

/// Returns the vehicle of the query; `None` without one, or with several.
fn asked(uri: &Uri) -> Option<String> {
    let pairs = uri.query()?.split('&').map(|pair| pair.split_once('=').unwrap_or((pair, "")));
    // The route might decode an encoded key to `vehicle`: reject it.
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

const NO_TOKEN: &str = "the X-VizFlyt-Token header is missing or not yours; GET /api/session has it, or reload the page";
const TOO_LARGE: &str = "length limit: a request has 16 KB at most";
const TOO_SLOW: &str = "the request's body did not come within 5 s";
/// The settings of a camera take some hundred bytes. [bytes]
pub(super) const MAX_BODY: usize = 16 << 10;
/// Enough for a body of a few packets over a bad link.
const BODY_WITHIN: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::web::percent::encoded;

    fn vehicle(name: &str) -> Need {
        Need::Vehicle(name.to_owned())
    }

    #[test]
    fn vehicle_is_the_one_named_by_path_or_query() {
        let need = |path: &str, uri: &str| Need::of(Takes::Vehicle, path, &uri.parse().unwrap());
        for uri in ["/ws?vehicle=ant", "/ws?x=1&vehicle=ant", "/ws?vehicle=%61nt"] {
            assert_eq!(need("/ws", uri), vehicle("ant"), "{uri}");
        }
        for uri in ["/api/vehicles/ant/estop", "/api/vehicles/%61nt/estop?vehicle=bee"] {
            assert_eq!(need("/api/vehicles/{vehicle}/estop", uri), vehicle("ant"), "{uri}");
        }
        for uri in [
            "/ws",
            "/ws?vehicle=ant&vehicle=bee",
            "/ws?vehicle=ant&%76ehicle=bee",
            "/ws?vehicle=%6",
        ] {
            assert_eq!(need("/ws", uri), Need::Everything, "{uri}");
        }
        assert_eq!(
            need("/api/vehicles/{vehicle}/estop", "/api/vehicles/%6/estop"),
            Need::Everything
        );
    }

    #[test]
    fn a_team_has_only_the_right_to_its_own_vehicle() {
        let team = Viewer::Team("ant".to_owned());
        for (need, expected) in [
            (Need::Nothing, true),
            (Need::Key, true),
            (vehicle("ant"), true),
            (vehicle("bee"), false),
            (vehicle(""), false),
            (Need::Everything, false),
        ] {
            assert_eq!(need.is_met_by(&team), expected, "{need:?}");
            assert!(need.is_met_by(&Viewer::Instructor), "{need:?}");
        }
    }

    proptest::proptest! {
        /// A malformed address does not panic.
        #[test]
        fn any_query_is_parsed(text in "[ -~]{0,80}") {
            if let Ok(uri) = format!("/ws?{}", encoded(&text).replace("%3D", "=")).parse::<Uri>() {
                let _ = asked(&uri);
            }
        }
    }
}
