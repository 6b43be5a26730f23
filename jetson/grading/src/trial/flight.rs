//! The loop of a graded flight, tick by tick.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use anyhow::{Context, Result, bail, ensure};
use glam::{DQuat, DVec3};
use sha2::{Digest, Sha256};
use vizflyt_arena::crash::{ClearanceAhead, TimedSetpoint, ahead_m};
use vizflyt_arena::pose::{Measured, Predict};
use vizflyt_arena::verdict::{Sample, judge_ended};
use vizflyt_arena::{ArenaConfig, Referee};
use vizflyt_protocol::flight_end::FlightEnd;
use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::messages::{CameraInfo, Event, FlightPhase, Limits, Odometry, Setpoint};
use vizflyt_protocol::time::{HostTime, ServerTime};
use vizflyt_runtime::flight::FlightSettings;
use vizflyt_runtime::guard::VehicleMotion;
use vizflyt_runtime::lockstep::{Lockstep, PluginProcess};
use vizflyt_runtime::log::VirtualLog;
use vizflyt_runtime::stream::Reading;
use vizflyt_runtime::supervisor::Stream;
use vizflyt_sdk::{ImageStamps, ObservationWriter};
use vizflyt_server::poses::newest::Localized;
use vizflyt_server::render::environment::{atmosphere, weather};
use vizflyt_server::render::imaging::{CameraEffects, EffectInput};
use vizflyt_server::render::schedule::{CameraSchedule, Exposure, Periods, withholds_depth};
use vizflyt_server::render::sensors::{Around, MadeReading, SensorSet, VehicleSensors};
use vizflyt_simulator::simulation::{Simulation, SimulationConfig};
use vizflyt_simulator::startup::Startup;
use vizflyt_splat::sensor::SensorScene;
use vizflyt_splat::weather::WeatherPass;
use vizflyt_splat::{Camera, CpuRenderer, DepthKind, Placement, Rasterizer, RgbdImage, Scene};
use vizflyt_studio::evaluate::Stamped;
use vizflyt_trust::Purpose;

use super::kept::{Keyframes, Lines};
use super::pending::{Pending, Picture};
use super::{AnotherWay, Delays, Reached, Trial, TrialImage, TrialLog, TrialResult};

/// Start of the clocks: so far above zero that no time is negative. [ns]
const START_NS: u64 = 10_000_000_000;
/// Timeout until the vehicle is in the air. [s]
const READY_WITHIN_S: f64 = 60.0;
/// Maximum duration of a flight, including landing. [s]
const LONGEST_S: f64 = 900.0;
/// Minimum image period on the ground: a plugin needs few images before take-off. [ns]
const GROUND_PERIOD_NS: i64 = 200_000_000;
/// The runtime receives every second pose: 100 Hz, as over the network.
const POSES_PER_SENT: u64 = 2;
/// Length of the images before the end in the report. [s]
const SHOWN_S: f64 = 2.0;
/// Interval between these images. [s]
const SHOT_PERIOD_S: f64 = 0.1;
/// Interval between stored true poses. [s]
const TRUTH_PERIOD_S: f64 = 4e-3;
/// Maximum number of true poses before the first estimate: more than 10 s, the maximum age of an
/// estimate.
const TRUTH_BEFORE_FIRST: usize = 2500;

/// Simulated sensors other than cameras, if the course has any.
struct Sensing {
    scene: SensorScene,
    sensors: VehicleSensors,
    /// Readings on their way to the plugin, with the time of arrival.
    pending: VecDeque<(HostTime, MadeReading)>,
}

impl Sensing {
    /// Returns `None` for a course without sensors.
    fn of(set: SensorSet, scene: Scene<'_>, seed: u64) -> Option<Self> {
        if set.configs.is_empty() {
            return None;
        }
        let start = ServerTime::from_ns(START_NS);
        let sensors = VehicleSensors::new(Arc::new(set), start, seed);
        Some(Self { scene: SensorScene::new(scene), sensors, pending: VecDeque::new() })
    }
}

pub(super) struct Flight<'a> {
    trial: &'a Trial<'a>,
    arena: &'a ArenaConfig,
    cameras: Vec<CameraInfo>,
    simulation: Simulation,
    pub(super) lockstep: Lockstep,
    referee: Referee,
    renderer: CpuRenderer,
    weather: WeatherPass,
    images: Vec<RgbdImage>,
    /// Effects of each camera.
    imaging: Vec<CameraEffects>,
    now: HostTime,
    schedule: CameraSchedule,
    sensing: Option<Sensing>,
    poses: u64,
    seq: u64,
    pending: VecDeque<Pending>,
    hash: Sha256,
    events: Vec<Event>,
    samples: Vec<Sample>,
    asked: Vec<TimedSetpoint>,
    seen: Vec<ClearanceAhead>,
    scratch: Vec<u16>,
    shots: VecDeque<TrialImage>,
    keyframes: Keyframes,
    pub(super) lines: Lines,
    pub(super) answered: u64,
    odometry: Vec<Odometry>,
    truth: VecDeque<Stamped>,
    /// End of the flight, according to all events.
    end: FlightEnd,
}

impl<'a> Flight<'a> {
    pub(super) fn new(trial: &'a Trial<'a>, process: PluginProcess) -> Result<Self> {
        let arena = &trial.course.arena;
        let now = HostTime::from_ns(START_NS);
        let config = SimulationConfig {
            spawn_m: arena.spawn.position_m,
            spawn_yaw_rad: arena.spawn.yaw_deg.to_radians(),
            seed: trial.seed(Purpose::Noise),
            body_radius_m: arena.body_radius_m,
            imu: trial.imu,
            // The hash of a flight contains every packet since the start.
            startup: Startup::Realistic,
            ..SimulationConfig::airframe()
        };
        let simulation = Simulation::new(config).context("the simulated autopilot")?;
        let settings = FlightSettings {
            ready_within_s: READY_WITHIN_S,
            time_limit_s: 0.0,
            limits: Limits::NONE,
            slip_seed: trial.seed(Purpose::Slip),
            cameras: Vec::new(),
        };
        let sensors = SensorSet::new(&arena.sensors).context("the course's sensors")?;
        let mut info = arena.info();
        info.sensors = sensors.infos.iter().cloned().collect();
        let (splats, objects) = (&trial.course.splats, &trial.course.objects[..]);
        let scene = Scene { splats, objects };
        let sensing = Sensing::of(sensors, scene, trial.seed(Purpose::Sensors));
        let renderer = CpuRenderer::new(scene);
        let mut hash = Sha256::new();
        hash.update(renderer.name().as_bytes());
        let mut lockstep =
            Lockstep::new(now, &info, settings, Some(process), trial.delays.answer_ns);
        if let Some(TrialLog { file, images, depth, plugin }) = &trial.log {
            let log = file
                .try_clone()
                .map_err(anyhow::Error::from)
                .and_then(|file| Ok(VirtualLog::new(file, *images, plugin, *depth, now)?));
            lockstep.set_log(log.context("the flight's log cannot be written")?);
        }
        Ok(Self {
            trial,
            arena,
            cameras: info.cameras.to_vec(),
            simulation,
            lockstep,
            referee: Referee::new(arena, trial.course.obstacles.clone())
                .counting_from(ServerTime::from_ns(START_NS)),
            renderer,
            weather: WeatherPass::default(),
            images: Vec::new(),
            imaging: info.cameras.iter().map(|_| CameraEffects::default()).collect(),
            now,
            schedule: CameraSchedule::new(ServerTime::from_ns(START_NS)),
            sensing,
            poses: 0,
            seq: 0,
            pending: VecDeque::new(),
            hash,
            events: Vec::new(),
            samples: Vec::new(),
            asked: Vec::new(),
            seen: Vec::new(),
            scratch: Vec::new(),
            shots: VecDeque::new(),
            keyframes: Keyframes::default(),
            lines: Lines::default(),
            answered: 0,
            odometry: Vec::new(),
            truth: VecDeque::new(),
            end: FlightEnd::default(),
        })
    }

    /// Logs the lines that the plugin has printed since the last call.
    pub(super) fn log_lines(&mut self) {
        let Some(log) = self.lockstep.log() else { return self.lines.fresh.clear() };
        for (stream, text) in self.lines.fresh.drain(..) {
            let stream = match stream {
                Stream::Stdout => "stdout",
                Stream::Stderr => "stderr",
            };
            log.line(self.now, stream, &text, self.seq);
        }
    }

    /// Flies to the end; returns false if stopped.
    pub(super) fn run(&mut self) -> Result<bool> {
        self.lockstep.begin(self.now, &mut self.lines.sink())?;
        self.log_lines();
        loop {
            if self.trial.stop.load(Ordering::Relaxed) {
                return Ok(false);
            }
            // At least one tick: a plugin that fails at its start also causes an event of the
            // flight.
            self.tick()?;
            if self.lockstep.companion.flight().outcome().is_some() {
                return Ok(true);
            }
            let virtual_s = self.virtual_s();
            if virtual_s > LONGEST_S {
                bail!("the flight is not over after {virtual_s:.0} s of virtual time");
            }
        }
    }

    fn tick(&mut self) -> Result<()> {
        self.simulation.tick();
        self.now = HostTime::from_ns(START_NS + self.simulation.now().as_ns());
        let mut buffer = [0; MAX_PACKET];
        while let Some(packet) = self.simulation.poll_mavlink(&mut buffer) {
            self.lockstep.companion.handle_mavlink(self.now, packet);
        }
        self.localize();
        self.draw()?;
        self.sense();
        while self.pending.front().is_some_and(|pending| pending.due <= self.now) {
            if let Some(pending) = self.pending.pop_front() {
                self.show(&pending)?;
            }
        }
        self.lockstep.handle_timeout(self.now);
        while let Some(event) = self.lockstep.companion.poll_event() {
            self.referee.handle_event(&event);
            self.note(event);
        }
        while let Some(datagram) = self.lockstep.companion.poll_transmit() {
            self.hash.update(&*datagram);
            self.simulation.handle_mavlink(0, &datagram);
        }
        self.hash_state();
        Ok(())
    }

    /// Passes poses from motion capture through pose filter and rules.
    fn localize(&mut self) {
        let (referee, companion) = (&mut self.referee, &mut self.lockstep.companion);
        let mut readings = Vec::new();
        companion.drain_imu(|sample, reading| {
            referee.handle_imu(&reading);
            readings.push(*sample);
        });
        if let Some(log) = self.lockstep.log() {
            for sample in &readings {
                log.imu(sample);
            }
        }
        while let Some(sight) = self.simulation.poll_mocap() {
            let stamp = ServerTime::from_ns(START_NS + sight.at.as_ns());
            let arrival = self.server_now();
            let measured = Measured { arrival, ..Measured::new(stamp, sight.world_from_body) };
            let Ok(sample) = self.referee.handle_measurement(&measured) else { continue };
            let p_world_m = sample.world_from_body.translation_m;
            self.samples.push(Sample {
                stamp: sample.stamp,
                p_world_m,
                v_world_mps: sample.twist.linear_mps,
                yaw_rad: VehicleMotion::of(&sample, self.now).yaw_rad(),
                clearance_m: self.referee.clearance_m(p_world_m),
            });
            self.poses += 1;
            if self.poses.is_multiple_of(POSES_PER_SENT) {
                let stamp = HostTime::from_ns(sample.stamp.as_ns());
                self.lockstep.companion.handle_pose(self.now, &sample, stamp);
                if let Some(log) = self.lockstep.log() {
                    log.pose(self.now, stamp, &sample);
                }
            }
        }
        let now = self.server_now();
        self.referee.handle_timeout(now);
        while let Some(event) = self.referee.poll_event() {
            self.note(event.clone());
            self.lockstep.companion.handle_event(self.now, &event);
        }
    }

    /// Renders the cameras that are due.
    fn draw(&mut self) -> Result<()> {
        let phase = self.lockstep.companion.flight().phase();
        if matches!(phase, FlightPhase::Landing | FlightPhase::Landed) {
            return Ok(());
        }
        let (Some(motion), Some(sample)) = (self.referee.motion(), self.referee.newest().copied())
        else {
            return Ok(());
        };
        let on_ground = matches!(phase, FlightPhase::Connecting | FlightPhase::Preparing);
        let Delays { image_period_ns, image_ns, .. } = self.trial.delays;
        let periods = Periods {
            default_ns: image_period_ns,
            least_ns: if on_ground { GROUND_PERIOD_NS } else { 0 },
            together_ns: 0,
        };
        let now = self.server_now();
        let taken = self.schedule.take(&self.arena.cameras, &periods, now);
        let due: Vec<usize> = (0..self.cameras.len()).filter(|&index| taken[index]).collect();
        if due.is_empty() {
            return Ok(());
        }
        let newest = Localized { sample, motion };
        let exposure = Exposure::new(Predict::Seen, Some(image_ns), &newest, now);
        let atmosphere = atmosphere(&self.arena.environment);
        let (configs, infos) = (&self.arena.cameras, &self.cameras);
        let camera = |&index: &usize| exposure.camera(&configs[index], &infos[index], atmosphere);
        let cameras: Vec<Camera> = due.iter().map(camera).collect();
        self.images.resize_with(cameras.len().max(self.images.len()), RgbdImage::default);
        let images = &mut self.images[..cameras.len()];
        // Moving objects are placed for the instant that the images show, as for the referee.
        let since_start_ns = exposure.at.as_ns().wrapping_sub(START_NS).cast_signed();
        let placements = self.trial.course.obstacles.objects.placements(since_start_ns);
        self.renderer
            .render(&placements, &cameras, images)
            .context("an image cannot be rendered")?;
        let weather = weather(&self.arena.environment);
        let moment = exposure.moment(self.trial.seed(Purpose::Weather));
        let imaging = self.trial.seed(Purpose::Imaging);
        let mut rendered: Vec<Option<Picture>> = self.cameras.iter().map(|_| None).collect();
        for ((&index, camera), image) in due.iter().zip(&cameras).zip(images) {
            let mut picture = Picture::default();
            let (config, info) = (&self.arena.cameras[index], &self.cameras[index]);
            image.write_depth_mm(DepthKind::Median, &mut picture.depth_mm);
            // True clearance ahead, before effects of weather and camera.
            let width = info.intrinsics.width_px as usize;
            picture.ahead_m = ahead_m(&picture.depth_mm, width, &mut self.scratch);
            self.weather.apply(&weather, camera, &moment, image);
            let seeds = [imaging, index as u64, self.seq + 1];
            let input = EffectInput { config, info, motion: &newest.motion, exposure, seeds };
            self.imaging[index].apply(&input, image);
            image.write_rgb8(&mut picture.rgb);
            image.write_depth_mm(DepthKind::Median, &mut picture.depth_mm);
            if withholds_depth(&self.arena.cameras[index]) {
                // Same as in live flight: if the course withholds depth, all pixels are "no
                // return".
                picture.depth_mm.fill(0);
            }
            rendered[index] = Some(picture);
        }
        self.seq += 1;
        let (due, pose, shown) = (self.now.plus_ns(image_ns), sample.stamp, exposure.at);
        let (seq, world_from_body) = (self.seq, exposure.world_from_body);
        self.pending.push_back(Pending { due, seq, pose, shown, world_from_body, rendered });
        Ok(())
    }

    /// Measures with the sensors that are due, and delivers readings that have arrived.
    fn sense(&mut self) {
        if self.sensing.is_none() {
            return;
        }
        let phase = self.lockstep.companion.flight().phase();
        let is_over = matches!(phase, FlightPhase::Landing | FlightPhase::Landed);
        let now = self.server_now();
        let (motion, sample) = (self.referee.motion(), self.referee.newest().copied());
        let Some(sensing) = &mut self.sensing else { return };
        if let (Some(motion), Some(sample), false) = (motion, sample, is_over) {
            let image_ns = self.trial.delays.image_ns;
            let pose = sample.stamp;
            let exposure =
                Exposure::new(Predict::Seen, Some(image_ns), &Localized { sample, motion }, now);
            let objects = &self.trial.course.obstacles.objects;
            let mut place = |at: ServerTime, placements: &mut Vec<Placement>| {
                objects.place(at.as_ns().wrapping_sub(START_NS).cast_signed(), placements);
            };
            let taken = sensing.sensors.take(now);
            for (index, _) in taken.iter().enumerate().filter(|(_, taken)| **taken) {
                let scene = &sensing.scene;
                let mut around = Around { scene, motion: &motion, pose, place: &mut place };
                if let Some(made) = sensing.sensors.measure(index, &exposure, &mut around) {
                    sensing.pending.push_back((self.now.plus_ns(image_ns), made));
                }
            }
        }
        while let Some((due, made)) = sensing.pending.pop_front_if(|(due, _)| *due <= self.now) {
            let records = made.records().to_vec();
            self.hash.update(&records);
            let at = |ns: u64| HostTime::from_ns(ns);
            let (pose, shown) = (at(made.header.pose_ns.get()), at(made.header.stamp_ns.get()));
            let reading = Reading { header: made.header, pose, shown, received: due, records };
            self.lockstep.take_reading(self.now, reading);
        }
    }

    /// Delivers an image to the plugin and takes its reply.
    fn show(&mut self, pending: &Pending) -> Result<()> {
        let (cameras, hash) = (&self.cameras, &mut self.hash);
        let ahead_ns = pending.shown.as_ns().wrapping_sub(pending.pose.as_ns()) as i32;
        let pose = HostTime::from_ns(pending.pose.as_ns());
        let stamps = ImageStamps { seq: pending.seq, pose, ahead_ns, ready: pending.due };
        let write = |writer: &mut ObservationWriter<'_>| {
            for (index, picture) in pending.rendered.iter().enumerate() {
                let (Some(picture), camera) = (picture, &cameras[index]) else { continue };
                picture.add_to(hash);
                if let Some(planes) = writer.planes(index, camera) {
                    planes.rgb.copy_from_slice(&picture.rgb);
                    planes.depth_mm.copy_from_slice(&picture.depth_mm);
                }
                writer.image_ready(index, camera, stamps);
            }
        };
        let (now, seq) = (self.now, pending.seq);
        let headers = pending.headers(cameras);
        let images = pending.given(cameras, &headers);
        let mut line = self.lines.sink();
        let reply = self.lockstep.show(now, seq, cameras, write, &images, &mut line)?;
        drop(line);
        self.log_lines();
        for odometry in self.lockstep.take_odometry() {
            self.hash.update(format!("{odometry:?}").as_bytes());
            self.odometry.push(odometry);
        }
        let Some(reply) = reply else { return Ok(()) };
        self.answered += 1;
        self.hash.update(format!("{:?}", reply.setpoint).as_bytes());
        self.come_by()?;
        self.keep_for_report(pending, reply.setpoint);
        Ok(())
    }

    /// Records the progress of the flight. A repeated flight must be equal to the earlier attempt
    /// up to the point where that was lost.
    fn come_by(&self) -> Result<()> {
        let here = Reached { images: self.answered, hash: self.hash.clone().finalize().into() };
        match self.trial.reached.get() {
            Some(before) if before.images > here.images => {}
            Some(before) if before.images == here.images => ensure!(before == here, AnotherWay),
            _ => self.trial.reached.set(Some(here)),
        }
        Ok(())
    }

    fn keep_for_report(&mut self, pending: &Pending, setpoint: Option<Setpoint>) {
        if self.end.reason().is_some() {
            return;
        }
        let front = pending.rendered.first().and_then(Option::as_ref);
        let k = self.cameras.first().map(|camera| camera.intrinsics);
        let ahead_m = front.and_then(|picture| picture.ahead_m);
        let stamp = self.server_now();
        self.asked.push(TimedSetpoint { stamp, setpoint });
        self.seen.push(ClearanceAhead { stamp, ahead_m });
        let (Some(picture), Some(k)) = (front, k) else { return };
        let size_px = (k.width_px, k.height_px);
        let image = || TrialImage { stamp: pending.shown, rgb: picture.rgb.clone(), size_px };
        if self.is_airborne() {
            self.keyframes.take(pending.shown, image);
        }
        let is_due = self.shots.back().is_none_or(|shot| {
            pending.shown.seconds_since(shot.stamp) >= SHOT_PERIOD_S - 0.5 * 2.5e-3
        });
        if is_due {
            self.shots.push_back(image());
            while self.shots.front().is_some_and(|oldest| {
                pending.shown.seconds_since(oldest.stamp) > SHOWN_S + 0.5 * SHOT_PERIOD_S
            }) {
                self.shots.pop_front();
            }
        }
    }

    fn is_airborne(&self) -> bool {
        let phase = self.lockstep.companion.flight().phase();
        !matches!(phase, FlightPhase::Connecting | FlightPhase::Preparing)
    }

    fn note(&mut self, event: Event) {
        if let Some(log) = self.lockstep.log() {
            log.event(self.now, &event);
        }
        self.end.handle(event.stamp, &event.kind);
        self.hash.update(event.stamp.as_ns().to_le_bytes());
        self.hash.update(format!("{:?}", event.kind).as_bytes());
        self.events.push(event);
    }

    fn hash_state(&mut self) {
        let state = self.simulation.state();
        let (position_m, rotation) = (state.p_world_m, state.world_from_body);
        let hash_vector = |hash: &mut Sha256, v: DVec3| {
            for value in v.to_array() {
                hash.update(value.to_le_bytes());
            }
        };
        hash_vector(&mut self.hash, state.p_world_m);
        hash_vector(&mut self.hash, state.v_world_mps);
        for value in state.world_from_body.to_array() {
            self.hash.update(value.to_le_bytes());
        }
        self.keep_truth(position_m, rotation);
    }

    /// Stores the true pose, for comparison with estimates that the plugin may publish.
    fn keep_truth(&mut self, position_m: DVec3, rotation: DQuat) {
        let at_s = self.now.as_ns() as f64 * 1e-9;
        if self.truth.back().is_some_and(|last| at_s - last.at_s < TRUTH_PERIOD_S) {
            return;
        }
        // Before the first estimate, only the poses that it may refer to are kept.
        if self.odometry.is_empty() && self.truth.len() >= TRUTH_BEFORE_FIRST {
            self.truth.pop_front();
        }
        self.truth.push_back(Stamped { at_s, position_m, rotation });
    }

    fn server_now(&self) -> ServerTime {
        ServerTime::from_ns(self.now.as_ns())
    }

    fn virtual_s(&self) -> f64 {
        self.now.seconds_since(HostTime::from_ns(START_NS))
    }

    pub(super) fn end(mut self) -> TrialResult {
        let virtual_s = self.virtual_s();
        // Merge the events of server and runtime, each in order, into one list.
        self.events.sort_by_key(|event| event.stamp);
        TrialResult {
            verdict: judge_ended(self.arena, &self.end, &self.events, &self.samples),
            hash: self.hash.finalize().into(),
            events: self.events,
            samples: self.samples,
            asked: self.asked,
            seen: self.seen,
            shots: self.shots,
            keyframes: self.keyframes.images,
            lines: self.lines.kept,
            images: self.answered,
            odometry: self.odometry,
            truth: self.truth.into(),
            virtual_s,
        }
    }
}
