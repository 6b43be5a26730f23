//! LiDAR, range finders, sonar and radar: (scene, motion, seed) -> what they report. Pure functions, like the renderers.
//!
//! A [`SensorScene`] packs a scene once. A sensor is a plain model ([`LidarModel`], [`RangeModel`], [`SonarModel`],
//! [`RadarModel`], by name in [`presets`]); prepared once, it measures as often as asked, into records that the caller
//! keeps, without allocation after the first call. What it is told is a [`SensorMotion`]: where sensor and objects are from the
//! first instant of a measurement to its last.
//!
//! Data flow, the files in run order: `tree` packs splats for rays, `follow` takes a ray through them, `cast` makes of what it meets a beam's
//! echoes, `lidar`, `range` (one beam, and sonar) and `radar` make of echoes what the sensor reports, with the numbers of
//! `noise`. All randomness follows from (seed, sequence number, beam): the same for any number of threads.
//!
//! Axes of a sensor: x forward, y left, z up. `docs/guides/sensor-models.md` states every formula and its source.

mod cast;
mod follow;
mod lidar;
mod noise;
pub mod presets;
mod radar;
mod range;
mod tree;

use vizflyt_protocol::geometry::{Pose, Sensor, World};

use crate::Placement;
pub use cast::SensorScene;
pub use lidar::{Beams, Lidar, LidarModel, LidarPoint, Returns};
pub use radar::{Radar, RadarDetection, RadarModel};
pub use range::{RangeFinder, RangeModel, RangeReading, Sonar, SonarModel};

/// Where a sensor and the objects of its scene are while it measures: at the first instant, and at the last. Between them
/// they move evenly: along a line, and by slerp.
#[derive(Clone, Copy, Debug)]
pub struct SensorMotion<'a> {
    /// The sensor at the first and at the last instant. [m, world]
    pub world_from_sensor: [Pose<World, Sensor>; 2],
    /// Each object of the scene, in its order, at both instants; one that is `None` at either is not there. [m, world]
    pub objects: &'a [[Placement; 2]],
    /// From the first instant to the last; velocities are what changes in it. 0 where all stands still. [s]
    pub duration_s: f64,
}

impl SensorMotion<'_> {
    /// Returns the motion of a sensor that stands, in a scene without objects.
    pub fn standing(world_from_sensor: Pose<World, Sensor>) -> SensorMotion<'static> {
        SensorMotion { world_from_sensor: [world_from_sensor; 2], objects: &[], duration_s: 0.0 }
    }

    /// Returns the sensor's pose at a share of the duration, 0 to 1. [m, world]
    fn sensor_at(&self, share: f64) -> Pose<World, Sensor> {
        let [begin, end] = &self.world_from_sensor;
        if begin == end { *begin } else { begin.interpolate(end, share) }
    }

    fn validate(&self, scene: &SensorScene) -> Result<(), SensorError> {
        assert_eq!(scene.objects(), self.objects.len(), "one pair of placements per object");
        let within = |pose: glam::DVec3| pose.abs().max_element() <= 1e7;
        for pose in &self.world_from_sensor {
            if !(pose.is_valid() && within(pose.translation_m)) {
                return Err(SensorError::Pose(format!("{pose:?}")));
            }
        }
        for (i, pose) in self.objects.iter().enumerate().flat_map(|(i, o)| o.map(|pose| (i, pose)))
        {
            if let Some(pose) = pose
                && !(pose.is_valid() && within(pose.translation_m))
            {
                return Err(SensorError::Placement(i, format!("{pose:?}")));
            }
        }
        if !(self.duration_s >= 0.0 && self.duration_s <= 10.0) {
            return Err(SensorError::Duration(self.duration_s));
        }
        Ok(())
    }
}

/// Why nothing was measured; the records are empty then.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SensorError {
    /// A pose of the sensor.
    #[error("the sensor is at {0}, which is no rotation and finite position within 1e7 m")]
    Pose(String),
    /// A placement of an object.
    #[error("object {0} is placed at {1}, which is no rotation and finite position within 1e7 m")]
    Placement(usize, String),
    /// The duration.
    #[error("a measurement of {0} s; give 0 to 10")]
    Duration(f64),
}

/// What of a model cannot be.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{sensor}: {field} is {value}; give {expected}")]
pub struct InvalidModel {
    /// The sensor's kind.
    pub sensor: &'static str,
    /// The field of its model.
    pub field: &'static str,
    /// What it was.
    pub value: f64,
    /// What it may be.
    pub expected: &'static str,
}

/// Checks fields of a model, one after the other.
struct Checked(&'static str);

impl Checked {
    /// Whether `value` is within both ends.
    fn within(
        &self,
        field: &'static str,
        value: f32,
        ends: [f32; 2],
        expected: &'static str,
    ) -> Result<(), InvalidModel> {
        // Positive, so that NaN is refused.
        if value >= ends[0] && value <= ends[1] {
            return Ok(());
        }
        Err(InvalidModel { sensor: self.0, field, value: f64::from(value), expected })
    }
}

impl Checked {
    /// What range finders have in common: `figures` are sigma, its growth, the step and the resolution.
    fn common(
        &self,
        rate_hz: f64,
        range_m: [f32; 2],
        figures: [f32; 4],
        reference_range_m: f32,
    ) -> Result<(), InvalidModel> {
        self.within("rate_hz", rate_hz as f32, [0.1, 1000.0], "0.1 to 1000")?;
        self.within("min_range_m", range_m[0], [0.0, 1e3], "0 to 1000")?;
        self.within("max_range_m", range_m[1], [range_m[0], 1e4], "min_range_m to 10000")?;
        self.within("sigma_m", figures[0], [0.0, 10.0], "0 to 10")?;
        self.within("sigma_per_m", figures[1], [0.0, 1.0], "0 to 1")?;
        self.within("range_step_m", figures[2], [0.0, 1.0], "0 to 1")?;
        self.within("resolution_m", figures[3], [0.0, 10.0], "0 to 10")?;
        self.within("reference_range_m", reference_range_m, [1e-2, 1e4], "0.01 to 10000")
    }
}

#[cfg(test)]
mod tests;
