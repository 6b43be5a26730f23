//! LiDAR: a sweep of many beams, each from the pose of the sensor at its own instant.
//!
//! Budget: 5.5 ms on two cores for 16 x 1024 beams in a forest of 125 k splats; nearly all of it is
//! spent in `cast`.
//!
//! The power of an echo (`cast`) is that of a Lambertian surface larger than the beam,
//! `reflectivity cos(incidence) / range^2` (Wagner 2010, "Radiometric calibration of
//! small-footprint full-waveform airborne laser scanner measurements", ISPRS Journal 65, equation
//! 8: the radar equation for extended targets). Data sheets state the range at which a target of a
//! given reflectivity is detected with a probability of 90 %. The detection probabilities of all
//! other targets follow from this pair.

use std::f64::consts::TAU;

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::{Pose, Sensor, World};

use super::cast::{Beam, Echo, Hit, Hits, TOGETHER, echoes, spread_of};
use super::noise::Draws;
use super::{Checked, InvalidModel, SensorError, SensorMotion, SensorScene};

/// LiDAR model, in the terms of its data sheet. [`super::presets`] has named ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LidarModel {
    /// Directions of the beams, in order.
    pub beams: Beams,
    /// Rate of sweeps. [Hz]
    pub rate_hz: f64,
    /// Minimum range. [m]
    pub min_range_m: f32,
    /// Maximum range. [m]
    pub max_range_m: f32,
    /// Full angle of a beam at 1/e^2 of its central intensity. [rad]
    pub divergence_rad: f32,
    /// Standard deviation of a range. [m]
    pub sigma_m: f32,
    /// Growth of the standard deviation per metre of range. [m/m]
    pub sigma_per_m: f32,
    /// Quantisation step of ranges; 0 for no rounding. [m]
    pub range_step_m: f32,
    /// Maximum distance of two echoes that are merged. [m]
    pub resolution_m: f32,
    /// Range at which a target across the beam, of `reference_reflectivity`, is detected with a
    /// probability of 90 %. [m]
    pub reference_range_m: f32,
    /// Share of light that the reference target reflects, 0 to 1.
    pub reference_reflectivity: f32,
    /// Selection of the reported echo.
    pub returns: Returns,
}

/// Directions of the beams. Azimuth is about z from x to y, elevation up from the x-y plane.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Beams {
    /// Head that rotates once per sweep, clockwise seen from above, starting backwards, then left,
    /// front and right: `columns` stacks of beams.
    Spinning {
        /// Elevation of each ring, in the order of the records. [rad]
        elevations_rad: Vec<f32>,
        /// Stacks per revolution.
        columns: u32,
    },
    /// Raster of beams, one after the other: rows from the top, each from left to right.
    Raster {
        /// Number of rows.
        rows: u32,
        /// Beams per row.
        columns: u32,
        /// Angle between the outermost beams of a row. [rad]
        horizontal_rad: f32,
        /// Angle between first and last row. [rad]
        vertical_rad: f32,
    },
    /// The same raster, with all beams at once in the middle of the sweep.
    Flash {
        /// Number of rows.
        rows: u32,
        /// Beams per row.
        columns: u32,
        /// Angle between the outermost beams of a row. [rad]
        horizontal_rad: f32,
        /// Angle between first and last row. [rad]
        vertical_rad: f32,
    },
    /// One beam that rotates and oscillates in elevation at rates without a common period. Each
    /// sweep fills gaps of earlier ones.
    Rosette {
        /// Beams per sweep.
        points: u32,
        /// Lowest elevation. [rad]
        lowest_rad: f32,
        /// Highest elevation. [rad]
        highest_rad: f32,
        /// Rate of rotation. [Hz]
        turns_hz: f64,
        /// Rate of oscillation in elevation. [Hz]
        nods_hz: f64,
    },
}

/// Selection of the reported echo of a beam.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Returns {
    /// Nearest echo.
    First,
    /// Echo with the highest power.
    #[default]
    Strongest,
    /// Farthest echo.
    Last,
}

/// Reading of one beam. The range is 0 if there is no echo.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct LidarPoint {
    /// Position relative to the sensor at the instant of the beam: points of a moving sensor have
    /// different instants. [m, sensor]
    pub p_sensor_m: [f32; 3],
    /// Range along the beam; 0 without return. [m]
    pub range_m: f32,
    /// Intensity, corrected for range: 255 for a white surface across the complete beam.
    pub intensity: f32,
    /// Time from the first instant of the sweep to that of the beam. [ns]
    pub offset_ns: u32,
    /// Ring or row, from 0; always 0 for a rosette.
    pub ring: u16,
    /// Id of the object; 0 is the static scene.
    pub object: u16,
}

/// LiDAR that is prepared for measurements.
#[derive(Clone, Debug)]
pub struct Lidar {
    model: LidarModel,
    /// Sine and cosine of each column's azimuth and each row's elevation, if they are the same in
    /// all sweeps.
    columns: Vec<[f64; 2]>,
    rows: Vec<[f64; 2]>,
}

/// Maximum beams per sweep: 4 million records of 28 bytes.
const MAX_BEAMS: u64 = 1 << 22;
/// Beams per task, approximately: about 80 us.
const CHUNK: usize = 128;
/// Noise of the threshold as a share of it: between detection probabilities of 10 % and 90 %, the
/// power about doubles.
const THRESHOLD_NOISE: f32 = 0.25;
/// Quantile of the standard normal distribution at 90 %.
const NINE_IN_TEN: f32 = 1.281_551_6;

impl Lidar {
    /// Prepares a model.
    ///
    /// # Errors
    /// [`InvalidModel`] with the first invalid field.
    pub fn new(model: LidarModel) -> Result<Self, InvalidModel> {
        let check = Checked("lidar");
        check.common(
            model.rate_hz,
            [model.min_range_m, model.max_range_m],
            [model.sigma_m, model.sigma_per_m, model.range_step_m, model.resolution_m],
            model.reference_range_m,
        )?;
        check.within("divergence_rad", model.divergence_rad, [0.0, 0.5], "0 to 0.5")?;
        check.within(
            "reference_reflectivity",
            model.reference_reflectivity,
            [1e-3, 1.0],
            "0.001 to 1",
        )?;
        let angle = |field, value, most| {
            check.within(field, value, [0.0, most], "an angle in radians within a sphere")
        };
        let (half, full) = (std::f32::consts::PI, std::f32::consts::TAU);
        match &model.beams {
            Beams::Spinning { elevations_rad, .. } => {
                for elevation in elevations_rad {
                    angle("elevations_rad", elevation.abs(), half / 2.0)?;
                }
                check.within(
                    "elevations_rad",
                    elevations_rad.len() as f32,
                    [0.0, 4096.0],
                    "at most 4096 rings",
                )?;
            }
            Beams::Raster { rows, horizontal_rad, vertical_rad, .. }
            | Beams::Flash { rows, horizontal_rad, vertical_rad, .. } => {
                check.within("rows", *rows as f32, [0.0, 65535.0], "at most 65535 rows")?;
                angle("horizontal_rad", *horizontal_rad, full)?;
                angle("vertical_rad", *vertical_rad, half)?;
            }
            Beams::Rosette { lowest_rad, highest_rad, turns_hz, nods_hz, .. } => {
                angle("lowest_rad", lowest_rad.abs(), half / 2.0)?;
                angle("highest_rad", highest_rad.abs(), half / 2.0)?;
                check.within("turns_hz", *turns_hz as f32, [0.0, 1e5], "0 to 100000")?;
                check.within("nods_hz", *nods_hz as f32, [0.0, 1e5], "0 to 100000")?;
            }
        }
        let mut lidar = Self { model, columns: Vec::new(), rows: Vec::new() };
        check.within(
            "beams",
            lidar.count() as f32,
            [0.0, MAX_BEAMS as f32],
            "at most 4194304 beams a sweep",
        )?;
        if lidar.count() > 0 {
            (lidar.columns, lidar.rows) = lidar.model.beams.angles();
        }
        Ok(lidar)
    }

    /// Returns the model of this LiDAR.
    pub fn model(&self) -> &LidarModel {
        &self.model
    }

    /// Returns the number of beams per sweep, which is the number of records of a scan.
    pub fn beams(&self) -> usize {
        self.count() as usize
    }

    fn count(&self) -> u64 {
        match &self.model.beams {
            Beams::Spinning { elevations_rad, columns } => {
                elevations_rad.len() as u64 * u64::from(*columns)
            }
            Beams::Raster { rows, columns, .. } | Beams::Flash { rows, columns, .. } => {
                u64::from(*rows) * u64::from(*columns)
            }
            Beams::Rosette { points, .. } => u64::from(*points),
        }
    }

    /// Measures sweep `seq`, during which sensor and objects move according to `motion`, into one
    /// record per beam, in the order of the beams. All noise follows from `seed` and `seq`.
    ///
    /// # Errors
    /// [`SensorError`]; there are then no records.
    ///
    /// # Panics
    /// If the numbers of objects of `motion` and of the scene differ.
    pub fn scan(
        &self,
        scene: &SensorScene,
        motion: &SensorMotion<'_>,
        seed: u64,
        seq: u64,
        out: &mut Vec<LidarPoint>,
    ) -> Result<(), SensorError> {
        out.clear();
        motion.validate(scene)?;
        out.resize(self.beams(), LidarPoint::default());
        let rings = self.rings();
        let chunk_beams = rings * CHUNK.div_ceil(rings);
        out.par_chunks_mut(chunk_beams).enumerate().for_each(|(chunk, points)| {
            let mut hits = [Hits::new(); TOGETHER];
            for (i, columns) in points.chunks_mut(rings * TOGETHER).enumerate() {
                let first = chunk * chunk_beams + i * rings * TOGETHER;
                self.measure_columns(scene, motion, (seed, seq), first, columns, &mut hits);
            }
        });
        Ok(())
    }

    /// Measures neighbouring columns, starting with beam `first`, ring by ring.
    fn measure_columns(
        &self,
        scene: &SensorScene,
        motion: &SensorMotion<'_>,
        (seed, seq): (u64, u64),
        first: usize,
        points: &mut [LidarPoint],
        hits: &mut [Hits; TOGETHER],
    ) {
        let rings = self.rings();
        let columns = points.len() / rings;
        // All beams of a column have one pose: a slerp would be a tenth of the time per beam.
        let mut poses = [Pose::IDENTITY; TOGETHER];
        for (column, pose) in poses[..columns].iter_mut().enumerate() {
            *pose = motion.sensor_at(self.leaving(first + column * rings, seq).share);
        }
        for ring in 0..rings {
            let mut leaving = [Leaving::default(); TOGETHER];
            for (column, leaving) in leaving[..columns].iter_mut().enumerate() {
                *leaving = self.leaving(first + column * rings + ring, seq);
            }
            let beam = |column: usize| {
                (leaving[column].share, self.beam(&poses[column], &leaving[column]))
            };
            scene.cast_each(motion, columns, hits, beam, |column, hits| {
                let number = column * rings + ring;
                let draws = Draws::new(seed, seq, (first + number) as u64);
                points[number] = self.measure(&leaving[column], draws, hits);
            });
        }
    }

    /// Returns the number of beams between neighbours of a ring.
    fn rings(&self) -> usize {
        match &self.model.beams {
            Beams::Spinning { elevations_rad, .. } => elevations_rad.len().max(1),
            Beams::Raster { .. } | Beams::Flash { .. } | Beams::Rosette { .. } => 1,
        }
    }

    fn beam(&self, world_from_sensor: &Pose<World, Sensor>, leaving: &Leaving) -> Beam {
        Beam {
            origin_m: world_from_sensor.translation_m,
            direction: world_from_sensor.rotate(leaving.direction.as_dvec3()).normalize(),
            spread: spread_of(self.model.divergence_rad),
            max_m: self.model.max_range_m,
        }
    }

    fn measure(&self, leaving: &Leaving, mut draws: Draws, hits: &[Hit]) -> LidarPoint {
        let model = &self.model;
        let &Leaving { direction, share, ring } = leaving;
        let mut point = LidarPoint {
            offset_ns: (share / model.rate_hz * 1e9) as u32,
            ring,
            ..LidarPoint::default()
        };
        let [threshold, error] = draws.gaussians();
        let threshold = 1.0 + THRESHOLD_NOISE * (threshold - NINE_IN_TEN);
        let mut reported: Option<Echo> = None;
        echoes(hits, model.resolution_m, |echo| {
            let strength = echo.power / echo.range_m.max(1e-3).powi(2);
            if !(echo.range_m >= model.min_range_m && strength * self.per_threshold() >= threshold)
            {
                return;
            }
            let better = match (model.returns, &reported) {
                (_, None) | (Returns::Last, _) => true,
                (Returns::First, Some(_)) => false,
                (Returns::Strongest, Some(other)) => {
                    strength > other.power / other.range_m.max(1e-3).powi(2)
                }
            };
            if better {
                reported = Some(echo);
            }
        });
        let Some(echo) = reported else { return point };
        let sigma_m = model.sigma_m + model.sigma_per_m * echo.range_m;
        let range_m = rounded(echo.range_m + sigma_m * error, model.range_step_m);
        if !(range_m >= model.min_range_m && range_m <= model.max_range_m) {
            return point;
        }
        point.range_m = range_m;
        point.p_sensor_m = (direction * range_m).to_array();
        point.intensity = (255.0 * echo.power).min(255.0);
        point.object = echo.tag.id;
        point
    }

    /// Returns the factor that scales an echo's power over squared range to 1 at the threshold of
    /// 90 %.
    fn per_threshold(&self) -> f32 {
        self.model.reference_range_m.powi(2) / self.model.reference_reflectivity
    }

    /// Returns instant and direction of a beam.
    fn leaving(&self, number: usize, seq: u64) -> Leaving {
        let of = |number: usize, all: usize| number as f64 / all as f64;
        let ahead = |column: usize, row: usize, share: f64| {
            let direction = pointing_at(self.columns[column], self.rows[row]);
            Leaving { direction, share, ring: row as u16 }
        };
        let (rows, columns) = (self.rows.len(), self.columns.len());
        match &self.model.beams {
            Beams::Spinning { .. } => {
                let column = number / rows;
                ahead(column, number % rows, of(column, columns))
            }
            Beams::Raster { .. } => {
                ahead(number % columns, number / columns, of(number, rows * columns))
            }
            Beams::Flash { .. } => ahead(number % columns, number / columns, 0.5),
            Beams::Rosette { points, lowest_rad, highest_rad, turns_hz, nods_hz } => {
                let share = of(number, *points as usize);
                let time_s = (seq as f64 + share) / self.model.rate_hz;
                let azimuth = -TAU * (turns_hz * time_s).fract();
                let nod = (TAU * (nods_hz * time_s).fract()).sin();
                let (low, high) = (f64::from(*lowest_rad), f64::from(*highest_rad));
                let elevation = 0.5 * (low + high) + 0.5 * (high - low) * nod;
                Leaving { direction: pointing(azimuth, elevation), share, ring: 0 }
            }
        }
    }
}

/// Instant and direction of a beam.
#[derive(Clone, Copy, Default)]
struct Leaving {
    /// Unit vector. [sensor]
    direction: Vec3,
    /// Share of the sweep, 0 to 1.
    share: f64,
    ring: u16,
}

impl Beams {
    /// Returns sine and cosine of each column's azimuth and of each row's elevation; empty for a
    /// rosette.
    fn angles(&self) -> (Vec<[f64; 2]>, Vec<[f64; 2]>) {
        let sin_cos = |angle: f64| <[f64; 2]>::from(angle.sin_cos());
        match self {
            Beams::Spinning { elevations_rad, columns } => {
                // The middle column of a revolution points forward.
                let azimuth = |n: u32| TAU * (0.5 - f64::from(n) / f64::from(*columns));
                let rows = elevations_rad.iter().map(|&angle| sin_cos(f64::from(angle)));
                ((0..*columns).map(|n| sin_cos(azimuth(n))).collect(), rows.collect())
            }
            Beams::Raster { rows, columns, horizontal_rad, vertical_rad }
            | Beams::Flash { rows, columns, horizontal_rad, vertical_rad } => {
                // From left to right, and from top to bottom.
                let angles = |count: u32, angle_rad: f32| {
                    let share =
                        |n: u32| if count > 1 { f64::from(n) / f64::from(count - 1) } else { 0.5 };
                    (0..count).map(|n| sin_cos(f64::from(angle_rad) * (0.5 - share(n)))).collect()
                };
                (angles(*columns, *horizontal_rad), angles(*rows, *vertical_rad))
            }
            Beams::Rosette { .. } => (Vec::new(), Vec::new()),
        }
    }
}

/// Returns the unit vector at an azimuth and an elevation. [rad, sensor]
pub(super) fn pointing(azimuth: f64, elevation: f64) -> Vec3 {
    pointing_at(azimuth.sin_cos().into(), elevation.sin_cos().into())
}

/// Returns the unit vector at an azimuth and an elevation, given their sines and cosines. [sensor]
fn pointing_at([sin, cos]: [f64; 2], [up, level]: [f64; 2]) -> Vec3 {
    DVec3::new(level * cos, level * sin, up).as_vec3()
}

/// Rounds to the nearest multiple of `step`, unless `step` is 0.
pub(super) fn rounded(value: f32, step: f32) -> f32 {
    if step > 0.0 { (value / step).round() * step } else { value }
}
