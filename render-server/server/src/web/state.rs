//! Shared state of the page's handlers.

use std::sync::{Arc, Mutex};

use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use vizflyt_arena::config::StageConfig;
use vizflyt_protocol::time::ServerTime;

use super::access::Access;
use super::lab::Lab;
use super::previews::Previews;
use super::rates::Rates;
use super::top_view::TopView;
use super::twin::TwinParts;
use super::twin_picture::TwinPictures;
use super::watchers::Watchers;
use crate::authorization::Authorizer;
use crate::flights::vehicle::VehicleFlight;
use crate::rate_limit::RateLimiter;
use crate::scene::Scenes;
use crate::stream::Rooms;

/// The server's rooms and the page's own state.
#[derive(Debug)]
pub(crate) struct Page {
    pub(crate) rooms: Rooms,
    pub(crate) previews: Arc<Previews>,
    pub(crate) top_view: TopView,
    pub(crate) twin: TwinParts,
    pub(crate) twin_pictures: TwinPictures,
    /// Stages of the course, for the top view.
    pub(crate) stages: Vec<StageConfig>,
    /// Start time of the server. Differs from start to start, so that a page detects a restart.
    pub(crate) boot: ServerTime,
    pub(crate) rates: Rates,
    pub(crate) lab: Arc<Lab>,
    /// Rights of viewers.
    pub(crate) access: Arc<Access>,
    /// Identities of runtimes that may connect, and pairing.
    pub(crate) authorizer: Arc<Authorizer>,
    /// Port to which runtimes connect.
    pub(crate) quic_port: u16,
    /// Rate limiter for invalid team tokens.
    pub(crate) team_tries: Mutex<RateLimiter>,
    /// Available scenes.
    pub(crate) scenes: Arc<Scenes>,
    /// Number of open WebSockets by kind of viewer.
    pub(crate) watchers: Mutex<Watchers>,
}

/// Returns the vehicle of this name, or the response 404.
pub(crate) fn vehicle<'a>(
    page: &'a Page,
    name: &str,
) -> Result<&'a Arc<VehicleFlight>, Box<Response>> {
    let found = page.rooms.flights.vehicles.iter().find(|vehicle| vehicle.name == name);
    found.ok_or_else(|| {
        let names: Vec<_> =
            page.rooms.flights.vehicles.iter().map(|vehicle| &*vehicle.name).collect();
        let text = format!("there is no vehicle '{name}'; there are {}", names.join(", "));
        Box::new((StatusCode::NOT_FOUND, text).into_response())
    })
}
