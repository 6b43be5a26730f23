//! The two threads that drive everything: poses in, drawn ticks out.
//!
//! ```text
//! pose thread:   source, IMUs -> a Referee for each vehicle (filter, rules) -> pose, trail, events
//!                                                              \-> newest motions (mailbox)
//! render thread: newest motions, moved on to when the image is seen -> the cameras that are due,
//!                all vehicles' in one call -> drawn ticks, as fast as the machine draws, at most
//!                --max-rate and each camera's own rate; rests while nobody wants images
//! ```
//! Budget of the pose thread: 20 us a pose, at 200 Hz for each vehicle, bounded by the referee's
//! swept query. The render thread is bounded by the renderer; it allocates nothing once every
//! buffer has been used (tests/allocation.rs). Both are plain threads: tokio's timers are a millisecond
//! late, and drawing would block its workers.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use tracing::{trace_span, warn};
use vizflyt_arena::Referee;
use vizflyt_arena::config::{CameraConfig, MAX_OBJECTS};
use vizflyt_arena::neighbours::Neighbour;
use vizflyt_arena::pose::{Motion, Predict, Rejected};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::messages::{EventKind, MAX_CAMERAS, PoseSample};
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::{Camera, Placement, Rasterizer, RgbdImage};

use crate::cameras::{CameraSet, DrawnCameras};
use crate::clock;
use crate::drawn::Ticks;
use crate::drivers::{PoseSource, SourceCounters};
use crate::environment::air;
use crate::events::Origin;
use crate::hub::{Hub, MAX_VEHICLES, RendererInfo, lock};
use crate::mailbox::Mailbox;
use crate::vehicle::Vehicle;

/// The newest poses on their way to the render thread, by vehicle.
pub type Poses = [Option<Localized>; MAX_VEHICLES];

/// Where a vehicle is, and whereto it moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Localized {
    /// The newest believed pose.
    pub sample: PoseSample,
    /// How it moves by all that was read.
    pub motion: Motion,
}

impl Localized {
    /// Makes that of a vehicle that stands still.
    pub fn still(sample: PoseSample) -> Self {
        Self { sample, motion: Motion::at_rest(sample.stamp, sample.world_from_body) }
    }
}

/// Takes poses from `source` until the server stops; `referees` has one for each vehicle.
pub fn poses(
    hub: &Arc<Hub>,
    source: &mut dyn PoseSource,
    referees: &mut [Referee],
    newest: &Mailbox<Poses>,
) {
    let flights = hub.vehicles.iter().map(|vehicle| vehicle.flights());
    let mut watches: Vec<_> =
        flights.map(|flights| Watch { flights, ..Watch::default() }).collect();
    let mut quality_told = Instant::now();
    while !hub.stop.is_set() {
        let due = referees.iter().filter_map(Referee::poll_timeout).min();
        let due = due.map_or(PATIENCE, |due| {
            Duration::from_secs_f64(due.seconds_since(clock::now()).clamp(0.0, 1.0))
        });
        let measured = source.receive(due.min(PATIENCE));
        for ((vehicle, referee), watch) in hub.vehicles.iter().zip(&mut *referees).zip(&mut watches)
        {
            // A new runtime on the ground is a new flight: course and timer start afresh.
            let flights = vehicle.flights();
            if flights != watch.flights {
                watch.flights = flights;
                referee.restart();
            }
        }
        for (vehicle, referee) in hub.vehicles.iter().zip(&mut *referees) {
            while let Some(reading) = vehicle.next_feeling() {
                referee.handle_imu(&reading);
            }
        }
        // While packets keep coming, time is theirs: after a pause they arrive in a burst, each
        // old by now but followed by a newer one, and that is not a lost pose, of any vehicle.
        let mut judged_at = None;
        let mut believed = Poses::default();
        for measured in measured {
            let index = measured.vehicle;
            let _span = trace_span!("pose", stamp_ns = measured.stamp.as_ns()).entered();
            let judging = referees[index].is_judging();
            match referees[index].handle_measurement(&measured.weighed()) {
                Ok(sample) => {
                    judged_at = judged_at.max(Some(sample.stamp));
                    believed[index] =
                        referees[index].motion().map(|motion| Localized { sample, motion });
                    introduce(hub, referees, index);
                    let vehicle = &hub.vehicles[index];
                    vehicle.pose.send_replace(Some(sample));
                    lock(&vehicle.trail).add(&sample);
                    let referee = &referees[index];
                    // What ends the flight belongs to it.
                    let ends = judging && !referee.is_judging();
                    if ends || referee.is_judging() {
                        let clearance_m = referee.clearance_m(sample.world_from_body.translation_m);
                        let least_m = referee.least_clearance_m();
                        let mut samples = lock(&vehicle.samples);
                        if ends {
                            samples.end(&sample, clearance_m, least_m);
                        } else {
                            samples.add(&sample, clearance_m, least_m);
                        }
                    }
                }
                // Two frames of one burst may bear the same stamp: no fault of anyone's.
                Err(Rejected::Stale) => {
                    watches[index].rejected += 1;
                    judged_at = judged_at.max(Some(measured.stamp));
                }
                Err(reason) => {
                    let name = hub.source_names.get(usize::from(measured.source));
                    watches[index].rejected(&hub.vehicles[index], name, reason);
                }
            }
            hub.stats.pose.add(measured.arrival, clock::now());
        }
        if believed.iter().any(Option::is_some) {
            publish(newest, &believed);
        }
        let judged_at = judged_at.unwrap_or_else(clock::now);
        let mut all = SourceCounters::default();
        for ((vehicle, referee), watch) in hub.vehicles.iter().zip(&mut *referees).zip(&watches) {
            referee.handle_timeout(judged_at);
            while let Some(event) = referee.poll_event() {
                vehicle.log(Origin::Server, event);
            }
            let own = source.counters(vehicle.index);
            let own = SourceCounters { rejected: watch.rejected, ..own };
            *lock(&vehicle.source) = own;
            if quality_told.elapsed() > QUALITY_EVERY {
                tell_quality(hub, vehicle, referee);
            }
            all = all.and(own);
        }
        while let Some(warning) = source.next_warning() {
            warn!("{warning}");
            hub.note(&warning);
        }
        *lock(&hub.source) = all;
        if quality_told.elapsed() > QUALITY_EVERY {
            quality_told = Instant::now();
        }
    }
}

/// Tells the other vehicles' referees where a vehicle is.
fn introduce(hub: &Hub, referees: &mut [Referee], index: usize) {
    if hub.moving.vehicles < 2 {
        return;
    }
    let vehicle = &hub.vehicles[index];
    let (name, radius_m) = (vehicle.name.clone(), vehicle.arena.body_radius_m);
    let neighbour = referees[index].motion().map(|motion| Neighbour { name, motion, radius_m });
    let others = referees.iter_mut().enumerate().filter(|(other, _)| *other != index);
    for (_, referee) in others {
        referee.handle_neighbour(index, neighbour.clone());
    }
}

/// Tells the page how good a vehicle's localization is.
fn tell_quality(hub: &Hub, vehicle: &Vehicle, referee: &Referee) {
    let mut quality = referee.quality(clock::now());
    for source in &mut quality.sources {
        if let Some(name) = hub.source_names.get(usize::from(source.source)) {
            source.name.clone_from(name);
        }
    }
    *lock(&vehicle.quality) = quality;
}

/// What the pose thread remembers of one vehicle.
#[derive(Debug, Default)]
struct Watch {
    flights: u64,
    rejected: u64,
    warned: Option<(Instant, std::mem::Discriminant<Rejected>)>,
}

impl Watch {
    fn rejected(&mut self, vehicle: &Vehicle, source: Option<&String>, reason: Rejected) {
        self.rejected += 1;
        // What is wrong in another way than before is news.
        let kind = std::mem::discriminant(&reason);
        let told = self.warned.is_some_and(|(at, told)| told == kind && at.elapsed() < WARN_EVERY);
        let quiet = self.warned.is_some_and(|(at, _)| at.elapsed() < WARN_APART);
        if told || quiet {
            return;
        }
        self.warned = Some((Instant::now(), kind));
        let text = source.map_or_else(|| reason.to_string(), |name| format!("{name}: {reason}"));
        warn!("{}: {text}", vehicle.name);
        vehicle.note(&text);
    }
}

/// Draws the newest poses until the server stops: each tick the cameras that are due of the
/// vehicles that someone wants images of.
///
/// # Errors
/// None; a camera that the renderer refuses is logged once and the tick left out.
pub fn draw(
    hub: &Arc<Hub>,
    renderer: &mut dyn Rasterizer,
    newest: &Mailbox<Poses>,
    ticks: &Ticks,
    max_rate_hz: f64,
) {
    let schedule = Schedule::new(max_rate_hz, Instant::now());
    let mut schedules = vec![schedule; hub.vehicles.len()];
    let mut sets: Vec<Arc<CameraSet>> = Vec::with_capacity(MAX_VEHICLES);
    let mut drawn_cameras: [DrawnCameras; MAX_VEHICLES] = Default::default();
    let mut cameras: Vec<Camera> = Vec::with_capacity(MAX_VEHICLES * MAX_CAMERAS);
    // The renderer wants the images of the cameras that are due side by side.
    let mut images: Vec<RgbdImage> = Vec::new();
    // Poses that nothing was drawn from yet; and the newest of each vehicle, for the others' images.
    let (mut poses, mut known) = (Poses::default(), Poses::default());
    let mut placements: Vec<Placement> = Vec::with_capacity(MAX_OBJECTS + MAX_VEHICLES);
    let (mut seq, mut refused) = (0u64, false);
    while !hub.stop.is_set() {
        let wanted = hub.outlet.wait_for_interest(PATIENCE);
        if !wanted.contains(&true) {
            continue;
        }
        sets.clear();
        sets.extend(hub.vehicles.iter().zip(&mut drawn_cameras).map(|(vehicle, drawn)| {
            drawn.follow(vehicle.cameras.newest(), vehicle.level().shrink)
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
        let air = air(&hub.environment.now());
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
            let after_s = hub.vehicles[vehicle].seen_after_s();
            let shown = sample.map(|newest| shown(hub.predict, after_s, &newest, clock::now()));
            let flies = hub.vehicles[vehicle].runtime().is_some();
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
                    air,
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
            if hub.moving.is_empty() {
                return renderer.render(&[], &cameras, images).map(|_| ());
            }
            // Each vehicle sees the moment that its images show, and not itself.
            let drawn = views.iter().enumerate().filter(|(_, view)| view.first < view.end);
            drawn.into_iter().try_for_each(|(vehicle, &View { first, end, at })| {
                placements.clear();
                hub.moving.place(at, vehicle, &known, &mut placements);
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
                hub.stats.render.add(start, end);
                if seq.is_multiple_of(NAME_TICKS) {
                    note_renderer(hub, renderer);
                }
                for slot in tick.slots.iter().filter(|slot| slot.fresh && slot.counted) {
                    hub.vehicles[slot.vehicle].images.cameras[slot.camera].drew();
                }
                let skipped = ticks.publish(tick, hub.wants_previews());
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

/// Puts `believed` where the render thread takes it from; what it has not taken yet of vehicles
/// without a new pose is still their newest.
fn publish(newest: &Mailbox<Poses>, believed: &Poses) {
    newest.put_over(*believed, |poses, older| {
        for (pose, older) in poses.iter_mut().zip(older) {
            *pose = pose.or(*older);
        }
    });
}

/// Takes the poses of `newer` into `poses`, where there are any.
fn merge(newer: &Poses, poses: &mut Poses) {
    for (pose, newer) in poses.iter_mut().zip(newer) {
        *pose = newer.or(*pose);
    }
}

/// Tells when another renderer has taken over, as the processor does from a lost graphics device.
fn note_renderer(hub: &Hub, renderer: &dyn Rasterizer) {
    let name = renderer.name();
    let mut info = lock(&hub.renderer);
    if info.name != name {
        let text = format!("the renderer is now {name}");
        *info = RendererInfo { name: name.into_owned(), reason: "took over in flight".to_owned() };
        drop(info);
        for vehicle in &hub.vehicles {
            vehicle.tell(EventKind::Note, &text);
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
/// A source that sends nonsense does so 200 times a second.
const WARN_EVERY: Duration = Duration::from_secs(5);
/// Several sources that send different nonsense take turns.
const WARN_APART: Duration = Duration::from_secs(1);
/// How often the page hears of the localization's quality.
const QUALITY_EVERY: Duration = Duration::from_millis(100);
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
    fn what_waits_for_the_render_thread_is_every_vehicles_newest() {
        let poses = |at_ns: [Option<u64>; 3]| {
            let mut poses = Poses::default();
            for (pose, at_ns) in poses.iter_mut().zip(at_ns) {
                *pose = at_ns.map(|ns| {
                    let stamp = ServerTime::from_ns(ns);
                    Localized::still(PoseSample::still(stamp, Pose::IDENTITY))
                });
            }
            poses
        };
        let stamps = |poses: &Poses| poses.map(|pose| pose.map(|pose| pose.sample.stamp.as_ns()));
        let newest = Mailbox::default();
        publish(&newest, &poses([Some(1), Some(2), None]));
        publish(&newest, &poses([Some(3), None, None]));
        publish(&newest, &poses([None, None, Some(4)]));
        let mut taken = newest.take(Duration::ZERO).unwrap();
        assert_eq!(stamps(&taken)[..4], [Some(3), Some(2), Some(4), None]);
        merge(&poses([None, Some(5), None]), &mut taken);
        assert_eq!(stamps(&taken)[..4], [Some(3), Some(5), Some(4), None]);
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
