//! One open page: its WebSocket, from the welcome to the end.

use std::sync::Arc;
use std::time::Duration;

use axum::body::Bytes;
use axum::extract::ws::{Message as Frame, WebSocket};
use serde::Serialize;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::debug;

use super::access::Shown;
use super::{Page, messages};
use crate::flights::recent_previews::Preview;
use crate::flights::vehicle::VehicleFlight;
use crate::lock::lock;

/// Counts a viewer for as long as it lives.
struct Presence<'a>(&'a Page, usize);

impl<'a> Presence<'a> {
    fn new(page: &'a Page, vehicle: &VehicleFlight) -> Self {
        page.rooms.streaming.subscriptions.viewer_came(vehicle.index);
        Self(page, vehicle.index)
    }
}

impl Drop for Presence<'_> {
    fn drop(&mut self) {
        self.0.rooms.streaming.subscriptions.viewer_left(self.1);
    }
}

/// Sends one viewer everything of a vehicle until it leaves, stalls, or the server stops.
pub(super) async fn run(
    page: Arc<Page>,
    vehicle: Arc<VehicleFlight>,
    shown: Shown,
    mut socket: WebSocket,
) {
    if page.rooms.streaming.subscriptions.viewers() >= MAX_VIEWERS {
        debug!("page: {MAX_VIEWERS} viewers already");
        return;
    }
    let presence = Presence::new(&page, &vehicle);
    tokio::select! {
        _ = send_all(&page, &vehicle, &mut socket) => {}
        () = right_ends(&page, &shown) => {}
        () = page.rooms.stop.wait() => {}
    }
    drop(presence);
    let _ = timeout(Duration::from_millis(200), socket.send(Frame::Close(None))).await;
}

/// Completes when the viewer is logged out.
async fn right_ends(page: &Page, shown: &Shown) {
    let mut look = interval(LOOK_EVERY);
    while page.access.holds(shown) {
        look.tick().await;
    }
}

/// Returns `None` when the viewer is gone.
async fn send_all(page: &Page, vehicle: &VehicleFlight, socket: &mut WebSocket) -> Option<()> {
    let mut log = vehicle.events.subscribe();
    let mut cameras = page.rooms.rendering.cameras[vehicle.index].subscribe();
    let (entries, mut cursor) = vehicle.events.newest(HISTORY);
    send_json(socket, &messages::arena(page, vehicle)).await?;
    let points = lock(&vehicle.track).points.clone();
    send_json(socket, &messages::Message::Track { points: &points }).await?;
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
                send_json(socket, &messages::state(page, vehicle)).await?;
                // Polled with the state rather than awaited: one picture per turn at most, and
                // whatever was drawn meanwhile is skipped.
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

/// Binary message: kind (0 colour, 1 depth, 2 objects), camera, then JPEG.
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

/// Who is logged out sees no more after this long.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// 20 Hz: smooth to the eye.
const EVERY: Duration = Duration::from_millis(50);
/// A viewer that takes nothing for this long is gone.
const PATIENCE: Duration = Duration::from_secs(5);
/// Events shown to a page that opens late.
const HISTORY: usize = 200;
/// A lecture hall; each costs some 3 Mbit/s.
const MAX_VIEWERS: u32 = 64;
