//! Render thread: newest motions in, rendered ticks out.
//!
//! ```text
//! newest motions, predicted to the instant of the image -> due cameras of all vehicles
//! in one call -> rendered ticks, as fast as possible, at most --max-rate and each
//! camera's own rate; rests without demand for images
//! ```
//! The renderer limits the rate. After every buffer has been used once, no memory is allocated
//! (tests/allocation.rs). It is a plain thread, because rendering would block tokio's workers.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tracing::{trace_span, warn};
use vizflyt_arena::config::{EnvironmentConfig, MAX_OBJECTS, MAX_VEHICLES};
use vizflyt_protocol::messages::{EventKind, MAX_CAMERAS};
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::weather::{Moment, WeatherPass};
use vizflyt_splat::{Camera, Placement, Rasterizer, RenderError, RgbdImage};

use crate::clock;
use crate::flights::Flights;
use crate::poses::newest::{Localized, NewestPoses};
use crate::render::cameras::{CameraSet, RenderedCameras};
use crate::render::demand::Demand;
use crate::render::environment::{atmosphere, weather};
use crate::render::imaging::{CameraEffects, EffectInput};
use crate::render::inputs::Inputs;
use crate::render::rendered::{RenderQueue, RenderedImage, RenderedTick};
use crate::render::schedule::{CameraSchedule, Exposure, Periods};
use crate::render::{RendererInfo, Rendering};
use crate::stop::Stop;
use vizflyt_process::lock;

/// Renders the newest poses until the server stops: in each tick the due cameras of all vehicles with demand
/// for images.
///
/// Ticks that the renderer rejects are skipped; only the first error is logged.
pub fn run<D: Demand>(
    inputs: Inputs<'_, D>,
    renderer: &mut dyn Rasterizer,
    ticks: &RenderQueue,
    max_rate_hz: f64,
    stop: &Stop,
) {
    let Inputs { localization, demand, .. } = inputs;
    let mut render = RenderLoop::new(inputs, max_rate_hz);
    while !stop.is_set() {
        let wanted = demand.wait_for_interest(PATIENCE);
        if !wanted.contains(&true) {
            continue;
        }
        render.follow_cameras();
        render.newest = localization.newest();
        let wait = render.until_due(wanted);
        if !wait.is_zero() {
            // A newer pose may make an image due at once.
            localization.accepted.take(wait);
            continue;
        }
        let mut tick = ticks.new_tick();
        let stamp = render.expose(wanted, &mut tick);
        match render.rasterize(renderer, stamp, &mut tick) {
            Ok(()) => render.publish(tick, ticks, renderer),
            Err(error) => render.report_refused(&error),
        }
    }
}

/// State of the loop; every buffer is reused.
struct RenderLoop<'a, D> {
    rendering: &'a Rendering,
    flights: &'a Flights,
    demand: &'a D,
    periods: Periods,
    /// Due times of each vehicle's cameras.
    schedules: Vec<CameraSchedule>,
    /// Cameras of each vehicle, at the size for its link.
    sets: Vec<Arc<CameraSet>>,
    rendered_cameras: [RenderedCameras; MAX_VEHICLES],
    /// Poses of this tick.
    newest: NewestPoses,
    /// Stamp of the pose from which each vehicle was last rendered.
    rendered: [Option<ServerTime>; MAX_VEHICLES],
    /// Cameras of all vehicles in one tick, and their ranges by vehicle.
    cameras: Vec<Camera>,
    ranges: [CameraRange; MAX_VEHICLES],
    /// Moment of each camera's image, and the common environment.
    moments: Vec<Moment>,
    environment: EnvironmentConfig,
    weather: WeatherPass,
    /// Images in the order of the cameras, as the renderer requires.
    images: Vec<RgbdImage>,
    placements: Vec<Placement>,
    /// Effects by camera and vehicle, with [`MAX_CAMERAS`] entries per vehicle.
    imaging: Vec<CameraEffects>,
    seq: u64,
    refused: bool,
}

impl<'a, D: Demand> RenderLoop<'a, D> {
    fn new(inputs: Inputs<'a, D>, max_rate_hz: f64) -> Self {
        let Inputs { rendering, flights, demand, .. } = inputs;
        let least_ns = (1e9 / max_rate_hz) as i64;
        Self {
            rendering,
            flights,
            demand,
            periods: Periods { default_ns: least_ns, least_ns, together_ns: TOGETHER_NS },
            schedules: vec![CameraSchedule::new(clock::now()); rendering.cameras.len()],
            sets: Vec::with_capacity(MAX_VEHICLES),
            rendered_cameras: Default::default(),
            newest: NewestPoses::default(),
            rendered: Default::default(),
            cameras: Vec::with_capacity(MAX_VEHICLES * MAX_CAMERAS),
            ranges: Default::default(),
            moments: Vec::with_capacity(MAX_VEHICLES * MAX_CAMERAS),
            environment: EnvironmentConfig::default(),
            weather: WeatherPass::default(),
            images: Vec::new(),
            placements: Vec::with_capacity(MAX_OBJECTS + MAX_VEHICLES),
            imaging: (0..rendering.cameras.len() * MAX_CAMERAS)
                .map(|_| CameraEffects::default())
                .collect(),
            seq: 0,
            refused: false,
        }
    }

    /// Reads the runtimes' changes of cameras, and the image sizes for the links.
    fn follow_cameras(&mut self) {
        self.sets.clear();
        let vehicles = self.rendering.cameras.iter().zip(&mut self.rendered_cameras).enumerate();
        self.sets.extend(vehicles.map(|(vehicle, (cameras, rendered))| {
            rendered.follow(cameras.newest(), self.demand.shrink(vehicle))
        }));
    }

    /// Returns the pose of a vehicle if it is newer than the last rendered one.
    fn unrendered(&self, vehicle: usize) -> Option<Localized> {
        self.newest[vehicle].filter(|newest| Some(newest.sample.stamp) != self.rendered[vehicle])
    }

    /// Returns the time until a camera is due. If none can be rendered, a newer pose, also of another vehicle,
    /// ends the wait.
    fn until_due(&mut self, wanted: [bool; MAX_VEHICLES]) -> Duration {
        let now = clock::now();
        let mut next: Option<ServerTime> = None;
        for (vehicle, set) in self.sets.iter().enumerate() {
            if !wanted[vehicle] || self.unrendered(vehicle).is_none() {
                continue;
            }
            let schedule = &mut self.schedules[vehicle];
            schedule.hasten(&set.configs, &self.periods, now);
            next = next.into_iter().chain(schedule.next(&set.configs)).min();
        }
        next.map_or(PATIENCE, |next| {
            Duration::from_nanos(next.as_ns().saturating_sub(now.as_ns())).min(PATIENCE)
        })
    }

    /// Collects the due cameras, each at the predicted pose of its vehicle, and sets the metadata of their
    /// images in `tick`. Returns the newest pose's stamp.
    fn expose(&mut self, wanted: [bool; MAX_VEHICLES], tick: &mut RenderedTick) -> ServerTime {
        self.seq += 1;
        let slots = self.sets.iter().map(|set| set.configs.len()).sum();
        tick.slots.resize_with(slots, Default::default);
        let mut slots = tick.slots.iter_mut();
        let mut stamp = ServerTime::ZERO;
        self.cameras.clear();
        self.moments.clear();
        self.environment = self.rendering.environment.now();
        let atmosphere = atmosphere(&self.environment);
        self.ranges = Default::default();
        for (vehicle, set) in self.sets.iter().enumerate() {
            let mut due = [false; MAX_CAMERAS];
            // A vehicle's pose is kept until one of its cameras is due.
            let sample = self.unrendered(vehicle).filter(|_| wanted[vehicle]).inspect(|_| {
                due = self.schedules[vehicle].take(&set.configs, &self.periods, clock::now());
            });
            if let (true, Some(newest)) = (due.contains(&true), sample) {
                self.rendered[vehicle] = Some(newest.sample.stamp);
            }
            let after_ns = self.demand.seen_after_s(vehicle).map(|s| (s * 1e9) as i64);
            let shown = sample.map(|newest| {
                Exposure::new(self.rendering.predict, after_ns, &newest, clock::now())
            });
            let flies = self.flights.vehicles[vehicle].runtime().is_some();
            let first = self.cameras.len();
            for (camera, slot) in slots.by_ref().take(set.configs.len()).enumerate() {
                slot.fresh = due[camera];
                let (true, Some(Localized { sample, .. }), Some(exposure)) =
                    (slot.fresh, sample, shown)
                else {
                    continue;
                };
                let (config, info) = (&set.configs[camera], &set.infos[camera]);
                self.cameras.push(exposure.camera(config, info, atmosphere));
                self.moments.push(exposure.moment(self.rendering.seed));
                stamp = stamp.max(sample.stamp);
                (slot.vehicle, slot.camera) = (vehicle, camera);
                slot.counted = flies;
                slot.seq = self.seq;
                (slot.pose, slot.shown) = (sample.stamp, exposure.at);
                slot.world_from_body = Some(exposure.world_from_body);
                slot.set = Some(set.clone());
                let images = &mut self.images;
                images.resize_with(images.len().max(self.cameras.len()), Default::default);
                std::mem::swap(&mut images[self.cameras.len() - 1], &mut slot.image);
            }
            let at = shown.map_or(ServerTime::ZERO, |exposure| exposure.at);
            self.ranges[vehicle] = CameraRange { first, end: self.cameras.len(), at };
        }
        stamp
    }

    /// Renders the collected cameras into `tick`.
    fn rasterize(
        &mut self,
        renderer: &mut dyn Rasterizer,
        stamp: ServerTime,
        tick: &mut RenderedTick,
    ) -> Result<(), RenderError> {
        let span = trace_span!("tick", seq = self.seq, stamp_ns = stamp.as_ns()).entered();
        let Self { rendering, cameras, moments, environment, placements, newest, .. } = self;
        let images = &mut self.images[..cameras.len()];
        let start = clock::now();
        let result = trace_span!("render").in_scope(|| {
            if rendering.dynamic_objects.is_empty() {
                renderer.render(&[], cameras, images)?;
            } else {
                // Each vehicle sees the instant of its images, and not itself.
                let mut ranges =
                    self.ranges.iter().enumerate().filter(|(_, range)| range.first < range.end);
                ranges.try_for_each(|(vehicle, &CameraRange { first, end, at })| {
                    placements.clear();
                    rendering.dynamic_objects.place(at, vehicle, newest, placements);
                    let images = &mut images[first..end];
                    renderer.render(placements, &cameras[first..end], images).map(|_| ())
                })?;
            }
            let weather = weather(environment);
            for ((image, camera), moment) in images.iter_mut().zip(cameras).zip(moments) {
                self.weather.apply(&weather, camera, moment, image);
            }
            Ok(())
        });
        for (slot, image) in tick.slots.iter_mut().filter(|slot| slot.fresh).zip(images) {
            std::mem::swap(image, &mut slot.image);
            slot.render_start = start;
            if result.is_ok() {
                take_image(&mut self.imaging, rendering.seed, newest, slot);
            }
        }
        let end = clock::now();
        drop(span);
        tick.slots.iter_mut().filter(|slot| slot.fresh).for_each(|slot| slot.render_end = end);
        result.inspect(|()| rendering.durations.add(start, end))
    }

    /// Passes the tick to the encoder, and counts it.
    fn publish(&self, tick: RenderedTick, ticks: &RenderQueue, renderer: &dyn Rasterizer) {
        if self.seq.is_multiple_of(NAME_TICKS) {
            note_renderer(self.rendering, self.flights, renderer);
        }
        for slot in tick.slots.iter().filter(|slot| slot.fresh && slot.counted) {
            self.demand.count_rendered(slot.vehicle, slot.camera);
        }
        let watched = self.demand.has_viewers() || self.flights.any_under_way();
        let skipped = ticks.publish(tick, watched);
        self.rendering.ticks.fetch_add(1, Ordering::Relaxed);
        self.rendering.ticks_skipped.fetch_add(u64::from(skipped), Ordering::Relaxed);
    }

    /// Logs the first tick that the renderer rejects.
    fn report_refused(&mut self, error: &RenderError) {
        if !std::mem::replace(&mut self.refused, true) {
            warn!("tick {} is not rendered: {error}; further errors are not logged", self.seq);
        }
    }
}

/// Applies the effects of the camera to a rendered image.
fn take_image(
    effects: &mut [CameraEffects],
    seed: u64,
    newest: &NewestPoses,
    slot: &mut RenderedImage,
) {
    let RenderedImage { vehicle, camera, seq, .. } = *slot;
    let (Some(set), Some(newest), Some(world_from_body)) =
        (&slot.set, &newest[vehicle], slot.world_from_body)
    else {
        return;
    };
    let (config, info) = (&set.configs[camera], &set.infos[camera]);
    let v_world_mps = newest.motion.v_world_mps;
    let exposure = Exposure { at: slot.shown, world_from_body, v_world_mps };
    let camera = vehicle * MAX_CAMERAS + camera;
    let seeds = [seed, camera as u64, seq];
    let input = EffectInput { config, info, motion: &newest.motion, exposure, seeds };
    effects[camera].apply(&input, &mut slot.image);
}

/// Range of one vehicle's cameras in a tick, and the instant of their images.
#[derive(Clone, Copy, Debug, Default)]
struct CameraRange {
    first: usize,
    end: usize,
    at: ServerTime,
}

/// Reports a change of the renderer, as when the processor takes over from a lost graphics device.
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

/// Maximum delay until a stop is noticed.
const PATIENCE: Duration = Duration::from_millis(100);
/// Number of ticks between checks of the renderer's name: about a second.
const NAME_TICKS: u64 = 64;
/// Less than any sensor resolves, more than the rounding of clocks. [ns]
const TOGETHER_NS: i64 = 1_000_000;
