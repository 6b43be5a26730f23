//! Table of all routes: builds the router, and states the right that each request requires. Requests outside the table
//! require the instructor's right, and return 404 or 405.

use std::sync::Arc;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::handler::Handler;
use axum::http::Method;
use axum::middleware;
use axum::routing::{MethodRouter, delete, get, patch, post, put};

use super::api::{
    cameras, crash, environment, lab, leaderboard, login, pairing, pictures, scenes, sensors,
    stats, vehicles, watch,
};
use super::guard::{MAX_BODY, Rights, Rule, Takes, guard};
use super::http::file;
use super::state::Page;

struct Route {
    method: Method,
    path: &'static str,
    rule: Rule,
    handler: MethodRouter<Arc<Page>>,
}

/// Static files: path and text, collected by the build script.
pub(super) const FILES: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/page_files.rs"));

/// Returns path and content type of a static file.
fn served(file: &'static str) -> (&'static str, &'static str) {
    let kind = match file.rsplit_once('.').map_or("", |(_, kind)| kind) {
        "html" => "text/html; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "svg" => "image/svg+xml",
        _ => "text/javascript; charset=utf-8",
    };
    // Addresses of pages have no file extension, because people type them.
    let path = match file {
        "/index.html" => "/",
        "/wall.html" => "/wall",
        "/lab.html" => "/lab",
        other => other,
    };
    (path, kind)
}

fn table() -> Vec<Route> {
    use Takes::{Everything, Key, Nothing, Vehicle};
    let mut routes: Vec<_> = FILES
        .iter()
        .map(|&(name, text)| {
            let (path, kind) = served(name);
            read(path, Nothing, async move || file(kind, text))
        })
        .collect();
    routes.extend([
        read("/enter", Nothing, login::enter),
        read("/api/session", Nothing, login::standing),
        // No token exists before login.
        at_once(Method::POST, "/api/login", Nothing, login::login),
        act(Method::POST, "/api/logout", Key, login::logout),
        read("/api/map", Key, pictures::map),
        // Exact geometry, which a course may withhold from plugins.
        read("/api/shell", Everything, pictures::shell),
        read("/api/splats/{part}", Everything, pictures::splats),
        read("/api/twin", Everything, pictures::draw),
        read("/ws", Vehicle, watch::watch),
        read("/api/stats", Vehicle, stats::get),
        read("/api/vehicles", Key, vehicles::list),
        // The stop button requires no token.
        at_once(Method::POST, "/api/estop", Everything, vehicles::stop_all),
        at_once(Method::POST, "/api/vehicles/{vehicle}/estop", Vehicle, vehicles::stop),
        act(Method::POST, "/api/vehicles/{vehicle}/start", Everything, vehicles::start),
        act(Method::POST, "/api/vehicles/{vehicle}/land", Vehicle, vehicles::land),
        act(Method::POST, "/api/vehicles/{vehicle}/reset", Everything, vehicles::reset),
        read("/api/vehicles/{vehicle}/cameras", Vehicle, cameras::list),
        read("/api/vehicles/{vehicle}/sensors", Vehicle, sensors::list),
        read("/api/vehicles/{vehicle}/sensors/{name}/reading", Vehicle, sensors::reading),
        act(Method::PATCH, "/api/vehicles/{vehicle}/sensors/{name}", Everything, sensors::patch),
        read("/api/vehicles/{vehicle}/crash", Vehicle, crash::show),
        read("/api/vehicles/{vehicle}/crash/{id}/{camera}/{kind}/{number}", Vehicle, crash::image),
        act(Method::PUT, "/api/vehicles/{vehicle}/cameras/{name}", Everything, cameras::put),
        act(Method::PATCH, "/api/vehicles/{vehicle}/cameras/{name}", Everything, cameras::patch),
        read("/api/leaderboard", Key, leaderboard::show),
        // By the team's token: the vehicle's computer has no cookie. The handler checks the rights of others.
        at_once(Method::PUT, "/api/vehicles/{vehicle}/team", Nothing, leaderboard::put),
        act(Method::POST, "/api/vehicles/{vehicle}/team", Everything, leaderboard::assign),
        act(Method::DELETE, "/api/vehicles/{vehicle}/team", Vehicle, leaderboard::check_out),
        read("/api/lab", Key, lab::show),
        read("/api/lab/report.pdf", Everything, lab::report),
        act(Method::POST, "/api/lab/sign", Everything, lab::sign),
        act(Method::POST, "/api/lab/axes", Everything, lab::axes),
        act(Method::POST, "/api/lab/evidence", Everything, lab::evidence),
        // A team may book only its own vehicle; the handler checks that.
        act(Method::POST, "/api/lab/queue", Key, lab::book),
        act(Method::DELETE, "/api/lab/queue/{id}", Key, lab::withdraw),
        act(Method::POST, "/api/lab/turn", Everything, lab::turn),
        act(Method::PUT, "/api/lab/formation", Everything, lab::formation),
        act(Method::POST, "/api/lab/begin", Everything, lab::begin),
        read("/api/scenes", Everything, scenes::list),
        act(Method::PUT, "/api/scene", Everything, scenes::change),
        read("/api/environment", Everything, environment::get),
        act(Method::PUT, "/api/environment", Everything, environment::change),
        read("/api/pairing", Everything, pairing::standing),
        act(Method::POST, "/api/pairing", Everything, pairing::open),
        act(Method::DELETE, "/api/pairing", Everything, pairing::shut),
    ]);
    routes
}

/// Returns a route that reads.
fn read<H, T>(path: &'static str, takes: Takes, handler: H) -> Route
where
    H: Handler<T, Arc<Page>>,
    T: 'static,
{
    at_once(Method::GET, path, takes, handler)
}

/// Returns a route that changes something.
fn act<H, T>(method: Method, path: &'static str, takes: Takes, handler: H) -> Route
where
    H: Handler<T, Arc<Page>>,
    T: 'static,
{
    Route { rule: Rule { takes, token: true }, ..at_once(method, path, takes, handler) }
}

/// Returns a route that requires no token.
fn at_once<H, T>(method: Method, path: &'static str, takes: Takes, handler: H) -> Route
where
    H: Handler<T, Arc<Page>>,
    T: 'static,
{
    let handler = match method {
        Method::POST => post(handler),
        Method::PUT => put(handler),
        Method::PATCH => patch(handler),
        Method::DELETE => delete(handler),
        _ => get(handler),
    };
    Route { method, path, rule: Rule { takes, token: false }, handler }
}

pub(super) fn router(page: Arc<Page>) -> Router {
    let table = table();
    let rights =
        Rights::of_routes(table.iter().map(|route| (route.method.clone(), route.path, route.rule)));
    let mut router = Router::new();
    for Route { path, handler, .. } in table {
        router = router.route(path, handler);
    }
    router
        // Also before unknown routes: strangers must not learn which ones exist.
        .layer(middleware::from_fn_with_state((page.clone(), Arc::new(rights)), guard))
        .layer(DefaultBodyLimit::max(MAX_BODY))
        .with_state(page)
}

/// Returns method, path and required right of every route.
pub fn list() -> Vec<(String, &'static str, Takes)> {
    let line = |route: Route| (route.method.to_string(), route.path, route.rule.takes);
    table().into_iter().map(line).collect()
}
