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
use std::time::{Duration, Instant};

use tracing::{trace_span, warn};
use vizflyt_arena::config::{CameraConfig, MAX_OBJECTS, MAX_VEHICLES};
use vizflyt_arena::pose::Predict;
use vizflyt_protocol::geometry::{Body, Pose, World};
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
    let schedule = Schedule::new(max_rate_hz, Instant::now());
    let mut schedules = vec![schedule; rendering.cameras.len()];
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
        let now = Instant::now();
        let ready = (0..sets.len()).filter(|&index| wanted[index] && poses[index].is_some());
        let next = ready.map(|index| schedules[index].next(&sets[index].configs, now)).min();
        // Where nothing is due, a newer pose is worth waking up for: it may be another vehicle's.
        let wait = next.map_or(PATIENCE, |next| next.saturating_duration_since(now).min(PATIENCE));
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
        let mut views = [View::default(); MAX_VEHICLES];
        for (vehicle, set) in sets.iter().enumerate() {
            let mut due = [false; MAX_CAMERAS];
            // A vehicle's pose is kept until a camera of it is due.
            let sample = poses[vehicle].filter(|_| wanted[vehicle]).inspect(|_| {
                due = schedules[vehicle].take(&set.configs, Instant::now());
            });
            if due.contains(&true) {
                poses[vehicle] = None;
            }
            let after_s = demand.seen_after_s(vehicle);
            let shown =
                sample.map(|newest| shown(rendering.predict, after_s, &newest, clock::now()));
            let flies = flights.vehicles[vehicle].runtime().is_some();
            let first = cameras.len();
            for (camera, slot) in slots.by_ref().take(set.configs.len()).enumerate() {
                slot.fresh = due[camera];
                let (true, Some(Localized { sample, .. }), Some((at, world_from_body))) =
                    (slot.fresh, sample, shown)
                else {
                    continue;
                };
                let (config, info) = (&set.configs[camera], &set.infos[camera]);
                cameras.push(Camera {
                    intrinsics: info.intrinsics,
                    world_from_cam: world_from_body * info.body_from_cam,
                    near_m: config.near_m as f32,
                    background: BACKGROUND,
                    atmosphere,
                });
                stamp = stamp.max(sample.stamp);
                (slot.vehicle, slot.camera) = (vehicle, camera);
                slot.counted = flies;
                slot.seq = seq;
                (slot.pose, slot.shown) = (sample.stamp, at);
                slot.world_from_body = Some(world_from_body);
                slot.set = Some(set.clone());
                images.resize_with(images.len().max(cameras.len()), Default::default);
                std::mem::swap(&mut images[cameras.len() - 1], &mut slot.image);
            }
            let at = shown.map_or(ServerTime::ZERO, |(at, _)| at);
            views[vehicle] = View { first, end: cameras.len(), at };
        }
        let span = trace_span!("tick", seq, stamp_ns = stamp.as_ns()).entered();
        let images = &mut images[..cameras.len()];
        let start = clock::now();
        let result = trace_span!("render").in_scope(|| {
            if rendering.dynamic_objects.is_empty() {
                return renderer.render(&[], &cameras, images).map(|_| ());
            }
            // Each vehicle sees the moment that its images show, and not itself.
            let drawn = views.iter().enumerate().filter(|(_, view)| view.first < view.end);
            drawn.into_iter().try_for_each(|(vehicle, &View { first, end, at })| {
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
                    warn!("tick {seq} is not drawn: {error}; more of these go unsaid");
                }
                ticks.recycle(tick);
            }
        }
    }
}

/// Which of a tick's cameras are a vehicle's, and the instant that they show.
#[derive(Clone, Copy, Debug, Default)]
struct View {
    first: usize,
    end: usize,
    at: ServerTime,
}

/// Returns the instant that images drawn at `now` are to show, and where the vehicle is by then.
fn shown(
    predict: Predict,
    seen_after_s: Option<f64>,
    newest: &Localized,
    now: ServerTime,
) -> (ServerTime, Pose<World, Body>) {
    let Localized { sample, motion } = newest;
    let after_s = match predict {
        Predict::Measured => return (sample.stamp, sample.world_from_body),
        Predict::Drawn => 0.0,
        Predict::Seen => seen_after_s.unwrap_or(SEEN_AFTER_S),
    };
    let at = motion.reach(now.plus_seconds(after_s));
    (at, motion.at(at))
}

/// Tells when another renderer has taken over, as the processor does from a lost graphics device.
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

/// When each camera of a vehicle is due.
#[derive(Clone, Debug)]
struct Schedule {
    /// The shortest time between two ticks.
    least: Duration,
    due: [Instant; MAX_CAMERAS],
}

impl Schedule {
    fn new(max_rate_hz: f64, now: Instant) -> Self {
        Self { least: Duration::from_secs_f64(1.0 / max_rate_hz), due: [now; MAX_CAMERAS] }
    }

    /// Returns when the first of the cameras is due.
    fn next(&mut self, cameras: &[CameraConfig], now: Instant) -> Instant {
        for (due, camera) in self.due.iter_mut().zip(cameras) {
            // A camera that got faster need not wait out its former period.
            let period = own_period(self.least, camera);
            *due = (*due).min(now + period);
        }
        self.due[..cameras.len().min(MAX_CAMERAS)].iter().min().copied().unwrap_or(now + PATIENCE)
    }

    /// Returns which cameras are drawn at `now`, and notes when they are due again.
    fn take(&mut self, cameras: &[CameraConfig], now: Instant) -> [bool; MAX_CAMERAS] {
        let mut taken = [false; MAX_CAMERAS];
        for ((taken, due), camera) in taken.iter_mut().zip(&mut self.due).zip(cameras) {
            // Cameras that are due almost together are drawn together.
            *taken = *due <= now + TOGETHER;
            if *taken {
                // From when it was due, so that the mean rate is kept; from now, after a rest.
                *due = (*due + own_period(self.least, camera)).max(now);
            }
        }
        taken
    }
}

/// Returns the time between two images of a camera, where ticks are at least `least` apart.
fn own_period(least: Duration, camera: &CameraConfig) -> Duration {
    camera.rate_hz.map_or(least, |hz| Duration::from_secs_f64(1.0 / hz).max(least))
}

/// From drawing to the plugin, as long as no runtime has said: of a usual machine. [s]
const SEEN_AFTER_S: f64 = 0.015;
/// How long a stop may go unnoticed.
const PATIENCE: Duration = Duration::from_millis(100);
/// The renderer is asked for its name this often: a second's worth.
const NAME_TICKS: u64 = 64;
/// Less than any sensor notices, more than clocks round. [s]
const TOGETHER: Duration = Duration::from_millis(1);
/// Where the twin ends: black, like the trainers' background.
const BACKGROUND: [f32; 3] = [0.0; 3];

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use vizflyt_protocol::messages::PoseSample;

    fn cameras(rates_hz: &[Option<f64>]) -> Vec<CameraConfig> {
        let camera = |&rate_hz| {
            let ahead = CameraConfig::ahead("x", [4, 3], 90.0, DVec3::ZERO);
            CameraConfig { rate_hz, ..ahead }
        };
        rates_hz.iter().map(camera).collect()
    }

    /// Runs a second in which each tick takes `tick_ms`; returns how often each camera was drawn.
    fn drawn_in_a_second(rates_hz: &[Option<f64>], tick_ms: u64) -> Vec<usize> {
        let (start, cameras) = (Instant::now(), cameras(rates_hz));
        let mut schedule = Schedule::new(120.0, start);
        let mut counts = vec![0; cameras.len()];
        let mut now = start;
        while now < start + Duration::from_secs(1) {
            now = now.max(schedule.next(&cameras, now));
            let taken = schedule.take(&cameras, now);
            assert!(taken.contains(&true), "a tick draws something");
            for (count, taken) in counts.iter_mut().zip(taken) {
                *count += usize::from(taken);
            }
            now += Duration::from_millis(tick_ms);
        }
        counts
    }

    #[test]
    fn every_camera_keeps_its_rate() {
        assert!(drawn_in_a_second(&[None], 1)[0].abs_diff(120) <= 1);
        let counts = drawn_in_a_second(&[Some(30.0), None, Some(10.0), Some(500.0)], 1);
        assert!(counts[0].abs_diff(30) <= 1 && counts[2].abs_diff(10) <= 1, "{counts:?}");
        assert!(counts[1].abs_diff(120) <= 1 && counts[3] == counts[1], "{counts:?}");
        // A machine that draws 40 ticks a second gives every one to the camera without a rate.
        let counts = drawn_in_a_second(&[Some(30.0), None], 25);
        assert!(counts[0].abs_diff(30) <= 1 && counts[1].abs_diff(40) <= 1, "{counts:?}");
    }

    #[test]
    fn cameras_of_one_rate_stay_together() {
        let (start, pair) = (Instant::now(), cameras(&[Some(30.0), Some(30.0)]));
        let mut schedule = Schedule::new(120.0, start);
        let mut now = start;
        for k in 0..100 {
            now = now.max(schedule.next(&pair, now)) + Duration::from_millis(k % 7);
            let taken = schedule.take(&pair, now);
            assert_eq!(taken[0], taken[1]);
        }
    }

    #[test]
    fn images_show_the_moment_that_is_asked_for() {
        let measured = ServerTime::from_ns(1_000_000_000);
        let mut newest = Localized::still(PoseSample::still(measured, Pose::IDENTITY));
        newest.motion.v_world_mps = DVec3::X * 5.0;
        // Drawn 10 ms after the measurement, seen 30 ms later; and a pose that is half a second old.
        let now = measured.plus_ns(10_000_000);
        let x_m = |predict, seen_after_s, now| {
            let (at, pose) = shown(predict, seen_after_s, &newest, now);
            assert!((pose.translation_m.x - 5.0 * at.seconds_since(measured)).abs() < 1e-9);
            pose.translation_m.x
        };
        assert_eq!(x_m(Predict::Measured, Some(0.03), now), 0.0);
        assert!((x_m(Predict::Drawn, Some(0.03), now) - 0.05).abs() < 1e-9);
        assert!((x_m(Predict::Seen, Some(0.03), now) - 0.2).abs() < 1e-9);
        assert!((x_m(Predict::Seen, None, now) - 0.05 - 5.0 * SEEN_AFTER_S).abs() < 1e-9);
        assert!((x_m(Predict::Seen, Some(0.03), measured.plus_ns(500_000_000)) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_camera_that_gets_faster_need_not_wait() {
        let start = Instant::now();
        let mut schedule = Schedule::new(120.0, start);
        schedule.take(&cameras(&[Some(0.1)]), start);
        let ten_seconds = start + Duration::from_secs(10);
        assert_eq!(schedule.next(&cameras(&[Some(0.1)]), start), ten_seconds);
        let next = schedule.next(&cameras(&[Some(50.0)]), start);
        assert_eq!(next, start + Duration::from_millis(20));
    }
}
