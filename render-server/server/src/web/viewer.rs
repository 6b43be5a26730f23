//! One open page: its WebSocket, from the first message to the end.

use std::sync::Arc;
use std::time::Duration;

use axum::body::Bytes;
use axum::extract::ws::{CloseFrame, Message as Frame, WebSocket, close_code};
use serde::Serialize;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::debug;

use super::access::{Shown, Viewer};
use super::messages;
use super::state::Page;
use crate::flights::recent_previews::Preview;
use crate::flights::vehicle::VehicleFlight;
use vizflyt_process::lock;

/// Counts a viewer while it exists.
struct Presence<'a> {
    page: &'a Page,
    vehicle: usize,
    viewer: &'a Viewer,
}

impl<'a> Presence<'a> {
    /// Counts a viewer that has entered.
    fn new(page: &'a Page, vehicle: &VehicleFlight, viewer: &'a Viewer) -> Self {
        page.rooms.streaming.subscriptions.viewer_came(vehicle.index);
        Self { page, vehicle: vehicle.index, viewer }
    }
}

impl Drop for Presence<'_> {
    fn drop(&mut self) {
        self.page.rooms.streaming.subscriptions.viewer_left(self.vehicle);
        lock(&self.page.watchers).leave(self.viewer);
    }
}

/// Sends one viewer all data of a vehicle until it leaves, stalls, or the server stops; then sends the reason.
pub(super) async fn run(
    page: Arc<Page>,
    vehicle: Arc<VehicleFlight>,
    shown: Shown,
    mut socket: WebSocket,
) {
    let entered = lock(&page.watchers).enter(&shown.viewer);
    let (code, reason) = if let Err(full) = entered {
        (close_code::AGAIN, full)
    } else {
        let presence = Presence::new(&page, &vehicle, &shown.viewer);
        let ending = tokio::select! {
            _ = send_all(&page, &vehicle, &shown.viewer, &mut socket) => (close_code::NORMAL, "the page closed, or read nothing for 5 s"),
            () = right_ends(&page, &shown) => (close_code::POLICY, "logged out"),
            () = page.rooms.stop.wait() => (close_code::RESTART, "the server ends or changes its scene"),
        };
        drop(presence);
        (ending.0, ending.1.to_owned())
    };
    debug!("page: a viewer of {} leaves: {reason}", vehicle.name);
    let close = Frame::Close(Some(CloseFrame { code, reason: reason.into() }));
    let _ = timeout(Duration::from_millis(200), socket.send(close)).await;
}

/// Completes when the viewer is logged out.
async fn right_ends(page: &Page, shown: &Shown) {
    let mut look = interval(LOOK_EVERY);
    while page.access.holds(shown) {
        look.tick().await;
    }
}

/// Returns `None` when the viewer is gone.
async fn send_all(
    page: &Page,
    vehicle: &VehicleFlight,
    viewer: &Viewer,
    socket: &mut WebSocket,
) -> Option<()> {
    let mut log = vehicle.events.subscribe();
    let mut cameras = page.rooms.rendering.cameras[vehicle.index].subscribe();
    let (entries, mut cursor) = vehicle.events.newest(HISTORY);
    send_json(socket, &messages::arena(page, vehicle)).await?;
    let vehicles = page.rooms.flights.vehicles.iter().map(|vehicle| &**vehicle);
    let others =
        vehicles.filter(|other| other.index != vehicle.index && viewer.may_see(&other.name));
    for flown in std::iter::once(vehicle).chain(others) {
        let points = lock(&flown.track).points.clone();
        let track = messages::Message::Track { vehicle: &flown.name, points: &points };
        send_json(socket, &track).await?;
    }
    send_json(socket, &messages::events(page, entries)).await?;
    let mut previews = page.previews.subscribe(vehicle.index);
    for preview in &mut previews {
        preview.mark_changed();
    }
    log.mark_changed();
    let mut tick = interval(EVERY);
    tick.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        tokio::select! {
            received = socket.recv() => match received {
                Some(Ok(Frame::Close(_)) | Err(_)) | None => return None,
                Some(Ok(_)) => {}
            },
            _ = log.changed() => {
                log.mark_unchanged();
                let entries = match vehicle.events.read(&mut cursor) {
                    Ok(entries) => entries,
                    Err(lagged) => {
                        cursor = lagged.oldest;
                        continue;
                    }
                };
                if !entries.is_empty() {
                    send_json(socket, &messages::events(page, entries)).await?;
                }
            }
            _ = cameras.changed() => {
                let newest = cameras.borrow_and_update().clone();
                send_json(socket, &messages::cameras(&newest)).await?;
            }
            _ = tick.tick() => {
                send_json(socket, &messages::state(page, vehicle, viewer)).await?;
                // Polled with the state, not awaited: at most one image per tick; images rendered in between are
                // skipped.
                for (index, preview) in previews.iter_mut().enumerate() {
                    if !preview.has_changed().unwrap_or(false) {
                        continue;
                    }
                    let newest = preview.borrow_and_update().clone();
                    if let Some(newest) = newest {
                        send_preview(socket, index, &newest).await?;
                    }
                }
            }
        }
    }
}

async fn send_json(socket: &mut WebSocket, message: &impl Serialize) -> Option<()> {
    let text = match serde_json::to_string(message) {
        Ok(text) => text,
        Err(error) => {
            debug!("page: message not sent: {error}");
            return Some(());
        }
    };
    send(socket, Frame::Text(text.into())).await
}

/// Sends a binary message: kind (0 colour, 1 depth, 2 objects), camera, then JPEG.
async fn send_preview(socket: &mut WebSocket, camera: usize, preview: &Preview) -> Option<()> {
    for (kind, jpeg) in [(0u8, &preview.colour), (1, &preview.depth), (2, &preview.ids)] {
        if jpeg.is_empty() {
            continue;
        }
        let mut bytes = Vec::with_capacity(2 + jpeg.len());
        bytes.extend_from_slice(&[kind, camera as u8]);
        bytes.extend_from_slice(jpeg);
        send(socket, Frame::Binary(Bytes::from(bytes))).await?;
    }
    Some(())
}

async fn send(socket: &mut WebSocket, frame: Frame) -> Option<()> {
    timeout(PATIENCE, socket.send(frame)).await.ok()?.ok()
}

/// Interval at which the login is checked: maximum delay until a logout takes effect.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// 20 Hz, smooth to the eye.
const EVERY: Duration = Duration::from_millis(50);
/// Timeout of a viewer that reads nothing.
const PATIENCE: Duration = Duration::from_secs(5);
/// Number of past events that a new page receives.
const HISTORY: usize = 200;
