//! `GET /api/stats`: age of a vehicle's images by stage, delivered and dropped images, and connection quality. `vizflyt
//! stats` and the page show it.

use serde::{Deserialize, Serialize};
use vizflyt_arena::pose::PoseQuality;
use vizflyt_protocol::messages::{StageTimes, Timing};

use crate::flights::vehicle::VehicleFlight;
use crate::stream::Rooms;
use crate::stream::connection::Connection;
use crate::stream::delivery::CameraDelivery;
use crate::timing::StageDurations;
use vizflyt_process::lock;

/// Figures of one vehicle's images, as returned by `GET /api/stats`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VehicleStats {
    /// Name of the vehicle.
    pub vehicle: String,
    /// Program and address of the connected runtime; absent without one.
    pub runtime: Option<String>,
    /// Durations of the server's stages, over all vehicles. [ms]
    pub server: ServerStages,
    /// Image age by stage, from the runtime's newest report.
    pub timing: Option<Timing>,
    /// Delivered and dropped images of this flight, by camera.
    pub images: Vec<CameraDelivery>,
    /// Quality of the connection.
    pub connection: Option<Connection>,
    /// Quality of the localization.
    pub pose: PoseQuality,
}

/// Percentiles of the server's own stages. [ms]
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ServerStages {
    /// From arrival of a pose to the end of gate and referee.
    pub pose: StageTimes,
    /// Rendering all cameras of a tick.
    pub render: StageTimes,
    /// Quantising and encoding one image.
    pub encode: StageTimes,
    /// From handing an image over until the runtime has acknowledged all of it.
    pub send: StageTimes,
}

impl ServerStages {
    /// Returns the stages, measured by `times`: over the recent past, or over the whole run.
    pub(crate) fn of(rooms: &Rooms, times: fn(&StageDurations) -> StageTimes) -> Self {
        Self {
            pose: times(&rooms.localization.durations),
            render: times(&rooms.rendering.durations),
            encode: times(&rooms.streaming.encode_durations),
            send: times(&rooms.streaming.send_durations),
        }
    }
}

impl VehicleStats {
    /// Returns the current figures of `vehicle`.
    pub(super) fn of(rooms: &Rooms, vehicle: &VehicleFlight) -> Self {
        let stream = &rooms.streaming.vehicles[vehicle.index];
        let runtime = vehicle.runtime();
        Self {
            vehicle: vehicle.name.as_str().to_owned(),
            runtime: runtime.map(|runtime| format!("{} at {}", runtime.program, runtime.address)),
            server: ServerStages::of(rooms, StageDurations::recent),
            timing: stream.timing.borrow().clone(),
            images: stream.deliveries(&vehicle.arena.cameras),
            connection: stream.connection(),
            pose: lock(&rooms.localization.vehicles[vehicle.index].quality).clone(),
        }
    }
}
