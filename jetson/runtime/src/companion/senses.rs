//! What a plugin may know beside images.

use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::sensor::SensorInfo;
use vizflyt_sdk::{Battery, ImuSample, ObservationWriter, Vehicle};

use crate::stream::NewestReadings;

/// The vehicle's state as the plugin may know it. What the course withholds is never in it.
#[derive(Clone, Debug, Default)]
pub struct Senses {
    /// The vehicle.
    pub vehicle: Option<Vehicle>,
    /// Its battery.
    pub battery: Battery,
    /// The newest IMU samples, oldest first.
    pub imu: Vec<ImuSample>,
    /// Whether the course lets the plugin know where the vehicle is.
    pub gives_pose: bool,
}

impl Senses {
    /// Writes them into an observation.
    pub fn write(&self, writer: &mut ObservationWriter<'_>) {
        if let Some(vehicle) = &self.vehicle {
            writer.vehicle(vehicle);
        }
        writer.battery(&self.battery);
        writer.imu(&self.imu);
    }

    /// Writes where an image was rendered from into an observation, where the course gives the pose.
    pub fn write_pose_at_image(&self, writer: &mut ObservationWriter<'_>, header: &ImageHeader) {
        if self.gives_pose {
            writer.pose_at_image(header.camera.into(), &header.world_from_body());
        }
    }

    /// Writes the sensors' newest readings into an observation.
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
