//! What the encode thread, the sessions and the senders of images share.

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
    /// Who wants images.
    pub subscriptions: Subscriptions,
    /// One for each vehicle, at its index.
    pub vehicles: Vec<VehicleStream>,
    /// What may be lowered toward a runtime whose link is too slow.
    pub adapt: Adaptation,
    /// Quantising and encoding one camera's image.
    pub encode_durations: StageDurations,
    /// Where guardians subscribe to poses; 0 is nowhere.
    pub feed_port: AtomicU16,
    /// Handing an image to the transport until the runtime has acknowledged all of it.
    pub send_durations: StageDurations,
}

impl Streaming {
    /// Returns the state for vehicles with this many cameras each, without a subscriber.
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

/// The state of this room and of those below it, as sessions and pages need it.
#[derive(Clone, Debug)]
pub struct Rooms {
    /// Who flies, and how it goes.
    pub flights: Arc<Flights>,
    /// Where the vehicles are.
    pub localization: Arc<Localization>,
    /// What is rendered.
    pub rendering: Arc<Rendering>,
    /// Who gets images.
    pub streaming: Arc<Streaming>,
    /// The end of the program.
    pub stop: Stop,
}

impl Rooms {
    /// Returns what the threads that render and measure work with.
    pub fn render_inputs(&self) -> Inputs<'_, Streaming> {
        Inputs {
            rendering: &self.rendering,
            localization: &self.localization,
            flights: &self.flights,
            demand: &self.streaming,
        }
    }

    /// Returns the state of a server for vehicles, each with name, arena and cameras: without a
    /// leaderboard, pose sources and objects, as benchmarks and tests serve them.
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

    /// Returns how many ticks were rendered so far.
    pub fn ticks(&self) -> u64 {
        self.rendering.ticks.load(Ordering::Relaxed)
    }
}
