//! State shared by the encode thread, the sessions and the image senders.

use std::sync::Arc;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::Duration;

use vizflyt_arena::config::{CameraConfig, MAX_VEHICLES};
use vizflyt_protocol::messages::ArenaInfo;

use super::rate_control::Adaptation;
use super::subscriptions::Subscriptions;
use super::vehicle::VehicleStream;
use crate::flights::Flights;
use crate::flights::vehicle::VehicleFlight;
use crate::poses::Localization;
use crate::render::Rendering;
use crate::render::cameras::Cameras;
use crate::render::demand::Demand;
use crate::render::inputs::Inputs;
use crate::render::sensors::Sensors;
use crate::stop::Stop;
use crate::timing::StageDurations;

/// The streams of all vehicles.
#[derive(Debug)]
pub struct Streaming {
    pub subscriptions: Subscriptions,
    /// Streams by index of the vehicle.
    pub vehicles: Vec<VehicleStream>,
    /// Image properties that may be reduced on a slow link.
    pub adapt: Adaptation,
    /// Time to quantise and encode one camera's image.
    pub encode_durations: StageDurations,
    /// Port on which guardians subscribe to poses; 0 if closed.
    pub feed_port: AtomicU16,
    /// Time from handing an image to the transport until the runtime has acknowledged all of it.
    pub send_durations: StageDurations,
}

impl Streaming {
    /// Creates the state for vehicles with this many cameras each, without subscribers.
    pub fn new(cameras: &[usize], adapt: Adaptation) -> Self {
        Self {
            subscriptions: Subscriptions::new(cameras),
            vehicles: cameras.iter().map(|_| VehicleStream::default()).collect(),
            adapt,
            encode_durations: StageDurations::default(),
            feed_port: AtomicU16::new(0),
            send_durations: StageDurations::default(),
        }
    }
}

impl Demand for Streaming {
    fn wait_for_interest(&self, timeout: Duration) -> [bool; MAX_VEHICLES] {
        self.subscriptions.wait_for_interest(timeout)
    }

    fn has_viewers(&self) -> bool {
        self.subscriptions.viewers() > 0
    }

    fn shrink(&self, vehicle: usize) -> u32 {
        self.vehicles[vehicle].level().shrink
    }

    fn seen_after_s(&self, vehicle: usize) -> Option<f64> {
        self.vehicles[vehicle].seen_after_s()
    }

    fn count_rendered(&self, vehicle: usize, camera: usize) {
        self.vehicles[vehicle].images.cameras[camera].count_rendered();
    }
}

/// State of this room and of those below it, for sessions and pages.
#[derive(Clone, Debug)]
pub struct Rooms {
    pub flights: Arc<Flights>,
    pub localization: Arc<Localization>,
    pub rendering: Arc<Rendering>,
    pub streaming: Arc<Streaming>,
    pub stop: Stop,
}

impl Rooms {
    /// Returns the inputs of the threads that render and measure.
    pub fn render_inputs(&self) -> Inputs<'_, Streaming> {
        Inputs {
            rendering: &self.rendering,
            localization: &self.localization,
            flights: &self.flights,
            demand: &self.streaming,
        }
    }

    /// Creates the state of a server for vehicles, each with name, arena and cameras, without leaderboard, pose
    /// sources and objects. Benchmarks and tests use it.
    pub fn bare(
        vehicles: Vec<(&str, ArenaInfo, Vec<CameraConfig>)>,
        adapt: Adaptation,
        stop: Stop,
    ) -> Self {
        let counts: Vec<_> = vehicles.iter().map(|(.., cameras)| cameras.len()).collect();
        let sensors = counts.iter().map(|_| Sensors::default()).collect();
        let (mut flights, mut cameras) = (Vec::new(), Vec::new());
        for (index, (name, arena, configs)) in vehicles.into_iter().enumerate() {
            flights.push(VehicleFlight::new(index, name, arena));
            cameras.push(Cameras::new(configs));
        }
        Self {
            flights: Arc::new(Flights::new(flights, None)),
            localization: Arc::new(Localization::new(counts.len(), Vec::new())),
            rendering: Arc::new(Rendering { cameras, sensors, ..Rendering::default() }),
            streaming: Arc::new(Streaming::new(&counts, adapt)),
            stop,
        }
    }

    /// Returns the number of rendered ticks.
    pub fn ticks(&self) -> u64 {
        self.rendering.ticks.load(Ordering::Relaxed)
    }
}
