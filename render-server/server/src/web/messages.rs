//! Messages to the page: JSON, one type per message, tagged by `type`.

use std::sync::atomic::Ordering;

use serde::Serialize;
use serde_json::{Map, Value};
use vizflyt_arena::config::{CameraConfig, StageConfig};
use vizflyt_arena::pose::PoseQuality;
use vizflyt_protocol::flight_end::EndReason;
use vizflyt_protocol::geometry::{Intrinsics, Volume, yaw_of};
use vizflyt_protocol::messages::{Event, FlightPhase, OutcomeKind, StageTimes, Telemetry};
use vizflyt_protocol::time::ServerTime;

use super::access::Viewer;
use super::state::Page;
use super::top_view::Obstacles;
use crate::clock;
use crate::flights::events::{Entry, Origin};
use crate::flights::vehicle::{Flight, VehicleFlight};
use crate::poses::drivers::SourceCounters;
use crate::render::RendererInfo;
use crate::render::cameras::CameraSet;
use crate::render::dynamic_objects::{DynamicObjects, ObjectBounds};
use crate::stream::Rooms;
use vizflyt_process::lock;

/// Message from server to page.
#[derive(Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(super) enum Message<'a> {
    Arena(Box<Arena<'a>>),
    /// The cameras, after a change.
    Cameras {
        cameras: Vec<CameraLine>,
    },
    /// Path of a vehicle in this flight: (x, y, z [m, world], speed [m/s]), oldest first.
    Track {
        vehicle: &'a str,
        points: &'a [[f32; 4]],
    },
    Events {
        events: Vec<Line>,
    },
    State(Box<State>),
}

/// Description of the room; sent once.
#[derive(Debug, Serialize)]
pub(super) struct Arena<'a> {
    boot: String,
    name: &'a str,
    vehicle: &'a str,
    /// Names of all vehicles.
    vehicles: Vec<&'a str>,
    fence: &'a Volume,
    goal_m: Option<[f64; 3]>,
    goal_radius_m: f64,
    body_radius_m: f64,
    max_speed_mps: f64,
    time_limit_s: f64,
    cameras: Vec<CameraLine>,
    /// Corners of the top view's image. [m, world]
    map_min_m: [f64; 2],
    map_max_m: [f64; 2],
    obstacles: &'a Obstacles,
    stages: &'a [StageConfig],
    /// Number of parts of the twin for the 3D view ([`super::twin`]).
    twin_parts: usize,
}

/// A camera: the keys of `[[cameras]]`, and its intrinsics.
#[derive(Debug, Serialize)]
pub(super) struct CameraLine {
    #[serde(flatten)]
    keys: Map<String, Value>,
    intrinsics: Intrinsics,
}

/// One event of the feed.
#[derive(Debug, Serialize)]
pub(super) struct Line {
    index: u64,
    origin: &'static str,
    #[serde(flatten)]
    event: Event,
    /// Colour of an event that ends a flight; see [`tone`].
    tone: Option<&'static str>,
    /// Time since the server started. [s]
    at_s: f64,
}

/// Current state; sent 20 times per second.
#[derive(Debug, Serialize)]
pub(super) struct State {
    pose: Option<PoseLine>,
    runtime: Option<RuntimeLine>,
    report: Option<Telemetry>,
    render: StageTimes,
    encode: StageTimes,
    send: StageTimes,
    renderer: RendererInfo,
    render_hz: f64,
    stream_hz: f64,
    stream_mbit_s: f64,
    images_late: u64,
    source: SourceCounters,
    source_hz: f64,
    quality: PoseQuality,
    flight_s: Option<f64>,
    landed: bool,
    outcome: Option<OutcomeLine>,
    /// Number of the newest crash card.
    crash: Option<u64>,
    /// Moving objects, with their current poses.
    objects: Vec<ObjectLine>,
    /// Other vehicles that the viewer may see.
    others: Vec<OtherLine>,
}

/// A vehicle other than the shown one.
#[derive(Debug, Serialize)]
struct OtherLine {
    name: String,
    phase: FlightPhase,
    pose: Option<PoseLine>,
    /// Time since take-off. [s]
    flight_s: Option<f64>,
}

/// An object of the arena: a box in its own frame, and its pose.
#[derive(Debug, Serialize)]
struct ObjectLine {
    name: String,
    /// Value in images of object ids.
    id: u16,
    p_world_m: [f64; 3],
    /// Rotation from object to world.
    q_xyzw: [f64; 4],
    /// Minimum and maximum corner. [m, object]
    min_m: [f32; 3],
    max_m: [f32; 3],
}

#[derive(Debug, Serialize)]
struct OutcomeLine {
    outcome: OutcomeKind,
    /// Short title.
    title: &'static str,
    /// Full sentence.
    text: String,
    /// Colour; see [`tone`].
    tone: &'static str,
    /// Time since the server started. [s]
    at_s: f64,
}

#[derive(Debug, Serialize)]
struct PoseLine {
    p_world_m: [f64; 3],
    yaw_rad: f64,
    /// Rotation from body to world, xyzw.
    rotation: [f64; 4],
    v_world_mps: [f64; 3],
    age_s: f64,
}

#[derive(Debug, Serialize)]
struct RuntimeLine {
    address: String,
    program: String,
}

pub(super) fn arena<'a>(page: &'a Page, vehicle: &'a VehicleFlight) -> Message<'a> {
    let info = &vehicle.arena;
    Message::Arena(Box::new(Arena {
        boot: page.boot.as_ns().to_string(),
        name: &info.name,
        vehicle: &vehicle.name,
        vehicles: page.rooms.flights.vehicles.iter().map(|vehicle| &*vehicle.name).collect(),
        fence: &info.geofence,
        goal_m: info.goal_m.map(|goal| goal.to_array()),
        goal_radius_m: info.goal_radius_m,
        body_radius_m: info.body_radius_m,
        max_speed_mps: info.limits.max_speed_mps,
        time_limit_s: info.time_limit_s,
        cameras: camera_lines(&page.rooms.rendering.cameras[vehicle.index].newest()),
        map_min_m: page.top_view.min_m,
        map_max_m: page.top_view.max_m,
        obstacles: &page.top_view.obstacles,
        stages: &page.stages,
        twin_parts: page.twin.len(),
    }))
}

pub(super) fn cameras(set: &CameraSet) -> Message<'static> {
    Message::Cameras { cameras: camera_lines(set) }
}

fn camera_lines(set: &CameraSet) -> Vec<CameraLine> {
    let line = |config: &CameraConfig| CameraLine {
        keys: camera_keys(config),
        intrinsics: config.intrinsics(),
    };
    set.configs.iter().map(line).collect()
}

/// Returns a camera by the keys of `[[cameras]]`, including default values.
pub(super) fn camera_keys(config: &CameraConfig) -> Map<String, Value> {
    let mut keys = match serde_json::to_value(config) {
        Ok(Value::Object(keys)) => keys,
        // Unreachable: a camera is a map of numbers and names, which JSON can represent.
        _ => Map::new(),
    };
    keys.insert("near_m".to_owned(), config.near_m.into());
    keys.insert("yaw_deg".to_owned(), config.yaw_deg.into());
    keys.insert("roll_deg".to_owned(), config.roll_deg.into());
    keys.insert("depth".to_owned(), config.depth.into());
    keys
}

pub(super) fn events(page: &Page, entries: Vec<Entry>) -> Message<'static> {
    let line = |entry: Entry| Line {
        index: entry.index,
        origin: match entry.origin {
            Origin::Server => "server",
            Origin::Page => "runtime",
        },
        tone: entry.event.kind.end_reason().as_ref().map(tone),
        at_s: since_start_s(page, entry.event.stamp),
        event: entry.event,
    };
    Message::Events { events: entries.into_iter().map(line).collect() }
}

pub(super) fn state(page: &Page, vehicle: &VehicleFlight, viewer: &Viewer) -> Message<'static> {
    let Rooms { localization, rendering, streaming, .. } = &page.rooms;
    let (localized, stream) =
        (&localization.vehicles[vehicle.index], &streaming.vehicles[vehicle.index]);
    let rates = &page.rates.vehicles[vehicle.index];
    let now = clock::now();
    let flight = vehicle.flight();
    let source = *lock(&localized.counters);
    let total = |counter: &std::sync::atomic::AtomicU64| counter.load(Ordering::Relaxed);
    Message::State(Box::new(State {
        pose: pose(page, vehicle, now),
        runtime: vehicle.runtime().map(|runtime| RuntimeLine {
            address: runtime.address.to_string(),
            program: runtime.program.as_str().to_owned(),
        }),
        report: vehicle.telemetry.borrow().clone(),
        render: rendering.durations.recent(),
        encode: streaming.encode_durations.recent(),
        send: streaming.send_durations.recent(),
        renderer: lock(&rendering.renderer).clone(),
        render_hz: page.rates.ticks.of(page.rooms.ticks(), now),
        stream_hz: rates.images.of(total(&stream.images.sent), now),
        stream_mbit_s: rates.bytes.of(total(&stream.images.bytes), now) * 8e-6,
        images_late: total(&stream.images.late),
        source,
        quality: lock(&localized.quality).clone(),
        source_hz: rates.poses.of(source.poses, now),
        flight_s: flight_s(&flight, now),
        landed: flight.landed.is_some(),
        outcome: flight.end.decided().map(|(at, reason)| OutcomeLine {
            outcome: reason.outcome(),
            title: reason.title(),
            text: reason.to_string(),
            tone: tone(reason),
            at_s: since_start_s(page, at),
        }),
        crash: vehicle.crash.borrow().as_ref().map(|card| card.id),
        objects: objects(&rendering.dynamic_objects, now),
        others: others(page, vehicle, viewer, now),
    }))
}

fn pose(page: &Page, vehicle: &VehicleFlight, now: ServerTime) -> Option<PoseLine> {
    let newest = page.rooms.localization.vehicles[vehicle.index].sample();
    newest.map(|sample| PoseLine {
        p_world_m: sample.world_from_body.translation_m.to_array(),
        yaw_rad: yaw_of(sample.world_from_body.rotation),
        rotation: sample.world_from_body.rotation.to_array(),
        v_world_mps: sample.twist.linear_mps.to_array(),
        age_s: now.seconds_since(sample.stamp),
    })
}

fn flight_s(flight: &Flight, now: ServerTime) -> Option<f64> {
    flight.took_off.map(|start| flight.landed.unwrap_or(now).seconds_since(start))
}

fn others(page: &Page, shown: &VehicleFlight, viewer: &Viewer, now: ServerTime) -> Vec<OtherLine> {
    let line = |vehicle: &std::sync::Arc<VehicleFlight>| OtherLine {
        name: vehicle.name.to_string(),
        phase: vehicle.phase(),
        pose: pose(page, vehicle, now),
        flight_s: flight_s(&vehicle.flight(), now),
    };
    let vehicles = page.rooms.flights.vehicles.iter();
    let seen =
        vehicles.filter(|vehicle| vehicle.index != shown.index && viewer.may_see(&vehicle.name));
    seen.map(line).collect()
}

/// Returns the colour of an outcome on the page, as a class of its style sheet.
fn tone(reason: &EndReason) -> &'static str {
    match reason.outcome() {
        OutcomeKind::Finished => "good",
        OutcomeKind::Timeout => "warn",
        _ if reason.is_failure() => "bad",
        _ => "warn",
    }
}

fn objects(moving: &DynamicObjects, now: ServerTime) -> Vec<ObjectLine> {
    let since_epoch_ns = moving.since_epoch_ns(now);
    let named = moving.objects.names().zip(&moving.bounds).enumerate();
    let line = |(index, (name, bounds)): (usize, (&str, &ObjectBounds))| {
        let pose = moving.objects.placement(index, since_epoch_ns);
        ObjectLine {
            name: name.to_owned(),
            id: bounds.id,
            p_world_m: pose.translation_m.to_array(),
            q_xyzw: pose.rotation.to_array(),
            min_m: bounds.min_m,
            max_m: bounds.max_m,
        }
    };
    named.map(line).collect()
}

/// Returns the time of `stamp` since the start. A runtime without clock synchronization may send 0; that counts as the
/// start.
fn since_start_s(page: &Page, stamp: ServerTime) -> f64 {
    stamp.seconds_since(page.boot).max(0.0)
}

#[cfg(test)]
mod examples;
#[cfg(test)]
mod typescript;
