//! Output of the server: ready line, events and report, as JSON lines or text.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::Serialize;
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::pose::PoseQuality;

use crate::flights::events::Origin;
use crate::flights::vehicle::VehicleFlight;
use crate::poses::drivers::{Opened, SourceCounters};
use crate::poses::settings::Driver;
use crate::stream::Rooms;
use crate::stream::delivery::CameraDelivery;
use crate::stream::vehicle::ImageCounters;
use crate::timing::StageDurations;
use crate::web::{PageKeys, ServerStages};
use vizflyt_process::{lock, print_fmt, print_line};

/// Contents of the ready line.
#[derive(Debug, Serialize)]
#[allow(clippy::struct_field_names)] // Why: the first key of every program's ready line.
pub(super) struct Ready<'a> {
    pub(super) ready: &'static str,
    pub(super) quic: SocketAddr,
    pub(super) http: String,
    /// SHA-256 of the page's certificate, if served over HTTPS.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) page_certificate: Option<String>,
    /// Address for Vicon's stream, if it is a source.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) vicon: Option<SocketAddr>,
    /// Pose sources.
    pub(super) pose: Vec<ReadySource>,
    pub(super) fingerprint: String,
    /// Number of paired computers.
    pub(super) paired: usize,
    /// Expected start of the first vehicle: x, y, z [m, world], yaw [deg].
    pub(super) spawn: [f64; 4],
    pub(super) vehicles: Vec<ReadyVehicle>,
    pub(super) arena: &'a str,
    /// Name of the renderer: `cpu avx2`.
    pub(super) renderer: &'a str,
    /// Reason for this renderer.
    pub(super) renderer_reason: &'a str,
}

/// Pose source in the ready line.
#[derive(Debug, Serialize)]
pub(super) struct ReadySource {
    driver: Driver,
    address: String,
}

/// Vehicle in the ready line.
#[derive(Debug, Serialize)]
pub(super) struct ReadyVehicle {
    name: String,
    /// Expected start: x, y, z [m, world], yaw [deg].
    spawn: [f64; 4],
    cameras: Vec<String>,
}

impl ReadySource {
    pub(super) fn of(source: &Opened) -> Self {
        Self { driver: source.driver(), address: source.address() }
    }
}

impl ReadyVehicle {
    pub(super) fn of((name, arena): &(String, ArenaConfig)) -> Self {
        let cameras = arena.cameras.iter().map(|camera| camera.name.clone()).collect();
        Self { name: name.clone(), spawn: spawn(arena), cameras }
    }
}

/// Returns the expected start of a vehicle: x, y, z [m, world], yaw [deg].
pub(super) fn spawn(arena: &ArenaConfig) -> [f64; 4] {
    let [x, y, z] = arena.spawn.position_m.to_array();
    [x, y, z, arena.spawn.yaw_deg]
}

/// Prints the page's addresses with keys.
pub(super) fn page_keys(keys: &PageKeys, http: &str, names: &[&str], json: bool) {
    // Unspecified addresses are printed as HOST.
    let page = http.replace("//0.0.0.0:", "//HOST:").replace("//[::]:", "//HOST:");
    for (whose, link) in keys.links(&page, names) {
        if json {
            line(&serde_json::json!({ "page_key": { "for": whose, "link": link } }));
        } else {
            print_fmt!("page key     {link} ({whose})");
        }
    }
}

/// Prints the events of a vehicle, with its name unless it is `alone`.
pub(super) async fn events(vehicle: Arc<VehicleFlight>, alone: bool, json: bool) {
    let mut log = vehicle.events.subscribe();
    log.mark_changed();
    let mut cursor = 0;
    while log.changed().await.is_ok() {
        log.mark_unchanged();
        let entries = match vehicle.events.read(&mut cursor) {
            Ok(entries) => entries,
            Err(lagged) => {
                cursor = lagged.oldest;
                continue;
            }
        };
        for entry in entries.into_iter().filter(|entry| entry.origin == Origin::Server) {
            match (json, alone) {
                (true, true) => line(&serde_json::json!({ "event": entry.event })),
                (true, false) => {
                    line(&serde_json::json!({ "vehicle": vehicle.name, "event": entry.event }));
                }
                (false, true) => print_line(&entry.event.text),
                (false, false) => print_fmt!("{}: {}", vehicle.name, entry.event.text),
            }
        }
    }
}

/// Prints that the server is ready.
pub(super) fn ready(json: bool, ready: &Ready<'_>) {
    if json {
        return line(ready);
    }
    print_fmt!("arena        {}", ready.arena);
    print_fmt!("renderer     {} ({})", ready.renderer, ready.renderer_reason);
    print_fmt!("page         {}", ready.http);
    if let Some(fingerprint) = &ready.page_certificate {
        print_fmt!("certificate  {fingerprint} (the page's; compare it when a browser asks)");
    }
    for source in &ready.pose {
        print_fmt!("{:<12} {} (poses)", source.driver.name(), source.address);
    }
    for vehicle in &ready.vehicles {
        let named = match &*ready.vehicles {
            [one] if one.name == "vizflyt" => String::new(),
            _ => format!(" --vehicle {}", vehicle.name),
        };
        print_fmt!("runtime      vizflyt fly PLUGIN --server HOST:{}{named}", ready.quic.port());
    }
    print_fmt!("identity     {} ({} paired)", ready.fingerprint, ready.paired);
}

/// Prints the report at the end.
pub(super) fn report(json: bool, report: &ServerReport) {
    if json {
        return line(&serde_json::json!({ "report": report }));
    }
    print_fmt!(
        "{} images sent, {} ticks rendered ({} skipped); render {:.1} ms, p99 {:.1}; peak memory {:.0} MB; {}",
        report.images_sent,
        report.ticks,
        report.ticks_skipped,
        report.render_ms_p50,
        report.render_ms_p99,
        report.peak_rss_mb,
        report.renderer
    );
}

/// Prints a JSON line.
pub(super) fn line(value: &impl Serialize) {
    match serde_json::to_string(value) {
        Ok(text) => print_line(text),
        Err(error) => tracing::warn!("a line was not printed: {error}"),
    }
}

/// Report at the end of the server.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct ServerReport {
    /// Time to render one tick, median. [ms]
    render_ms_p50: f32,
    /// 99th percentile. [ms]
    render_ms_p99: f32,
    /// Time to encode one image, median. [ms]
    encode_ms_p50: f32,
    /// 99th percentile. [ms]
    encode_ms_p99: f32,
    /// Time from handing over to acknowledgement, median. [ms]
    send_ms_p50: f32,
    /// 99th percentile. [ms]
    send_ms_p99: f32,
    /// Durations of the server's stages. [ms]
    stages: ServerStages,
    /// Delivery of the images of the last flight, by vehicle and camera.
    images: BTreeMap<String, Vec<CameraDelivery>>,
    /// Ticks rendered.
    ticks: u64,
    /// Ticks replaced by the next one before the encoder took them.
    ticks_skipped: u64,
    /// Images that a runtime acknowledged.
    images_sent: u64,
    /// Images dropped after their deadline.
    images_late: u64,
    /// Megabytes of images acknowledged. [MB]
    sent_mb: f64,
    /// Counters of the pose sources.
    source: SourceCounters,
    /// Quality of the localization at the end, by vehicle.
    pose: BTreeMap<String, PoseQuality>,
    /// Peak resident memory of this process. [MB]
    peak_rss_mb: f64,
    /// Name of the renderer.
    renderer: String,
    /// Reason for this renderer.
    renderer_reason: String,
}

impl ServerReport {
    /// Returns the report of the complete run.
    pub(super) fn of(rooms: &Rooms) -> Self {
        let Rooms { flights, localization, rendering, streaming, .. } = rooms;
        let total = |counter: fn(&ImageCounters) -> &AtomicU64| -> u64 {
            let streams = streaming.vehicles.iter();
            streams.map(|stream| counter(&stream.images).load(Ordering::Relaxed)).sum()
        };
        let stages = ServerStages::of(rooms, StageDurations::overall);
        let renderer = lock(&rendering.renderer).clone();
        let mut images = BTreeMap::new();
        let mut pose = BTreeMap::new();
        for vehicle in &flights.vehicles {
            let name = vehicle.name.as_str().to_owned();
            let deliveries = streaming.vehicles[vehicle.index].deliveries(&vehicle.arena.cameras);
            images.insert(name.clone(), deliveries);
            let quality = lock(&localization.vehicles[vehicle.index].quality).clone();
            pose.insert(name, quality);
        }
        Self {
            render_ms_p50: stages.render.p50,
            render_ms_p99: stages.render.p99,
            encode_ms_p50: stages.encode.p50,
            encode_ms_p99: stages.encode.p99,
            send_ms_p50: stages.send.p50,
            send_ms_p99: stages.send.p99,
            stages,
            images,
            ticks: rooms.ticks(),
            ticks_skipped: rendering.ticks_skipped.load(Ordering::Relaxed),
            images_sent: total(|images| &images.sent),
            images_late: total(|images| &images.late),
            sent_mb: total(|images| &images.bytes) as f64 / 1e6,
            source: *lock(&localization.counters),
            pose,
            peak_rss_mb: peak_rss_mb().unwrap_or(0.0),
            renderer: renderer.name,
            renderer_reason: renderer.reason,
        }
    }
}

/// Returns the peak resident memory of this process; `None` without /proc. [MB]
fn peak_rss_mb() -> Option<f64> {
    parse_peak(&std::fs::read_to_string("/proc/self/status").ok()?)
}

fn parse_peak(status: &str) -> Option<f64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib * 1024.0 / 1e6)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_the_peak_memory_of_the_status_file() {
        assert_eq!(parse_peak("Name:\tx\nVmHWM:\t  1000 kB\n"), Some(1.024));
        assert_eq!(parse_peak("Name:\tx\n"), None);
        assert!(peak_rss_mb().is_some_and(|mb| mb > 1.0));
    }
}
