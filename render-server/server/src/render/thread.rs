//! The render thread: newest motions in, rendered ticks out.
//!
//! ```text
//! newest motions, moved on to when the image is seen -> the cameras that are due, all vehicles'
//! in one call -> rendered ticks, as fast as the machine renders, at most --max-rate and each
//! camera's own rate; rests while nobody wants images
//! ```
//! Bounded by the renderer; it allocates nothing once every buffer has been used
//! (tests/allocation.rs). It is a plain thread: rendering would block tokio's workers.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tracing::{trace_span, warn};
use vizflyt_arena::config::{MAX_OBJECTS, MAX_VEHICLES};
use vizflyt_protocol::messages::{EventKind, MAX_CAMERAS};
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::{Camera, Placement, Rasterizer, RgbdImage};

use crate::clock;
use crate::flights::Flights;
use crate::lock::lock;
use crate::mailbox::Mailbox;
use crate::poses::newest::{Localized, NewestPoses, merge};
use crate::render::cameras::{CameraSet, RenderedCameras};
use crate::render::demand::Demand;
use crate::render::environment::atmosphere;
use crate::render::rendered::RenderQueue;
use crate::render::schedule::{CameraSchedule, Exposure, Periods};
use crate::render::{RendererInfo, Rendering};
use crate::stop::Stop;

/// Draws the newest poses until the server stops: each tick the cameras that are due of the
/// vehicles that someone wants images of.
///
/// # Errors
/// None; a camera that the renderer refuses is logged once and the tick left out.
pub fn run(
    (rendering, flights, demand): (&Rendering, &Flights, &impl Demand),
    renderer: &mut dyn Rasterizer,
    newest: &Mailbox<NewestPoses>,
    ticks: &RenderQueue,
    max_rate_hz: f64,
    stop: &Stop,
) {
    let least_ns = (1e9 / max_rate_hz) as i64;
    let periods = Periods { default_ns: least_ns, least_ns, together_ns: TOGETHER_NS };
    let mut schedules = vec![CameraSchedule::new(clock::now()); rendering.cameras.len()];
    let mut sets: Vec<Arc<CameraSet>> = Vec::with_capacity(MAX_VEHICLES);
    let mut rendered_cameras: [RenderedCameras; MAX_VEHICLES] = Default::default();
    let mut cameras: Vec<Camera> = Vec::with_capacity(MAX_VEHICLES * MAX_CAMERAS);
    // The renderer wants the images of the cameras that are due side by side.
    let mut images: Vec<RgbdImage> = Vec::new();
    // Poses that nothing was rendered from yet; and the newest of each vehicle, for the others' images.
    let (mut poses, mut known) = (NewestPoses::default(), NewestPoses::default());
    let mut placements: Vec<Placement> = Vec::with_capacity(MAX_OBJECTS + MAX_VEHICLES);
    let (mut seq, mut refused) = (0u64, false);
    while !stop.is_set() {
        let wanted = demand.wait_for_interest(PATIENCE);
        if !wanted.contains(&true) {
            continue;
        }
        sets.clear();
        let vehicles = rendering.cameras.iter().zip(&mut rendered_cameras).enumerate();
        sets.extend(vehicles.map(|(vehicle, (cameras, rendered))| {
            rendered.follow(cameras.newest(), demand.shrink(vehicle))
        }));
        let now = clock::now();
        let ready = (0..sets.len()).filter(|&index| wanted[index] && poses[index].is_some());
        let next = ready.filter_map(|index| {
            schedules[index].hasten(&sets[index].configs, &periods, now);
            schedules[index].next(&sets[index].configs)
        });
        // Where nothing is due, a newer pose is worth waking up for: it may be another vehicle's.
        let wait = next.min().map_or(PATIENCE, |next| {
            Duration::from_nanos(next.as_ns().saturating_sub(now.as_ns())).min(PATIENCE)
        });
        if let Some(newer) = newest.take(wait) {
            merge(&newer, &mut poses);
            merge(&newer, &mut known);
        }
        if !wait.is_zero() {
            continue;
        }
        seq += 1;
        let mut tick = ticks.spare();
        let slots = sets.iter().map(|set| set.configs.len()).sum();
        tick.slots.resize_with(slots, Default::default);
        let mut slots = tick.slots.iter_mut();
        let mut stamp = ServerTime::ZERO;
        cameras.clear();
        let atmosphere = atmosphere(&rendering.environment.now());
        let mut ranges = [CameraRange::default(); MAX_VEHICLES];
        for (vehicle, set) in sets.iter().enumerate() {
            let mut due = [false; MAX_CAMERAS];
            // A vehicle's pose is kept until a camera of it is due.
            let sample = poses[vehicle].filter(|_| wanted[vehicle]).inspect(|_| {
                due = schedules[vehicle].take(&set.configs, &periods, clock::now());
            });
            if due.contains(&true) {
                poses[vehicle] = None;
            }
            let after_ns = demand.seen_after_s(vehicle).map(|s| (s * 1e9) as i64);
            let shown = sample
                .map(|newest| Exposure::new(rendering.predict, after_ns, &newest, clock::now()));
            let flies = flights.vehicles[vehicle].runtime().is_some();
            let first = cameras.len();
            for (camera, slot) in slots.by_ref().take(set.configs.len()).enumerate() {
                slot.fresh = due[camera];
                let (true, Some(Localized { sample, .. }), Some(exposure)) =
                    (slot.fresh, sample, shown)
                else {
                    continue;
                };
                let (config, info) = (&set.configs[camera], &set.infos[camera]);
                cameras.push(exposure.camera(config, info, atmosphere));
                stamp = stamp.max(sample.stamp);
                (slot.vehicle, slot.camera) = (vehicle, camera);
                slot.counted = flies;
                slot.seq = seq;
                (slot.pose, slot.shown) = (sample.stamp, exposure.at);
                slot.world_from_body = Some(exposure.world_from_body);
                slot.set = Some(set.clone());
                images.resize_with(images.len().max(cameras.len()), Default::default);
                std::mem::swap(&mut images[cameras.len() - 1], &mut slot.image);
            }
            let at = shown.map_or(ServerTime::ZERO, |exposure| exposure.at);
            ranges[vehicle] = CameraRange { first, end: cameras.len(), at };
        }
        let span = trace_span!("tick", seq, stamp_ns = stamp.as_ns()).entered();
        let images = &mut images[..cameras.len()];
        let start = clock::now();
        let result = trace_span!("render").in_scope(|| {
            if rendering.dynamic_objects.is_empty() {
                return renderer.render(&[], &cameras, images).map(|_| ());
            }
            // Each vehicle sees the moment that its images show, and not itself.
            let due = ranges.iter().enumerate().filter(|(_, range)| range.first < range.end);
            due.into_iter().try_for_each(|(vehicle, &CameraRange { first, end, at })| {
                placements.clear();
                rendering.dynamic_objects.place(at, vehicle, &known, &mut placements);
                let images = &mut images[first..end];
                renderer.render(&placements, &cameras[first..end], images).map(|_| ())
            })
        });
        let end = clock::now();
        drop(span);
        for (slot, image) in tick.slots.iter_mut().filter(|slot| slot.fresh).zip(images) {
            std::mem::swap(image, &mut slot.image);
            (slot.render_start, slot.render_end) = (start, end);
        }
        match result {
            Ok(()) => {
                rendering.durations.add(start, end);
                if seq.is_multiple_of(NAME_TICKS) {
                    note_renderer(rendering, flights, renderer);
                }
                for slot in tick.slots.iter().filter(|slot| slot.fresh && slot.counted) {
                    demand.count_rendered(slot.vehicle, slot.camera);
                }
                let skipped = ticks.publish(tick, demand.has_viewers() || flights.any_under_way());
                rendering.ticks.fetch_add(1, Ordering::Relaxed);
                rendering.ticks_skipped.fetch_add(u64::from(skipped), Ordering::Relaxed);
            }
            Err(error) => {
                if !std::mem::replace(&mut refused, true) {
                    warn!("tick {seq} is not rendered: {error}; further errors are not logged");
                }
                ticks.recycle(tick);
            }
        }
    }
}

/// Which of a tick's cameras are a vehicle's, and the instant that they show.
#[derive(Clone, Copy, Debug, Default)]
struct CameraRange {
    first: usize,
    end: usize,
    at: ServerTime,
}

/// Reports when another renderer has taken over, as the processor does from a lost graphics device.
fn note_renderer(rendering: &Rendering, flights: &Flights, renderer: &dyn Rasterizer) {
    let name = renderer.name();
    let mut info = lock(&rendering.renderer);
    if info.name != name {
        let text = format!("the renderer is now {name}");
        *info = RendererInfo { name: name.into_owned(), reason: "took over in flight".to_owned() };
        drop(info);
        for vehicle in &flights.vehicles {
            vehicle.publish(EventKind::Note, &text);
        }
    }
}

/// How long a stop may go unnoticed.
const PATIENCE: Duration = Duration::from_millis(100);
/// The renderer is asked for its name this often: a second's worth.
const NAME_TICKS: u64 = 64;
/// Less than any sensor notices, more than clocks round. [ns]
const TOGETHER_NS: i64 = 1_000_000;
