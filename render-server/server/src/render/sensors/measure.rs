//! Schedule and measurements of a vehicle's sensors. Pure, with time as an argument, so that the thread (wall
//! clock) and graded flights (virtual clock) follow the same rules.

use std::sync::Arc;

use bytes::Bytes;
use vizflyt_arena::pose::Motion as VehicleMotion;
use vizflyt_protocol::geometry::{Pose, Sensor, World};
use vizflyt_protocol::sensor::{
    LidarPoint, MAX_SENSORS, RadarDetection, RangeReading, ReadingHeader, SensorKind,
};
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::Placement;
use vizflyt_splat::sensor::{self as models, SensorMotion, SensorScene};
use zerocopy::IntoBytes;

use super::model::SensorModel;
use super::set::{MadeReading, SensorSet};
use crate::render::schedule::Exposure;

/// Duration of a radar's frame: the chirps over which it measures speeds. [s]
const RADAR_FRAME_S: f64 = 0.02;

/// Environment of a sensor.
pub struct Around<'a> {
    /// Splats for ray queries.
    pub scene: &'a SensorScene,
    /// Motion of the vehicle.
    pub motion: &'a VehicleMotion,
    /// Time of measurement of the newest pose.
    pub pose: ServerTime,
    /// Appends the placements of all objects at an instant.
    pub place: &'a mut dyn FnMut(ServerTime, &mut Vec<Placement>),
}

/// Sensors of one vehicle: models, due times, and numbers of readings.
#[derive(Debug)]
pub struct VehicleSensors {
    set: Arc<SensorSet>,
    models: Vec<SensorModel>,
    due: [ServerTime; MAX_SENSORS],
    seq: [u64; MAX_SENSORS],
    seed: u64,
    points: Vec<models::LidarPoint>,
    detections: Vec<models::RadarDetection>,
    placements: [Vec<Placement>; 2],
    objects: Vec<[Placement; 2]>,
}

impl VehicleSensors {
    /// Creates sensors that are all due at `now`; `seed` determines their noise.
    pub fn new(set: Arc<SensorSet>, now: ServerTime, seed: u64) -> Self {
        Self {
            models: set.models.clone(),
            set,
            due: [now; MAX_SENSORS],
            seq: [0; MAX_SENSORS],
            seed,
            points: Vec::new(),
            detections: Vec::new(),
            placements: Default::default(),
            objects: Vec::new(),
        }
    }

    /// Applies changed settings; a faster rate takes effect at once.
    pub fn follow(&mut self, newest: Arc<SensorSet>, now: ServerTime) {
        if Arc::ptr_eq(&self.set, &newest) {
            return;
        }
        self.models.clone_from(&newest.models);
        self.set = newest;
        for (due, model) in self.due.iter_mut().zip(&self.models) {
            *due = (*due).min(now.plus_ns(period_ns(model)));
        }
    }

    /// Returns the earliest due time; `None` if no sensor is enabled.
    pub fn next(&self) -> Option<ServerTime> {
        let measuring = self.due.iter().zip(&self.set.configs).filter(|(_, config)| config.enabled);
        measuring.map(|(due, _)| *due).min()
    }

    /// Returns the sensors that measure at `now`, and schedules their next readings.
    pub fn take(&mut self, now: ServerTime) -> [bool; MAX_SENSORS] {
        let mut taken = [false; MAX_SENSORS];
        for (index, config) in self.set.configs.iter().enumerate() {
            taken[index] = config.enabled && self.due[index] <= now;
            if taken[index] {
                // Counted from the due time, to keep the mean rate; after a rest, from now.
                let next = self.due[index].plus_ns(period_ns(&self.models[index]));
                self.due[index] = next.max(now);
            }
        }
        taken
    }

    /// Returns the reading of sensor `index` at the instant of `exposure`. `None` if a pose of the vehicle or
    /// of an object is invalid.
    pub fn measure(
        &mut self,
        index: usize,
        exposure: &Exposure,
        around: &mut Around<'_>,
    ) -> Option<MadeReading> {
        let info = self.set.infos.get(index)?;
        let (kind, mount) = (info.kind, info.body_from_sensor);
        let duration_s = match self.models.get(index)? {
            SensorModel::Lidar(lidar) => 1.0 / lidar.model().rate_hz,
            SensorModel::Radar(_) => RADAR_FRAME_S,
            SensorModel::RangeFinder(_) | SensorModel::Sonar(_) => 0.0,
        };
        let last = exposure.at;
        let first = last.plus_seconds(-duration_s);
        let ends = [around.motion.at(first), exposure.world_from_body];
        let world_from_sensor: [Pose<World, Sensor>; 2] = ends.map(|body| body * mount);
        for (placements, at) in self.placements.iter_mut().zip([first, last]) {
            placements.clear();
            (around.place)(at, placements);
        }
        let [before, after] = &self.placements;
        self.objects.clear();
        self.objects.extend(before.iter().zip(after).map(|(a, b)| [*a, *b]));
        let motion = SensorMotion { world_from_sensor, objects: &self.objects, duration_s };
        let (seq, seed) = (self.seq[index] + 1, self.seed.wrapping_add(index as u64));
        let head = (index as u8, kind, last, around.pose);
        let header = |count| {
            let (sensor, kind, last, pose) = head;
            let of = (sensor, kind);
            let mut header =
                ReadingHeader::new(seq, of, last, &mount, &exposure.world_from_body, count);
            header.pose_ns = pose.as_ns().into();
            header
        };
        let scene = around.scene;
        let made = match &mut self.models[index] {
            SensorModel::Lidar(lidar) => {
                lidar.scan(scene, &motion, seed, seq, &mut self.points).ok()?;
                let returns = self.points.iter().filter(|point| point.range_m > 0.0);
                let sweep_ns = (duration_s * 1e9) as u32;
                made(header, returns.map(|point| lidar_record(point, sweep_ns)))
            }
            SensorModel::RangeFinder(range) => {
                let reading = range.measure(scene, &motion, seed, seq).ok()?;
                made(header, std::iter::once(range_record(&reading)))
            }
            SensorModel::Sonar(sonar) => {
                let reading = sonar.measure(scene, &motion, seed, seq).ok()?;
                made(header, std::iter::once(range_record(&reading)))
            }
            SensorModel::Radar(radar) => {
                radar.measure(scene, &motion, seed, seq, &mut self.detections).ok()?;
                // Only the nearest, if there are too many.
                let most = SensorKind::Radar.max_records();
                made(header, self.detections.iter().take(most).map(radar_record))
            }
        };
        self.seq[index] = seq;
        Some(made)
    }
}

fn period_ns(model: &SensorModel) -> i64 {
    (1e9 / model.rate_hz()) as i64
}

// ---- from the models' records to those of plugins, without the identity of objects ----

fn lidar_record(point: &models::LidarPoint, sweep_ns: u32) -> LidarPoint {
    LidarPoint {
        p_m: point.p_sensor_m,
        before_ns: sweep_ns.saturating_sub(point.offset_ns),
        intensity: point.intensity.round() as u16,
        ring: point.ring,
    }
}

fn range_record(reading: &models::RangeReading) -> RangeReading {
    RangeReading { range_m: reading.range_m, signal: reading.strength }
}

fn radar_record(detection: &models::RadarDetection) -> RadarDetection {
    RadarDetection {
        range_m: detection.range_m,
        azimuth_rad: detection.azimuth_rad,
        radial_mps: detection.speed_mps,
        snr_db: detection.snr_db,
        cross_section_m2: detection.cross_section_m2,
    }
}

/// Returns the reading with these records.
fn made<R: IntoBytes + zerocopy::Immutable>(
    header: impl FnOnce(u32) -> ReadingHeader,
    records: impl Iterator<Item = R>,
) -> MadeReading {
    let mut bytes = vec![0; ReadingHeader::SIZE];
    for record in records {
        bytes.extend_from_slice(record.as_bytes());
    }
    let count = (bytes.len() - ReadingHeader::SIZE) / size_of::<R>();
    let header = header(count as u32);
    bytes[..ReadingHeader::SIZE].copy_from_slice(header.as_bytes());
    MadeReading { header, bytes: Bytes::from(bytes) }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3, Vec3};
    use vizflyt_arena::config::SensorConfig;
    use vizflyt_splat::builtin_models::{Part, boxes};
    use vizflyt_splat::{RigidObject, Scene, Splats};

    use super::*;
    use zerocopy::FromBytes;

    const START: ServerTime = ServerTime::from_ns(10_000_000_000);

    /// Wall at 3.9 m ahead in its original placement.
    fn scene() -> SensorScene {
        let wall = Part {
            center_m: Vec3::new(4.0, 0.0, 1.0),
            half_m: Vec3::new(0.1, 2.0, 2.0),
            colour: [0.9; 3],
        };
        let objects = [RigidObject { id: 5, splats: boxes(&[wall]) }];
        SensorScene::new(Scene { splats: &Splats::default(), objects: &objects })
    }

    fn exact(name: &str, model: &str) -> SensorConfig {
        let mut config = SensorConfig::ahead(name, model, DVec3::X * 0.1);
        for key in ["sigma_m", "sigma_per_m", "range_step_m"] {
            config.settings.insert(key.into(), 0.0.into());
        }
        config
    }

    fn set(configs: &[SensorConfig]) -> Arc<SensorSet> {
        Arc::new(SensorSet::new(configs).unwrap())
    }

    /// Measures with sensor `index` at `x_m`, at 1 m height, with the wall moved by `wall_x_m` or removed.
    fn measure(
        sensors: &mut VehicleSensors,
        index: usize,
        x_m: f64,
        wall_x_m: Option<f64>,
    ) -> MadeReading {
        let world_from_body = Pose::new(DVec3::new(x_m, 0.0, 1.0), DQuat::IDENTITY);
        let motion = VehicleMotion::at_rest(START, world_from_body);
        let exposure = Exposure { v_world_mps: DVec3::ZERO, at: START, world_from_body };
        let mut place = |_: ServerTime, placements: &mut Vec<Placement>| {
            placements.push(wall_x_m.map(|x_m| Pose::new(DVec3::X * x_m, DQuat::IDENTITY)));
        };
        let scene = scene();
        let mut around = Around { scene: &scene, motion: &motion, pose: START, place: &mut place };
        sensors.measure(index, &exposure, &mut around).unwrap()
    }

    fn range_m(reading: &MadeReading) -> Option<f32> {
        RangeReading::read_from_bytes(reading.records()).unwrap().measured_m()
    }

    #[test]
    fn ranges_match_the_geometry_including_moved_objects() {
        let set = set(&[exact("ahead", "lidar-lite-v3"), exact("zones", "vl53l5cx")]);
        let mut sensors = VehicleSensors::new(set, START, 7);
        for (x_m, wall_x_m, expected_m) in [(0.0, 0.0, 3.8), (1.0, 0.0, 2.8), (0.5, 2.0, 5.3)] {
            let reading = measure(&mut sensors, 0, x_m, Some(wall_x_m));
            let found_m = range_m(&reading).unwrap();
            assert!((found_m - expected_m).abs() < 0.01, "{found_m} of {expected_m} m");
            assert_eq!(reading.header.world_from_body().translation_m.x, x_m);
            assert_eq!(reading.header.body_from_sensor().translation_m, DVec3::X * 0.1);
        }
        assert_eq!(range_m(&measure(&mut sensors, 0, 0.0, None)), None, "the wall is gone");
        let zones = measure(&mut sensors, 1, 1.0, Some(0.0));
        assert!(zones.header.record_count.get() > 32, "{:?}", zones.header);
        for bytes in zones.records().chunks_exact(size_of::<LidarPoint>()) {
            let point = LidarPoint::read_from_bytes(bytes).unwrap();
            assert!((point.p_m[0] - 2.8).abs() < 0.03 && point.before_ns > 0, "{point:?}");
        }
        let (parsed, _) = ReadingHeader::parse(&zones.bytes).unwrap();
        assert_eq!(parsed.payload_len(), zones.records().len());
    }

    #[test]
    fn the_same_seed_gives_the_same_bytes() {
        let configs = ["os1-16", "tfmini", "hc-sr04", "iwr6843"]
            .map(|model| SensorConfig::ahead(model, model, DVec3::ZERO));
        let fly = |seed: u64| {
            let mut sensors = VehicleSensors::new(set(&configs), START, seed);
            let made = (0..8).map(|n| measure(&mut sensors, n % 4, 0.1 * n as f64, Some(0.0)));
            made.map(|reading| reading.bytes).collect::<Vec<_>>()
        };
        assert_eq!(fly(3), fly(3));
        assert!(fly(3) != fly(4), "the noise follows from the seed");
    }

    #[test]
    fn sensors_keep_their_rates_and_disabled_ones_measure_nothing() {
        let mut configs =
            ["os1-16", "tfmini"].map(|model| SensorConfig::ahead(model, model, DVec3::ZERO));
        configs[1].rate_hz = Some(30.0);
        let mut sensors = VehicleSensors::new(set(&configs), START, 0);
        let fly = |sensors: &mut VehicleSensors, from: i64| {
            let mut counts = [0; 2];
            // One second of ticks of 2.5 ms.
            for tick in from..from + 400 {
                let taken = sensors.take(START.plus_ns(tick * 2_500_000));
                for (count, taken) in counts.iter_mut().zip(taken) {
                    *count += usize::from(taken);
                }
            }
            counts
        };
        assert_eq!(fly(&mut sensors, 0), [10, 30]);
        configs[0].enabled = false;
        sensors.follow(set(&configs), START.plus_seconds(1.0));
        assert_eq!(fly(&mut sensors, 400), [0, 30]);
        configs[0].enabled = true;
        configs[0].rate_hz = Some(20.0);
        sensors.follow(set(&configs), START.plus_seconds(2.0));
        let found = fly(&mut sensors, 800);
        assert!((20..=21).contains(&found[0]) && found[1] == 30, "{found:?}");
    }
}
