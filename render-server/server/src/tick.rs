//! The two threads that drive everything: poses in, drawn ticks out.
//!
//! ```text
//! pose thread:   source -> Referee (gate, rules) -> Hub::pose, trail, events       200 Hz
//!                                                \-> newest pose (mailbox)
//! render thread: newest pose -> the cameras that are due -> drawn ticks (mailbox)  as fast as
//!                the machine draws, at most --max-rate and each camera's own rate; rests while
//!                nobody wants images
//! ```
//! Budget of the pose thread: 20 us a pose, bounded by the referee's swept query. The render
//! thread is bounded by the renderer. Both are plain threads: tokio's timers are a millisecond
//! late, and drawing would block its workers.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use tracing::{trace_span, warn};
use vizflyt_arena::Referee;
use vizflyt_arena::config::CameraConfig;
use vizflyt_arena::pose::Rejected;
use vizflyt_protocol::messages::{EventKind, MAX_CAMERAS, PoseSample};
use vizflyt_splat::{Camera, Rasterizer, RgbdImage};

use crate::clock;
use crate::drawn::Ticks;
use crate::drivers::{PoseSource, SourceCounters};
use crate::events::Origin;
use crate::hub::{Hub, RendererInfo, lock};
use crate::mailbox::Mailbox;

/// Takes poses from `source` until the server stops.
pub fn poses(
    hub: &Arc<Hub>,
    source: &mut dyn PoseSource,
    mut referee: Referee,
    newest: &Mailbox<Option<PoseSample>>,
) {
    let vehicle = &*hub.vehicles[0];
    let mut flights = vehicle.flights();
    let (mut rejected, mut warned) = (0u64, None::<Instant>);
    while !hub.stop.is_set() {
        let due = referee.poll_timeout().map_or(PATIENCE, |due| {
            Duration::from_secs_f64(due.seconds_since(clock::now()).clamp(0.0, 1.0))
        });
        let measured = source.receive(due.min(PATIENCE));
        // While packets keep coming, time is theirs: after a pause they arrive in a burst, each
        // old by now but followed by a newer one, and that is not a lost pose.
        let mut judged_at = clock::now();
        // A new runtime on the ground is a new flight: course and timer start afresh.
        let now_flights = vehicle.flights();
        if now_flights != flights {
            flights = now_flights;
            referee.restart();
        }
        if let Some(measured) = measured {
            let _span = trace_span!("pose", stamp_ns = measured.stamp.as_ns()).entered();
            match referee.handle_measurement(measured.stamp, measured.world_from_body) {
                Ok(sample) => {
                    judged_at = sample.stamp;
                    vehicle.pose.send_replace(Some(sample));
                    newest.put(Some(sample));
                    lock(&vehicle.trail).add(&sample);
                }
                Err(reason) => {
                    rejected += 1;
                    // Two frames of one burst may bear the same stamp: no fault of anyone's.
                    let same = matches!(reason, Rejected::Stale);
                    if same {
                        judged_at = measured.stamp;
                    }
                    if !same && warned.is_none_or(|at| at.elapsed() > WARN_EVERY) {
                        warned = Some(Instant::now());
                        warn!("{reason}");
                        vehicle.note(&reason.to_string());
                    }
                }
            }
            hub.stats.pose.add(measured.arrival, clock::now());
        }
        referee.handle_timeout(judged_at);
        while let Some(event) = referee.poll_event() {
            vehicle.log(Origin::Server, event);
        }
        while let Some(warning) = source.next_warning() {
            warn!("{warning}");
            vehicle.note(&warning);
        }
        *lock(&hub.source) = SourceCounters { rejected, ..source.counters() };
    }
}

/// Draws the newest pose until the server stops: each tick the cameras that are due.
///
/// # Errors
/// None; a camera that the renderer refuses is logged once and the tick left out.
pub fn draw(
    hub: &Arc<Hub>,
    renderer: &mut dyn Rasterizer,
    newest: &Mailbox<Option<PoseSample>>,
    ticks: &Ticks,
    max_rate_hz: f64,
) {
    let vehicle = &*hub.vehicles[0];
    let mut schedule = Schedule::new(max_rate_hz, Instant::now());
    let mut cameras: Vec<Camera> = Vec::with_capacity(MAX_CAMERAS);
    // The renderer wants the images of the cameras that are due side by side.
    let mut images: Vec<RgbdImage> = Vec::new();
    let (mut seq, mut refused) = (0u64, false);
    while !hub.stop.is_set() {
        if !hub.outlet.wait_for_interest(PATIENCE).contains(&true) {
            continue;
        }
        let next = schedule.next(&vehicle.cameras.newest().configs, Instant::now());
        if let Some(early) = next.checked_duration_since(Instant::now()) {
            std::thread::sleep(early.min(PATIENCE));
            if early > PATIENCE {
                continue;
            }
        }
        let Some(Some(sample)) = newest.take(PATIENCE) else { continue };
        let set = vehicle.cameras.newest();
        let due = schedule.take(&set.configs, Instant::now());
        seq += 1;
        let span = trace_span!("tick", seq, stamp_ns = sample.stamp.as_ns()).entered();
        let mut tick = ticks.spare();
        tick.slots.resize_with(set.configs.len(), Default::default);
        cameras.clear();
        for (index, slot) in tick.slots.iter_mut().enumerate() {
            slot.fresh = due[index];
            if !slot.fresh {
                continue;
            }
            let (config, info) = (&set.configs[index], &set.infos[index]);
            cameras.push(Camera {
                intrinsics: info.intrinsics,
                world_from_cam: sample.world_from_body * info.body_from_cam,
                near_m: config.near_m as f32,
                background: BACKGROUND,
            });
            slot.seq = seq;
            slot.pose = sample.stamp;
            slot.world_from_body = Some(sample.world_from_body);
            (slot.vehicle, slot.camera) = (vehicle.index, index);
            slot.set = Some(set.clone());
            images.resize_with(images.len().max(cameras.len()), Default::default);
            std::mem::swap(&mut images[cameras.len() - 1], &mut slot.image);
        }
        let images = &mut images[..cameras.len()];
        let start = clock::now();
        let result = trace_span!("render").in_scope(|| renderer.render(&[], &cameras, images));
        let end = clock::now();
        drop(span);
        for (slot, image) in tick.slots.iter_mut().filter(|slot| slot.fresh).zip(images) {
            std::mem::swap(image, &mut slot.image);
            (slot.render_start, slot.render_end) = (start, end);
        }
        match result {
            Ok(_) => {
                hub.stats.render.add(start, end);
                if seq.is_multiple_of(NAME_TICKS) {
                    note_renderer(hub, renderer);
                }
                let skipped = ticks.publish(tick, hub.outlet.viewers() > 0);
                hub.stats.ticks.fetch_add(1, Ordering::Relaxed);
                hub.stats.ticks_skipped.fetch_add(u64::from(skipped), Ordering::Relaxed);
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

/// Tells when another renderer has taken over, as the processor does from a lost graphics device.
fn note_renderer(hub: &Hub, renderer: &dyn Rasterizer) {
    let name = renderer.name();
    let mut info = lock(&hub.renderer);
    if info.name != name {
        let text = format!("the renderer is now {name}");
        *info = RendererInfo { name, reason: "took over in flight".to_owned() };
        drop(info);
        for vehicle in &hub.vehicles {
            vehicle.tell(EventKind::Note, &text);
        }
    }
}

/// When each camera is due.
#[derive(Debug)]
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

/// How long a stop may go unnoticed.
const PATIENCE: Duration = Duration::from_millis(100);
/// A source that sends nonsense does so 200 times a second.
const WARN_EVERY: Duration = Duration::from_secs(5);
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
