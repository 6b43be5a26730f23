//! Single-beam range finders: light within a narrow cone, and sound in a wide one, with some dozens
//! of rays per reading.
//!
//! Both point along x and report one range. Rays fill the cone evenly; the echo (`cast`) of each is
//! weighted by its share of the cone. Light returns from a Lambertian surface, as in `lidar`, and
//! the strongest group of echoes within the receiver's resolution is reported. Sound is reflected
//! by surfaces that are smooth at its wavelength: a facet of the surface returns the sound if it
//! faces the sensor, and slopes of facets are Gaussian (Beckmann and Spizzichino 1963, "The
//! scattering of electromagnetic waves from rough surfaces", chapter 5: `exp(-tan^2(incidence) / (2
//! slope^2)) / cos^4(incidence)`). A share is scattered diffusely, by Lambert's law. Sound spreads
//! both ways and is absorbed by air (ISO 9613-1), and the first group above the threshold is
//! reported.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::cast::{Beam, Echo, Hits, TOGETHER, echoes};
use super::lidar::rounded;
use super::noise::Draws;
use super::{Checked, InvalidModel, SensorError, SensorMotion, SensorScene};

/// Optical range finder model, in the terms of its data sheet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RangeModel {
    /// Rate of readings. [Hz]
    pub rate_hz: f64,
    /// Full angle of the field of view. [rad]
    pub fov_rad: f32,
    /// Minimum range. [m]
    pub min_range_m: f32,
    /// Maximum range. [m]
    pub max_range_m: f32,
    /// Standard deviation of a range. [m]
    pub sigma_m: f32,
    /// Growth of the standard deviation per metre of range. [m/m]
    pub sigma_per_m: f32,
    /// Quantisation step of ranges; 0 for no rounding. [m]
    pub range_step_m: f32,
    /// Maximum distance of two echoes that are merged. [m]
    pub resolution_m: f32,
    /// Range at which a target that fills the cone, of `reference_reflectivity`, is detected with a
    /// probability of 90 %. [m]
    pub reference_range_m: f32,
    /// Share of light that the reference target reflects, 0 to 1.
    pub reference_reflectivity: f32,
}

/// Ultrasonic range finder model, in the terms of its data sheet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SonarModel {
    /// Rate of readings. [Hz]
    pub rate_hz: f64,
    /// Full angle of the cone in which the two-way power is at least a quarter of that on axis (-6 dB).
    /// [rad]
    pub beam_rad: f32,
    /// Minimum range. [m]
    pub min_range_m: f32,
    /// Maximum range. [m]
    pub max_range_m: f32,
    /// Standard deviation of a range. [m]
    pub sigma_m: f32,
    /// Growth of the standard deviation per metre of range, due to air temperature. [m/m]
    pub sigma_per_m: f32,
    /// Quantisation step of ranges; 0 for no rounding. [m]
    pub range_step_m: f32,
    /// Half the length of the pulse in air: echoes within it are added. [m]
    pub resolution_m: f32,
    /// Absorption by air, one way. [dB/m]
    pub absorption_db_per_m: f32,
    /// Standard deviation of a surface's slopes: tolerance of its orientation for reflecting the
    /// pulse back. [rad]
    pub slope_rad: f32,
    /// Share of the power that a surface scatters diffusely instead.
    pub diffuse: f32,
    /// Range at which a wall across the cone is detected with a probability of 90 %. [m]
    pub reference_range_m: f32,
}

/// Reading of a range finder.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RangeReading {
    /// Range; 0 if there is no echo. [m]
    pub range_m: f32,
    /// Power of the echo over the detection threshold: at 1, the detection probability is 90 %; 0
    /// without echo.
    pub strength: f32,
    /// Id of the object with the largest share of the echo; 0 is the static scene.
    pub object: u16,
}

/// Prepared [`RangeModel`].
#[derive(Clone, Debug)]
pub struct RangeFinder {
    model: RangeModel,
    cone: Cone,
}

/// Prepared [`SonarModel`].
#[derive(Clone, Debug)]
pub struct Sonar {
    model: SonarModel,
    cone: Cone,
    /// Power of an echo at the threshold.
    threshold: f32,
}

/// Rays that fill a cone about x, and the share of the cone for each ray.
#[derive(Clone, Debug)]
struct Cone {
    rays: Vec<(Vec3, f32)>,
    /// Standard deviation of each ray's footprint per metre: half the distance to its neighbours. [rad]
    spread: f32,
}

/// Echo of one ray at the receiver.
#[derive(Clone, Copy, Debug, Default)]
struct Received {
    range_m: f32,
    power: f32,
    object: u16,
}

/// Maximum echoes of one reading: three for each ray. Further echoes are ignored.
const MAX_RECEIVED: usize = 3 * MAX_RAYS;
/// Maximum rays: 1 + 3 n (n + 1) for n = 8 rings.
const MAX_RAYS: usize = 217;
/// Maximum angle between rings. [rad]
const RING_RAD: f32 = 0.03;
/// Noise of the threshold as a share of it, and quantile of the normal distribution at 90 %: as in
/// `lidar`.
const THRESHOLD_NOISE: f32 = 0.25;
const NINE_IN_TEN: f32 = 1.281_551_6;

impl Cone {
    /// Creates rays within `half_rad` of x, weighted by `gain` of their angle from x.
    fn new(half_rad: f32, gain: impl Fn(f32) -> f32) -> Self {
        let rings = ((half_rad / RING_RAD).ceil() as usize).clamp(1, 8);
        let mut rays = vec![(Vec3::X, gain(0.0))];
        let apart = half_rad / (rings as f32 + 0.5);
        for ring in 1..=rings {
            // Rings of equal width, each with six rays more than the previous: all rays cover the
            // same solid angle.
            let angle = apart * ring as f32;
            let count = 6 * ring;
            for n in 0..count {
                let turn =
                    std::f64::consts::TAU * (n as f64 + 0.5 * (ring % 2) as f64) / count as f64;
                let (y, z) = turn.sin_cos();
                let (sin, cos) = f64::from(angle).sin_cos();
                rays.push((Vec3::new(cos as f32, (sin * y) as f32, (sin * z) as f32), gain(angle)));
            }
        }
        let sum: f32 = rays.iter().map(|(_, weight)| weight).sum();
        for (_, weight) in &mut rays {
            *weight /= sum;
        }
        Self { rays, spread: apart / 2.0 }
    }

    /// Collects the echoes of all rays, nearest first, and returns their number. `power` returns
    /// the received power, given the share of the cone and the echo.
    fn receive(
        &self,
        scene: &SensorScene,
        motion: &SensorMotion<'_>,
        max_m: f32,
        resolution_m: f32,
        received: &mut [Received; MAX_RECEIVED],
        power: impl Fn(f32, &Echo) -> f32,
    ) -> usize {
        let (mut count, mut hits) = (0, [Hits::new(); TOGETHER]);
        let world_from_sensor = motion.sensor_at(0.5);
        let beam = |n: usize| {
            let direction = world_from_sensor.rotate(self.rays[n].0.as_dvec3()).normalize();
            let origin_m = world_from_sensor.translation_m;
            (0.5, Beam { origin_m, direction, spread: self.spread, max_m })
        };
        scene.cast_each(motion, self.rays.len(), &mut hits, beam, |n, hits| {
            echoes(hits, resolution_m, |echo| {
                let power = power(self.rays[n].1, &echo);
                if count < MAX_RECEIVED && power > 0.0 {
                    received[count] =
                        Received { range_m: echo.range_m, power, object: echo.tag.id };
                    count += 1;
                }
            });
        });
        received[..count].sort_unstable_by(|a, b| {
            a.range_m.total_cmp(&b.range_m).then(a.power.total_cmp(&b.power))
        });
        count
    }
}

/// Returns the threshold of one reading, and its standard normal error.
fn threshold(seed: u64, seq: u64) -> (f32, f32) {
    let [threshold, error] = Draws::new(seed, seq, 0).gaussians();
    (1.0 + THRESHOLD_NOISE * (threshold - NINE_IN_TEN), error)
}

/// Returns the object with the highest power.
fn object_of(group: &[Received]) -> u16 {
    let strongest = group.iter().max_by(|a, b| a.power.total_cmp(&b.power));
    strongest.map_or(0, |echo| echo.object)
}

impl RangeFinder {
    /// Prepares a model.
    ///
    /// # Errors
    /// [`InvalidModel`] with the first invalid field.
    pub fn new(model: RangeModel) -> Result<Self, InvalidModel> {
        let check = Checked("range finder");
        check.common(
            model.rate_hz,
            [model.min_range_m, model.max_range_m],
            [model.sigma_m, model.sigma_per_m, model.range_step_m, model.resolution_m],
            model.reference_range_m,
        )?;
        check.within("fov_rad", model.fov_rad, [0.0, 1.6], "0 to 1.6")?;
        check.within(
            "reference_reflectivity",
            model.reference_reflectivity,
            [1e-3, 1.0],
            "0.001 to 1",
        )?;
        let cone = Cone::new(model.fov_rad / 2.0, |_| 1.0);
        Ok(Self { model, cone })
    }

    /// Returns the model of this range finder.
    pub fn model(&self) -> &RangeModel {
        &self.model
    }

    /// Measures reading `seq` in the middle of `motion`. All noise follows from `seed` and `seq`.
    ///
    /// # Errors
    /// [`SensorError`].
    ///
    /// # Panics
    /// If the numbers of objects of `motion` and of the scene differ.
    pub fn measure(
        &self,
        scene: &SensorScene,
        motion: &SensorMotion<'_>,
        seed: u64,
        seq: u64,
    ) -> Result<RangeReading, SensorError> {
        motion.validate(scene)?;
        let model = &self.model;
        let mut received = [Received::default(); MAX_RECEIVED];
        let scale = model.reference_range_m.powi(2) / model.reference_reflectivity;
        let count = self.cone.receive(
            scene,
            motion,
            model.max_range_m,
            model.resolution_m,
            &mut received,
            |share, echo| share * echo.power * scale / echo.range_m.max(1e-3).powi(2),
        );
        let received = &received[..count];
        let mut best: (f32, &[Received]) = (0.0, &[]);
        for (i, first) in received.iter().enumerate() {
            let group = &received[i..];
            let within =
                group.iter().take_while(|r| r.range_m - first.range_m <= model.resolution_m);
            let group = &group[..within.count()];
            let power: f32 = group.iter().map(|r| r.power).sum();
            if power > best.0 {
                best = (power, group);
            }
        }
        let (power, group) = best;
        let (threshold, error) = threshold(seed, seq);
        if !(power >= threshold && power > 0.0) {
            return Ok(RangeReading::default());
        }
        let mean_m = group.iter().map(|r| r.range_m * r.power).sum::<f32>() / power;
        let sigma_m = model.sigma_m + model.sigma_per_m * mean_m;
        let range_m = rounded(mean_m + sigma_m * error, model.range_step_m);
        if !(range_m >= model.min_range_m && range_m <= model.max_range_m) {
            return Ok(RangeReading::default());
        }
        Ok(RangeReading { range_m, strength: power, object: object_of(group) })
    }
}

impl Sonar {
    /// Prepares a model.
    ///
    /// # Errors
    /// [`InvalidModel`] with the first invalid field.
    pub fn new(model: SonarModel) -> Result<Self, InvalidModel> {
        let check = Checked("sonar");
        check.common(
            model.rate_hz,
            [model.min_range_m, model.max_range_m],
            [model.sigma_m, model.sigma_per_m, model.range_step_m, model.resolution_m],
            model.reference_range_m,
        )?;
        check.within("beam_rad", model.beam_rad, [0.01, 2.5], "0.01 to 2.5")?;
        check.within("absorption_db_per_m", model.absorption_db_per_m, [0.0, 20.0], "0 to 20")?;
        check.within("slope_rad", model.slope_rad, [0.01, 1.0], "0.01 to 1")?;
        check.within("diffuse", model.diffuse, [0.0, 1.0], "0 to 1")?;
        // A quarter of the power at half the beam angle. The cone ends where a hundredth is left.
        let half = model.beam_rad / 2.0;
        let gain = move |angle: f32| 0.25_f32.powf((angle / half).powi(2));
        let cone = Cone::new((half * 1.82).min(1.3), gain);
        let mut sonar = Self { model, cone, threshold: 1.0 };
        sonar.threshold = sonar.of_wall(sonar.model.reference_range_m);
        Ok(sonar)
    }

    /// Returns the model of this sonar.
    pub fn model(&self) -> &SonarModel {
        &self.model
    }

    /// Returns the power that returns from a wall across the axis, within one pulse length of its
    /// nearest point.
    fn of_wall(&self, range_m: f32) -> f32 {
        let rays = self.cone.rays.iter();
        let powers = rays.map(|&(direction, share)| {
            let cosine = direction.x;
            let slant_m = range_m / cosine;
            let heard = slant_m - range_m <= self.model.resolution_m;
            if heard { share * self.returned(cosine, slant_m) } else { 0.0 }
        });
        powers.sum()
    }

    /// Returns the received power per power sent along a ray, relative to 1 m without air.
    fn returned(&self, cosine: f32, range_m: f32) -> f32 {
        let model = &self.model;
        let cosine = cosine.clamp(1e-3, 1.0);
        let tan2 = (1.0 - cosine * cosine) / (cosine * cosine);
        // A share of 1 / (2 slope^2) of Gaussian facets faces the sensor, compared with the 4 pi of
        // a diffuse scatterer.
        let facets = (-tan2 / (2.0 * model.slope_rad.powi(2))).exp()
            / (8.0 * model.slope_rad.powi(2) * cosine.powi(4));
        let scattered = (1.0 - model.diffuse) * facets + model.diffuse * cosine;
        let absorbed = 10_f32.powf(-2.0 * model.absorption_db_per_m * range_m / 10.0);
        scattered * absorbed / range_m.max(1e-2).powi(2)
    }

    /// Measures reading `seq` in the middle of `motion`. All noise follows from `seed` and `seq`.
    ///
    /// # Errors
    /// [`SensorError`].
    ///
    /// # Panics
    /// If the numbers of objects of `motion` and of the scene differ.
    pub fn measure(
        &self,
        scene: &SensorScene,
        motion: &SensorMotion<'_>,
        seed: u64,
        seq: u64,
    ) -> Result<RangeReading, SensorError> {
        motion.validate(scene)?;
        let model = &self.model;
        let mut received = [Received::default(); MAX_RECEIVED];
        let count = self.cone.receive(
            scene,
            motion,
            model.max_range_m,
            model.resolution_m,
            &mut received,
            // Sound does not depend on colour.
            |share, echo| {
                share * echo.weight * self.returned(echo.cosine, echo.range_m) / self.threshold
            },
        );
        let received = &received[..count];
        let (threshold, error) = threshold(seed, seq);
        for (i, first) in received.iter().enumerate() {
            let group = &received[i..];
            let within =
                group.iter().take_while(|r| r.range_m - first.range_m <= model.resolution_m);
            let group = &group[..within.count()];
            let power: f32 = group.iter().map(|r| r.power).sum();
            // The first echo must have a minimum power, because its edge is timed.
            if !(power >= threshold && first.power >= 0.002 * power) {
                continue;
            }
            let sigma_m = model.sigma_m + model.sigma_per_m * first.range_m;
            let measured_m = rounded(first.range_m + sigma_m * error, model.range_step_m);
            // Distances below the minimum range read as the minimum range.
            let range_m = measured_m.max(model.min_range_m);
            if range_m > model.max_range_m {
                return Ok(RangeReading::default());
            }
            return Ok(RangeReading { range_m, strength: power, object: object_of(group) });
        }
        Ok(RangeReading::default())
    }
}

#[cfg(test)]
mod shape {
    use super::*;

    #[test]
    fn fills_the_cone_evenly_with_rays() {
        let cone = Cone::new(0.3, |_| 1.0);
        assert_eq!(cone.rays.len(), 217);
        assert!(cone.rays.iter().all(|(ray, _)| (ray.length() - 1.0).abs() < 1e-6));
        // The inner 5.5 of 8.5 ring widths cover their share of the solid angle.
        let inner: f32 = cone
            .rays
            .iter()
            .filter(|(ray, _)| ray.x.acos() < 0.3 * 5.5 / 8.5)
            .map(|(_, share)| share)
            .sum();
        assert!((inner - (5.5_f32 / 8.5).powi(2)).abs() < 0.01, "{inner}");
    }
}
