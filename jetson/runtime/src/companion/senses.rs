//! Data that a plugin receives in addition to images.

use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::sensor::SensorInfo;
use vizflyt_sdk::{Battery, ImuSample, ObservationWriter, Vehicle};

use crate::stream::NewestReadings;

/// State of the vehicle as given to the plugin. Never contains data that the course withholds.
#[derive(Clone, Debug, Default)]
pub struct Senses {
    pub vehicle: Option<Vehicle>,
    pub battery: Battery,
    /// Newest IMU samples, oldest first.
    pub imu: Vec<ImuSample>,
    /// Whether the course gives the pose to the plugin.
    pub gives_pose: bool,
}

impl Senses {
    /// Writes the senses into an observation.
    pub fn write(&self, writer: &mut ObservationWriter<'_>) {
        if let Some(vehicle) = &self.vehicle {
            writer.vehicle(vehicle);
        }
        writer.battery(&self.battery);
        writer.imu(&self.imu);
    }

    /// Writes the pose from which an image was rendered into an observation, if the course gives the pose.
    pub fn write_pose_at_image(&self, writer: &mut ObservationWriter<'_>, header: &ImageHeader) {
        if self.gives_pose {
            writer.pose_at_image(header.camera.into(), &header.world_from_body());
        }
    }

    /// Writes the newest sensor readings into an observation.
    pub fn write_readings(
        &self,
        writer: &mut ObservationWriter<'_>,
        sensors: &[SensorInfo],
        readings: &NewestReadings,
    ) {
        let given = readings
            .each_ref()
            .map(|reading| reading.as_ref().map(|one| one.given(self.gives_pose)));
        writer.sensors(sensors, &given);
    }
}
