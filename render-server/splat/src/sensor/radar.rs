//! Radar: detections by range, azimuth and Doppler speed.
//!
//! Rays fill the field of view. The echo (`cast`) of each is a patch of `range^2 dOmega /
//! cos(incidence)` with a backscatter per area of constant gamma, `gamma cos(incidence)` (Barton
//! 2005, "Radar system analysis and modeling", section 3.6: rough surfaces), so that its cross
//! section is `gamma range^2 dOmega`. A surface that is smooth compared with the wavelength adds
//! facets that face the radar, as for sound (`range`). Power follows the radar equation, `sigma G^2
//! / range^4` (Skolnik 2008, "Radar handbook", equation 1.1). The speed along the ray is that of
//! the patch minus that of the sensor. Patches of one cell of range, azimuth and speed are added,
//! and cells above the threshold are reported: at the mean of their patches, with errors of
//! `resolution / sqrt(2 SNR)` (Richards 2014, "Fundamentals of radar signal processing", section
//! 7.2).

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::cast::{Beam, Hit, Hits, TOGETHER, echoes};
use super::lidar::pointing;
use super::noise::Draws;
use super::{Checked, InvalidModel, SensorError, SensorMotion, SensorScene};

/// Radar model, in the terms of its data sheet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RadarModel {
    /// Rate of frames. [Hz]
    pub rate_hz: f64,
    /// Horizontal field of view: full angle at a two-way gain of a quarter (-6 dB). [rad]
    pub azimuth_fov_rad: f32,
    /// Vertical field of view, defined in the same way. [rad]
    pub elevation_fov_rad: f32,
    /// Minimum range. [m]
    pub min_range_m: f32,
    /// Maximum range. [m]
    pub max_range_m: f32,
    /// Size of a range cell: the speed of light over twice the bandwidth. [m]
    pub range_resolution_m: f32,
    /// Size of an azimuth cell. [rad]
    pub azimuth_resolution_rad: f32,
    /// Size of a speed cell: the wavelength over twice the duration of the frame. [m/s]
    pub speed_resolution_mps: f32,
    /// Maximum unambiguous speed: the wavelength over four times the chirp period. Higher speeds
    /// are folded to within plus and minus this. [m/s]
    pub max_speed_mps: f32,
    /// Range at which a target of 1 m^2 has the SNR `threshold_db`. [m]
    pub reference_range_m: f32,
    /// Minimum SNR of a reported cell. [dB]
    pub threshold_db: f32,
    /// Backscatter of a rough surface per area and cosine of incidence.
    pub gamma: f32,
    /// Standard deviation of the slopes of specular facets. [rad]
    pub slope_rad: f32,
    /// Share of incident power that a facet reflects.
    pub reflectivity: f32,
}

/// Detection of a radar: one cell.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct RadarDetection {
    /// Range. [m]
    pub range_m: f32,
    /// Azimuth about z, from x to y. [rad, sensor]
    pub azimuth_rad: f32,
    /// Speed along the ray, positive if the distance grows; folded. [m/s]
    pub speed_mps: f32,
    /// Signal-to-noise ratio. [dB]
    pub snr_db: f32,
    /// Radar cross section of the cell. [m^2]
    pub cross_section_m2: f32,
    /// Id of the object with the largest share; 0 is the static scene.
    pub object: u16,
}

/// Prepared [`RadarModel`].
#[derive(Clone, Debug)]
pub struct Radar {
    model: RadarModel,
    rays: Vec<Ray>,
    /// Standard deviation of each ray's footprint per metre: half the distance to its neighbours.
    /// [rad]
    spread: f32,
    patches: Vec<Patch>,
}

#[derive(Clone, Copy, Debug)]
struct Ray {
    direction: Vec3,
    azimuth_rad: f32,
    solid_angle_sr: f32,
    gain: f32,
}

/// Echo of one ray.
#[derive(Clone, Copy, Debug, Default)]
struct Patch {
    /// Cell of range, azimuth and speed; `NOWHERE` without echo.
    cell: [i32; 3],
    ray: u32,
    range_m: f32,
    azimuth_rad: f32,
    speed_mps: f32,
    cross_section_m2: f32,
    object: u16,
}

const NOWHERE: [i32; 3] = [i32::MAX; 3];
/// Maximum angle between rays, and maximum number of rays in each direction. [rad]
const RAY_RAD: f32 = 0.03;
const MAX_RAYS: usize = 96;
/// Rays per task.
const CHUNK: usize = 32;

impl Radar {
    /// Prepares a model.
    ///
    /// # Errors
    /// [`InvalidModel`] with the first invalid field.
    pub fn new(model: RadarModel) -> Result<Self, InvalidModel> {
        let check = Checked("radar");
        check.common(
            model.rate_hz,
            [model.min_range_m, model.max_range_m],
            [0.0, 0.0, 0.0, model.range_resolution_m],
            model.reference_range_m,
        )?;
        let within =
            |field, value, ends: [f32; 2], expected| check.within(field, value, ends, expected);
        within("azimuth_fov_rad", model.azimuth_fov_rad, [0.01, 3.0], "0.01 to 3")?;
        within("elevation_fov_rad", model.elevation_fov_rad, [0.01, 3.0], "0.01 to 3")?;
        within("range_resolution_m", model.range_resolution_m, [1e-3, 100.0], "0.001 to 100")?;
        within("azimuth_resolution_rad", model.azimuth_resolution_rad, [1e-3, 3.0], "0.001 to 3")?;
        within("speed_resolution_mps", model.speed_resolution_mps, [1e-3, 100.0], "0.001 to 100")?;
        within("max_speed_mps", model.max_speed_mps, [0.01, 1000.0], "0.01 to 1000")?;
        within("threshold_db", model.threshold_db, [0.0, 60.0], "0 to 60")?;
        within("gamma", model.gamma, [0.0, 100.0], "0 to 100")?;
        within("slope_rad", model.slope_rad, [0.01, 1.0], "0.01 to 1")?;
        within("reflectivity", model.reflectivity, [0.0, 1.0], "0 to 1")?;
        let count = |fov: f32| ((fov / RAY_RAD).ceil() as usize).clamp(1, MAX_RAYS);
        let (columns, rows) = (count(model.azimuth_fov_rad), count(model.elevation_fov_rad));
        let (wide, high) =
            (model.azimuth_fov_rad / columns as f32, model.elevation_fov_rad / rows as f32);
        let gain = |angle: f32, fov: f32| 0.25_f32.powf((2.0 * angle / fov).powi(2));
        let rays = (0..columns * rows).map(|i| {
            let of = |n: usize, all: usize, step: f32| (n as f32 + 0.5 - 0.5 * all as f32) * step;
            let (azimuth, elevation) =
                (of(i % columns, columns, wide), of(i / columns, rows, high));
            Ray {
                direction: pointing(f64::from(azimuth), f64::from(elevation)),
                azimuth_rad: azimuth,
                solid_angle_sr: wide * high * elevation.cos(),
                gain: gain(azimuth, model.azimuth_fov_rad)
                    * gain(elevation, model.elevation_fov_rad),
            }
        });
        let rays: Vec<Ray> = rays.collect();
        let patches = vec![Patch::default(); rays.len()];
        Ok(Self { rays, spread: wide.max(high) / 2.0, patches, model })
    }

    /// Returns the model of this radar.
    pub fn model(&self) -> &RadarModel {
        &self.model
    }

    /// Measures frame `seq`, with chirps during `motion`, into one record per detected cell, nearest
    /// first. All noise follows from `seed` and `seq`.
    ///
    /// # Errors
    /// [`SensorError`]; there are then no records.
    ///
    /// # Panics
    /// If the numbers of objects of `motion` and of the scene differ.
    pub fn measure(
        &mut self,
        scene: &SensorScene,
        motion: &SensorMotion<'_>,
        seed: u64,
        seq: u64,
        out: &mut Vec<RadarDetection>,
    ) -> Result<(), SensorError> {
        out.clear();
        motion.validate(scene)?;
        let (model, rays, spread) = (&self.model, &self.rays, self.spread);
        self.patches.par_chunks_mut(CHUNK).zip(rays.par_chunks(CHUNK)).enumerate().for_each(
            |(chunk, (patches, rays))| {
                model.patches(scene, motion, rays, spread, patches);
                for (i, patch) in patches.iter_mut().enumerate() {
                    patch.ray = (chunk * CHUNK + i) as u32;
                }
            },
        );
        self.patches.sort_unstable_by_key(|patch| (patch.cell, patch.ray));
        for cell in self.patches.chunk_by(|a, b| a.cell == b.cell) {
            if cell[0].cell == NOWHERE {
                break;
            }
            let draws = Draws::new(seed, seq, u64::from(cell[0].ray));
            out.extend(self.model.detect(cell, draws));
        }
        Ok(())
    }
}

impl RadarModel {
    /// Casts neighbouring rays. The patch of each ray is its strongest echo.
    fn patches(
        &self,
        scene: &SensorScene,
        motion: &SensorMotion<'_>,
        rays: &[Ray],
        spread: f32,
        patches: &mut [Patch],
    ) {
        let world_from_sensor = motion.sensor_at(0.5);
        let beam = |n: usize| {
            let direction = world_from_sensor.rotate(rays[n].direction.as_dvec3()).normalize();
            let origin_m = world_from_sensor.translation_m;
            (0.5, Beam { origin_m, direction, spread, max_m: self.max_range_m })
        };
        let mut hits = [Hits::new(); TOGETHER];
        scene.cast_each(motion, rays.len(), &mut hits, beam, |n, hits| {
            patches[n] = self.patch(motion, &rays[n], &beam(n).1, hits);
        });
    }

    fn patch(&self, motion: &SensorMotion<'_>, ray: &Ray, beam: &Beam, hits: &[Hit]) -> Patch {
        let &Beam { origin_m, direction, .. } = beam;
        let mut patch = Patch { cell: NOWHERE, ..Patch::default() };
        echoes(hits, self.range_resolution_m, |echo| {
            let cosine = echo.cosine.clamp(1e-3, 1.0);
            let tan2 = (1.0 - cosine * cosine) / (cosine * cosine);
            let slope2 = self.slope_rad.powi(2);
            let facets = self.reflectivity * (-tan2 / (2.0 * slope2)).exp()
                / (2.0 * slope2 * cosine.powi(4));
            // Per area of surface. A ray covers an area of range^2 dOmega / cosine.
            let per_area = self.gamma * cosine + facets;
            let area_m2 = echo.range_m.powi(2) * ray.solid_angle_sr / cosine * echo.weight;
            let cross_section_m2 = ray.gain * per_area * area_m2;
            if !(cross_section_m2 > patch.cross_section_m2 && echo.range_m >= self.min_range_m) {
                return;
            }
            let p_world_m = origin_m + direction * f64::from(echo.range_m);
            let relative_mps = velocity(motion, echo.tag.part, p_world_m) - own_velocity(motion);
            let speed_mps = relative_mps.dot(direction) as f32;
            let cell = |value: f32, step: f32| (value / step).floor() as i32;
            patch = Patch {
                cell: [
                    cell(echo.range_m, self.range_resolution_m),
                    cell(ray.azimuth_rad, self.azimuth_resolution_rad),
                    cell(speed_mps + 0.5 * self.speed_resolution_mps, self.speed_resolution_mps),
                ],
                ray: 0,
                range_m: echo.range_m,
                azimuth_rad: ray.azimuth_rad,
                speed_mps,
                cross_section_m2,
                object: echo.tag.id,
            };
        });
        patch
    }

    fn detect(&self, cell: &[Patch], mut draws: Draws) -> Option<RadarDetection> {
        let sum =
            |of: fn(&Patch) -> f32| cell.iter().map(|p| p.cross_section_m2 * of(p)).sum::<f32>();
        let cross_section_m2 = sum(|_| 1.0);
        let mean = |of| sum(of) / cross_section_m2;
        let range_m = mean(|p| p.range_m);
        let over = cross_section_m2 * (self.reference_range_m / range_m.max(1e-2)).powi(4);
        let snr = over * 10_f32.powf(self.threshold_db / 10.0);
        // Noise of the cell adds to the signal's power, as a Gaussian with the root of the sum, for
        // some dozens of chirps.
        let [power, range_error] = draws.gaussians();
        let [azimuth_error, speed_error] = draws.gaussians();
        let measured = (snr + power * (1.0 + 2.0 * snr).sqrt()).max(1e-3);
        let snr_db = 10.0 * measured.log10();
        if !(snr_db >= self.threshold_db) {
            return None;
        }
        let error = 1.0 / (2.0 * snr.max(1.0)).sqrt();
        let range_m = range_m + self.range_resolution_m * error * range_error;
        if !(range_m >= self.min_range_m && range_m <= self.max_range_m) {
            return None;
        }
        let speed_mps = mean(|p| p.speed_mps) + self.speed_resolution_mps * error * speed_error;
        let strongest =
            cell.iter().max_by(|a, b| a.cross_section_m2.total_cmp(&b.cross_section_m2));
        Some(RadarDetection {
            range_m,
            azimuth_rad: mean(|p| p.azimuth_rad)
                + self.azimuth_resolution_rad * error * azimuth_error,
            speed_mps: folded(speed_mps, self.max_speed_mps),
            snr_db,
            cross_section_m2,
            object: strongest.map_or(0, |patch| patch.object),
        })
    }
}

/// Returns a speed folded to within plus and minus `most_mps`, as chirps measure it.
fn folded(speed_mps: f32, most_mps: f32) -> f32 {
    (speed_mps + most_mps).rem_euclid(2.0 * most_mps) - most_mps
}

/// Returns the velocity of the sensor. [m/s, world]
fn own_velocity(motion: &SensorMotion<'_>) -> DVec3 {
    let [begin, end] = motion.world_from_sensor;
    per(motion.duration_s, end.translation_m - begin.translation_m)
}

/// Returns the velocity of the point of a part that is at `p_world_m` in the middle of the motion.
/// [m/s, world]
fn velocity(motion: &SensorMotion<'_>, part: u16, p_world_m: DVec3) -> DVec3 {
    let object = usize::from(part).checked_sub(1).and_then(|i| motion.objects.get(i));
    let Some([Some(begin), Some(end)]) = object else { return DVec3::ZERO };
    let p_object_m = begin.interpolate(end, 0.5).inverse().transform_point(p_world_m);
    per(motion.duration_s, end.transform_point(p_object_m) - begin.transform_point(p_object_m))
}

fn per(duration_s: f64, way_m: DVec3) -> DVec3 {
    if duration_s > 0.0 { way_m / duration_s } else { DVec3::ZERO }
}
