//! The live view: a page with the image of each camera, the detected tags, and the residuals of
//! their corners. It is read-only; bind it to 127.0.0.1 unless the network is trusted.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use vizflyt_process::lock;

use anyhow::{Context, Result};
use axum::Router;
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use glam::DVec2;
use serde_json::{Value, json};
use vizflyt_rgbd::encode_jpeg;
use vizflyt_tags::camera::TagCamera;
use vizflyt_tags::image::Gray;
use vizflyt_tags::locate::{CameraResult, LocateOutcome};

use super::CameraImage;

/// Server of the live view.
pub(super) struct LiveView {
    address: SocketAddr,
    shared: Arc<Mutex<Shown>>,
}

/// Data of the page.
struct Shown {
    cameras: Vec<Camera>,
    pose: Value,
    /// Time of the last request: images are stored only while a browser shows them.
    asked: Option<Instant>,
}

struct Camera {
    name: String,
    size: (u32, u32),
    image: Option<Gray>,
    look: Value,
}

impl LiveView {
    /// Serves the page at an address; port 0 selects a free one.
    pub(super) fn serve(address: SocketAddr, cameras: &[TagCamera]) -> Result<Self> {
        let cameras = cameras.iter().map(|camera| Camera {
            name: camera.name.clone(),
            size: (camera.intrinsics.width_px, camera.intrinsics.height_px),
            image: None,
            look: Value::Null,
        });
        let shown = Shown { cameras: cameras.collect(), pose: Value::Null, asked: None };
        let shared = Arc::new(Mutex::new(shown));
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .context("tags: cannot start the live view")?;
        let listener = runtime
            .block_on(tokio::net::TcpListener::bind(address))
            .with_context(|| format!("tags: cannot serve the live view at {address}"))?;
        let address = listener.local_addr().context("tags: the live view's socket")?;
        let router = Router::new()
            .route("/", get(async || Html(PAGE)))
            .route("/state", get(state))
            .route("/camera/{index}", get(camera))
            .with_state(Arc::clone(&shared));
        std::thread::spawn(move || {
            if let Err(error) = runtime.block_on(async { axum::serve(listener, router).await }) {
                tracing::warn!("the live view ended: {error}");
            }
        });
        Ok(Self { address, shared })
    }

    /// Returns the address of the page.
    pub(super) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Shows a set of images and the result.
    pub(super) fn show(&self, shots: &[CameraImage], outcome: &LocateOutcome, image_ms: f64) {
        let mut shown = lock(&self.shared);
        if shown.asked.is_none_or(|asked| asked.elapsed() > FORGET_AFTER) {
            return;
        }
        for shot in shots {
            shown.cameras[shot.camera].image = Some(shot.image.clone());
        }
        for look in &outcome.looks {
            shown.cameras[look.camera].look = look_json(look);
        }
        shown.pose = match &outcome.located {
            Ok(located) => json!({
                "position_m": located.world_from_body.translation_m.to_array(),
                "rotation_xyzw": located.world_from_body.rotation.to_array(),
                "sigma_mm": located.position_sigma_m.to_array().map(|m| m * 1e3),
                "sigma_deg": located.rotation_sigma_rad.to_array().map(f64::to_degrees),
                "tags": located.tags,
                "cameras": located.cameras,
                "rms_px": located.rms_px,
                "image_ms": image_ms,
            }),
            Err(why) => json!({ "why": format!("{why:?}"), "image_ms": image_ms }),
        };
    }
}

fn look_json(look: &CameraResult) -> Value {
    let corners = |corners: &[DVec2; 4]| corners.map(|corner| corner.to_array());
    let seen: Vec<Value> = look
        .seen
        .iter()
        .map(|seen| {
            json!({
                "id": seen.detection.id,
                "corners": corners(&seen.detection.corners_px),
                "expected": seen.expected_px.as_ref().map(corners),
            })
        })
        .collect();
    let strangers: Vec<Value> = look
        .strangers
        .iter()
        .map(|tag| json!({ "id": tag.id, "corners": corners(&tag.corners_px) }))
        .collect();
    let region = look.region.map(|region| [region.least_px.to_array(), region.most_px.to_array()]);
    json!({ "seen": seen, "strangers": strangers, "region": region })
}

type Shared = State<Arc<Mutex<Shown>>>;

async fn state(State(shared): Shared) -> Response {
    let mut shown = lock(&shared);
    shown.asked = Some(Instant::now());
    let cameras: Vec<Value> = shown
        .cameras
        .iter()
        .map(|camera| json!({ "name": camera.name, "size": [camera.size.0, camera.size.1], "look": camera.look }))
        .collect();
    let text = json!({ "pose": shown.pose, "cameras": cameras }).to_string();
    ([(header::CONTENT_TYPE, "application/json")], text).into_response()
}

async fn camera(State(shared): Shared, Path(index): Path<usize>) -> Response {
    let image = {
        let mut shown = lock(&shared);
        shown.asked = Some(Instant::now());
        match shown.cameras.get(index) {
            None => return (StatusCode::NOT_FOUND, "no such camera").into_response(),
            Some(camera) => camera.image.clone(),
        }
    };
    let Some(image) = image else {
        return (StatusCode::SERVICE_UNAVAILABLE, "no image yet").into_response();
    };
    match jpeg(&image) {
        Some(bytes) => ([(header::CONTENT_TYPE, "image/jpeg")], bytes).into_response(),
        None => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

fn jpeg(image: &Gray) -> Option<Vec<u8>> {
    let rgb: Vec<u8> = image.pixels().iter().flat_map(|&grey| [grey; 3]).collect();
    let mut bytes = Vec::new();
    encode_jpeg(&rgb, image.width_px(), image.height_px(), QUALITY, &mut bytes).ok()?;
    Some(bytes)
}

const PAGE: &str = include_str!("view.html");
/// JPEG quality, 1 to 100.
const QUALITY: u8 = 70;
/// No browser shows the page after this time without a request.
const FORGET_AFTER: Duration = Duration::from_secs(3);
