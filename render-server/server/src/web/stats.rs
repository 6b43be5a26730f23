//! `GET /api/stats`: where the images of a vehicle get their age, what became of them, and how its
//! connection fares. `vizflyt stats` and the page show it.

use serde::{Deserialize, Serialize};
use vizflyt_arena::pose::PoseQuality;
use vizflyt_protocol::messages::{StageTimes, Timing};

use crate::flights::vehicle::VehicleFlight;
use crate::stream::Rooms;
use crate::stream::connection::Connection;
use crate::stream::delivery::CameraDelivery;
use crate::timing::StageDurations;
use vizflyt_process::lock;

/// The figures of one vehicle's images, as `GET /api/stats` returns them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VehicleStats {
    /// The vehicle's name.
    pub vehicle: String,
    /// The runtime that flies it, and where it is; absent if there is none.
    pub runtime: Option<String>,
    /// What the server's own stages take, of all vehicles. [ms]
    pub server: ServerStages,
    /// Where images get their age, by the runtime's newest report.
    pub timing: Option<Timing>,
    /// What became of the images of this flight, by camera.
    pub images: Vec<CameraDelivery>,
    /// How the connection fares.
    pub connection: Option<Connection>,
    /// How good the localization is.
    pub pose: PoseQuality,
}

/// Percentiles of the server's own stages. [ms]
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ServerStages {
    /// Arrival of a pose to the end of gate and referee.
    pub pose: StageTimes,
    /// Rendering all cameras of a tick.
    pub render: StageTimes,
    /// Quantising and encoding one image.
    pub encode: StageTimes,
    /// Handing an image over until the runtime has acknowledged all of it.
    pub send: StageTimes,
}

impl ServerStages {
    /// Returns the stages by `times`: of the recent past, or of the whole run.
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
    /// Returns the figures of `vehicle` at this moment.
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
