//! Sensors other than cameras over HTTP: readable by all viewers of the page, changed only by this server's page.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::{Map, Value};
use vizflyt_arena::config::SensorConfig;
use vizflyt_protocol::messages::EventKind;
use vizflyt_protocol::sensor::{LidarPoint, RadarDetection, RangeReading, SensorInfo, SensorKind};
use zerocopy::FromBytes;

use crate::clock;
use crate::render::cameras::ChangeError;
use crate::render::sensors::{MadeReading, SensorCounters};
use crate::web::http::refuse;
use crate::web::origin;
use crate::web::state::{Page, vehicle};

/// A sensor: the keys of `[[sensors]]`, and the measurements of its model.
#[derive(Debug, Serialize)]
pub(in crate::web) struct SensorLine {
    #[serde(flatten)]
    keys: Map<String, Value>,
    kind: SensorKind,
    /// Properties from its model and the keys above.
    measures: Measures,
    /// Numbers of readings: made, acknowledged by the runtime, and dropped on the way.
    made: u64,
    sent: u64,
    late: u64,
}

/// Measuring properties of a sensor.
#[derive(Debug, Serialize)]
struct Measures {
    rate_hz: f32,
    min_range_m: f32,
    max_range_m: f32,
    horizontal_fov_rad: f32,
    vertical_fov_rad: f32,
}

/// A sensor's newest reading, reduced for drawing.
#[derive(Debug, Serialize)]
pub(in crate::web) struct ReadingLine {
    seq: u64,
    /// Age of the reading. [s]
    age_s: f64,
    /// Distance of a range finder or a sonar; null without a return. [m]
    range_m: Option<f32>,
    /// Number of returns of a LiDAR or a radar.
    records: usize,
    /// Points of a LiDAR or a radar: x forward, y left, z up. [m, body]
    points_m: Vec<[f32; 3]>,
}

impl SensorLine {
    fn of(config: &SensorConfig, info: &SensorInfo, counters: &SensorCounters) -> Self {
        let keys = match serde_json::to_value(config) {
            Ok(Value::Object(keys)) => keys,
            // Unreachable: a sensor is a map of numbers and names, which JSON can represent.
            _ => Map::new(),
        };
        let (kind, total) =
            (info.kind, |counter: &std::sync::atomic::AtomicU64| counter.load(Ordering::Relaxed));
        let measures = Measures {
            rate_hz: info.rate_hz,
            min_range_m: info.min_range_m,
            max_range_m: info.max_range_m,
            horizontal_fov_rad: info.horizontal_fov_rad,
            vertical_fov_rad: info.vertical_fov_rad,
        };
        let (made, sent, late) =
            (total(&counters.made), total(&counters.sent), total(&counters.late));
        let mut line = Self { keys, kind, measures, made, sent, late };
        // Also if they have their default value.
        line.keys.insert("enabled".to_owned(), config.enabled.into());
        line.keys.insert("to_autopilot".to_owned(), config.to_autopilot.into());
        line
    }
}

impl ReadingLine {
    fn of(reading: &MadeReading) -> Self {
        let header = &reading.header;
        let body_from_sensor = header.body_from_sensor();
        let in_body = |p: [f32; 3]| {
            let p_body = body_from_sensor.transform_point(p.map(f64::from).into());
            p_body.to_array().map(|part| part as f32)
        };
        let records = header.record_count.get() as usize;
        let thinned = records.div_ceil(MAX_POINTS).max(1);
        let bytes = reading.records();
        let kind = header.kind();
        let stride = kind.record_len();
        let points_m = match kind {
            SensorKind::Lidar => bytes
                .chunks_exact(stride)
                .step_by(thinned)
                .filter_map(|bytes| LidarPoint::read_from_bytes(bytes).ok())
                .map(|point| in_body(point.p_m))
                .collect(),
            SensorKind::Radar => bytes
                .chunks_exact(stride)
                .filter_map(|bytes| RadarDetection::read_from_bytes(bytes).ok())
                .map(|one| {
                    let (sin, cos) = one.azimuth_rad.sin_cos();
                    in_body([one.range_m * cos, one.range_m * sin, 0.0])
                })
                .collect(),
            SensorKind::RangeFinder | SensorKind::Sonar => Vec::new(),
        };
        let range = kind.is_single().then(|| RangeReading::read_from_bytes(bytes).ok()).flatten();
        Self {
            seq: header.seq.get(),
            age_s: clock::now().seconds_since(header.stamp()),
            range_m: range.and_then(|range| range.measured_m()),
            records,
            points_m,
        }
    }
}

pub(in crate::web) async fn list(
    State(page): State<Arc<Page>>,
    Path(name): Path<String>,
) -> Response {
    let vehicle = match vehicle(&page, &name) {
        Ok(vehicle) => vehicle,
        Err(none) => return *none,
    };
    let sensors = &page.rooms.rendering.sensors[vehicle.index];
    let set = sensors.newest();
    let lines = set.configs.iter().zip(&set.infos).zip(&sensors.counters);
    let lines = lines.map(|((config, info), counters)| SensorLine::of(config, info, counters));
    Json(lines.collect::<Vec<_>>()).into_response()
}

/// Returns a sensor's newest reading, `null` before the first one.
pub(in crate::web) async fn reading(
    State(page): State<Arc<Page>>,
    Path((name, sensor)): Path<(String, String)>,
) -> Response {
    let vehicle = match vehicle(&page, &name) {
        Ok(vehicle) => vehicle,
        Err(none) => return *none,
    };
    let sensors = &page.rooms.rendering.sensors[vehicle.index];
    let index = sensors.newest().configs.iter().position(|config| config.name == sensor);
    let Some(newest) = index.and_then(|index| sensors.readings(index)) else {
        let error = format!("there is no sensor '{sensor}'");
        return (StatusCode::NOT_FOUND, error).into_response();
    };
    let newest = newest.borrow().clone();
    Json(newest.map(|reading| ReadingLine::of(&reading))).into_response()
}

pub(in crate::web) async fn patch(
    State(page): State<Arc<Page>>,
    Path((name, sensor)): Path<(String, String)>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    let vehicle = match vehicle(&page, &name) {
        Ok(vehicle) => vehicle,
        Err(none) => return *none,
    };
    let body = match body {
        Ok(body) => body,
        Err(rejection) => return rejection.into_response(),
    };
    let sensors = &page.rooms.rendering.sensors[vehicle.index];
    let before = sensors.newest();
    match sensors.patch(&sensor, &body) {
        Ok(config) => {
            let now = sensors.newest();
            // Unchanged settings are not an event.
            if !Arc::ptr_eq(&before, &now) {
                let info = now.infos.iter().find(|info| info.name.as_str() == config.name);
                let text = info.map_or_else(String::new, describe);
                vehicle.publish(EventKind::Note, &text);
            }
            Json(config).into_response()
        }
        Err(error @ ChangeError::UnknownSensor { .. }) => {
            (StatusCode::NOT_FOUND, error.to_string()).into_response()
        }
        Err(error) => (StatusCode::BAD_REQUEST, error.to_string()).into_response(),
    }
}

/// Returns a one-line description of the sensor, for the page and the flight log.
fn describe(info: &SensorInfo) -> String {
    let SensorInfo { name, kind, enabled, rate_hz, min_range_m, max_range_m, .. } = info;
    let state = if *enabled { "on" } else { "off" };
    format!("sensor {name}, a {kind}, is {state}: {rate_hz} Hz, {min_range_m} to {max_range_m} m")
}

/// Maximum points of a reading on the page: more than a small drawing has pixels for.
const MAX_POINTS: usize = 2048;

#[cfg(test)]
pub(in crate::web) fn examples() -> (Vec<Value>, Vec<Value>) {
    let config = SensorConfig::ahead("top", "os1-16", glam::DVec3::ZERO);
    let set = crate::render::sensors::SensorSet::new(&[config]).expect("a named model");
    let line = SensorLine::of(&set.configs[0], &set.infos[0], &SensorCounters::default());
    let reading = |range_m| ReadingLine {
        seq: 1,
        age_s: 0.1,
        range_m,
        records: 1,
        points_m: vec![[1.0, 2.0, 3.0]],
    };
    let readings = [reading(Some(1.5)), reading(None)].map(|line| serde_json::json!(line));
    (vec![serde_json::json!(line)], readings.to_vec())
}
