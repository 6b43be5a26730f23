//! What the page's handlers share.

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

/// The server's rooms, and what the page adds to them.
#[derive(Debug)]
pub(crate) struct Page {
    pub(crate) rooms: Rooms,
    pub(crate) previews: Arc<Previews>,
    pub(crate) top_view: TopView,
    pub(crate) twin: TwinParts,
    pub(crate) twin_pictures: TwinPictures,
    /// The course's gates, for the top view.
    pub(crate) stages: Vec<StageConfig>,
    /// When the server started; differs from start to start, so that a page notices a new server.
    pub(crate) boot: ServerTime,
    pub(crate) rates: Rates,
    /// The lab day.
    pub(crate) lab: Arc<Lab>,
    /// Who may see and do what.
    pub(crate) access: Arc<Access>,
    /// Who may connect, and pairing.
    pub(crate) authorizer: Arc<Authorizer>,
    /// Where runtimes connect.
    pub(crate) quic_port: u16,
    /// Rate limiter for invalid team tokens.
    pub(crate) team_tries: Mutex<RateLimiter>,
    /// The scenes to choose from.
    pub(crate) scenes: Arc<Scenes>,
    /// Who watches, by WebSocket.
    pub(crate) watchers: Mutex<Watchers>,
}

/// Returns the vehicle of this name, or the answer that there is none.
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
