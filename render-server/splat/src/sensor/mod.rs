//! Models of LiDAR, range finder, sonar and radar: pure functions from (scene, motion, seed) to
//! readings.
//!
//! A [`SensorScene`] packs a scene once. A sensor is a plain model ([`LidarModel`], [`RangeModel`],
//! [`SonarModel`], [`RadarModel`], named ones in [`presets`]). After it is prepared once, it
//! measures any number of times into records that the caller owns, without allocation after the
//! first call. Its input is a [`SensorMotion`]: the poses of sensor and objects from the first to
//! the last instant of a measurement.
//!
//! Data flow, the files in order of execution: `tree` packs splats for ray casting, `follow` finds
//! the splats along a ray, `cast` combines them to echoes of a beam, `lidar`, `range` (single-beam
//! range finder and sonar) and `radar` convert echoes to readings, with random numbers of `noise`.
//! All randomness follows from (seed, sequence number, beam), so the result does not depend on the
//! number of threads.
//!
//! Axes of a sensor: x forward, y left, z up. `docs/guides/sensor-models.md` lists every formula
//! and its source.

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

/// Poses of a sensor and of the scene's objects at the first and last instant of a measurement. In
/// between, positions are interpolated linearly and rotations by slerp.
#[derive(Clone, Copy, Debug)]
pub struct SensorMotion<'a> {
    /// Pose of the sensor at the first and at the last instant. [m, world]
    pub world_from_sensor: [Pose<World, Sensor>; 2],
    /// Poses of each object of the scene, in its order, at both instants. An object is absent if
    /// either is `None`. [m, world]
    pub objects: &'a [[Placement; 2]],
    /// Duration from the first to the last instant. Velocities follow from the change of poses. 0
    /// if nothing moves. [s]
    pub duration_s: f64,
}

impl SensorMotion<'_> {
    /// Returns the motion of a stationary sensor in a scene without objects.
    pub fn standing(world_from_sensor: Pose<World, Sensor>) -> SensorMotion<'static> {
        SensorMotion { world_from_sensor: [world_from_sensor; 2], objects: &[], duration_s: 0.0 }
    }

    /// Returns the pose of the sensor at a share of the duration, 0 to 1. [m, world]
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

/// Error of a measurement. The records are then empty.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SensorError {
    /// The pose of the sensor is invalid.
    #[error("the sensor is at {0}; expected a rotation and a finite position within 1e7 m")]
    Pose(String),
    /// The placement of an object is invalid.
    #[error("object {0} is placed at {1}; expected a rotation and a finite position within 1e7 m")]
    Placement(usize, String),
    /// The duration is invalid.
    #[error("a measurement of {0} s; give 0 to 10")]
    Duration(f64),
}

/// Why a sensor model is invalid.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{sensor}: {field} is {value}; give {expected}")]
pub struct InvalidModel {
    /// Kind of the sensor.
    pub sensor: &'static str,
    /// Name of the invalid field.
    pub field: &'static str,
    /// Value of the field.
    pub value: f64,
    /// Valid values.
    pub expected: &'static str,
}

/// Validator of the fields of one sensor kind.
struct Checked(&'static str);

impl Checked {
    /// Checks that `value` is within `ends`, inclusive.
    fn within(
        &self,
        field: &'static str,
        value: f32,
        ends: [f32; 2],
        expected: &'static str,
    ) -> Result<(), InvalidModel> {
        // The comparisons are false for NaN, so NaN is rejected.
        if value >= ends[0] && value <= ends[1] {
            return Ok(());
        }
        Err(InvalidModel { sensor: self.0, field, value: f64::from(value), expected })
    }
}

impl Checked {
    /// Checks the fields that all range sensors share. `figures` are sigma, its growth, the step
    /// and the resolution.
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
