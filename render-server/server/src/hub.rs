//! What the threads and tasks of the server share.
//!
//! ```text
//! vehicles   each with its newest pose, cameras, events, lease: see [`crate::flights::vehicle`]
//! subscriptions     who wants images of which vehicle, and the way out to them
//! stats      what was measured, of all vehicles together
//! ```

use std::sync::{Arc, Mutex};

use serde::Serialize;
use vizflyt_arena::pose::Predict;

use crate::flights::leaderboard::Leaderboard;
use crate::flights::vehicle::Vehicle;
use crate::lock::lock;
use crate::poses::drivers::SourceCounters;
use crate::render::dynamic_objects::DynamicObjects;
use crate::render::environment::Environment;
use crate::stats::{Report, Stats};
use crate::stop::Stop;
use crate::stream::rate_control::Adaptation;
use crate::stream::subscriptions::Subscriptions;

/// Shared state of all vehicles in one arena.
#[derive(Debug)]
pub struct Hub {
    /// Drawn by lot at the start: a runtime tells by it that the server was restarted.
    pub boot: u64,
    /// The vehicles served, each at its index; at least one, at most [`MAX_VEHICLES`](vizflyt_arena::config::MAX_VEHICLES).
    pub vehicles: Vec<Arc<Vehicle>>,
    /// Which renderer draws, and why; it may give way to another in flight.
    pub renderer: Mutex<RendererInfo>,
    /// The end of the program.
    pub stop: Stop,
    /// What was measured.
    pub stats: Stats,
    /// Who wants images.
    pub subscriptions: Subscriptions,
    /// What may be lowered toward a runtime whose link is too slow.
    pub adapt: Adaptation,
    /// For which moment images are drawn.
    pub predict: Predict,
    /// The light and the fog that images show.
    pub environment: Environment,
    /// What moves in the twin.
    pub dynamic_objects: DynamicObjects,
    /// Where flights are written down; `None` if they are not.
    pub leaderboard: Option<Leaderboard>,
    /// What the sources of poses are called, by their index.
    pub source_names: Vec<String>,
    /// What the localization delivered, of all vehicles.
    pub source: Mutex<SourceCounters>,
}

/// Which renderer draws, for reports and the page.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct RendererInfo {
    /// What it runs on: `cpu avx2`, `gpu NVIDIA GeForce RTX 3080 (Vulkan)`.
    pub name: String,
    /// Why it is this one.
    pub reason: String,
}

impl Hub {
    /// Makes the state of a server that has seen nothing yet.
    pub fn new(vehicles: Vec<Vehicle>, renderer: RendererInfo, stop: Stop) -> Self {
        let cameras: Vec<_> = vehicles.iter().map(|vehicle| vehicle.previews.len()).collect();
        Self {
            boot: lot(),
            vehicles: vehicles.into_iter().map(Arc::new).collect(),
            renderer: Mutex::new(renderer),
            stop,
            stats: Stats::default(),
            subscriptions: Subscriptions::new(&cameras),
            adapt: Adaptation::default(),
            predict: Predict::default(),
            environment: Environment::default(),
            dynamic_objects: DynamicObjects::default(),
            leaderboard: None,
            source_names: Vec::new(),
            source: Mutex::default(),
        }
    }

    /// Returns the vehicle of this name.
    ///
    /// # Errors
    /// The reason to refuse, for a person.
    pub fn vehicle(&self, name: &str) -> Result<&Arc<Vehicle>, String> {
        self.vehicles.iter().find(|vehicle| vehicle.name == name).ok_or_else(|| {
            let names: Vec<_> = self.vehicles.iter().map(|v| format!("'{}'", v.name)).collect();
            let first = self.vehicles.first().map_or("NAME", |vehicle| &vehicle.name);
            format!(
                "no vehicle '{name}' here, only {}; start the runtime with --vehicle {first}",
                names.join(", ")
            )
        })
    }

    /// Logs something for the pages of all vehicles; runtimes have no use for it.
    pub fn note(&self, text: &str) {
        for vehicle in &self.vehicles {
            vehicle.note(text);
        }
    }

    /// Whether previews are made: a page looks at them, or a flight is under way, whose crash card
    /// they may be on.
    pub fn wants_previews(&self) -> bool {
        self.subscriptions.viewers() > 0 || self.vehicles.iter().any(|vehicle| vehicle.under_way())
    }

    /// Returns the report over the whole run.
    pub fn report(&self) -> Report {
        self.stats.report(&self.vehicles, *lock(&self.source), &lock(&self.renderer))
    }
}

/// Returns a number that no other run has drawn, as good as certainly; never 0.
fn lot() -> u64 {
    use std::hash::{BuildHasher, RandomState};
    // Keyed by the system's randomness.
    RandomState::new().hash_one(std::process::id()) | 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_vehicle_that_is_not_here_is_refused_with_the_names_of_those_that_are() {
        let vehicles = ["wasp", "bee"].iter().enumerate();
        let vehicles =
            vehicles.map(|(index, name)| crate::flights::vehicle::tests::named(index, name));
        let hub = Hub::new(vehicles.collect(), RendererInfo::default(), Stop::default());
        assert_eq!(hub.vehicle("bee").map(|vehicle| vehicle.index), Ok(1));
        assert_eq!(
            hub.vehicle("fly").unwrap_err(),
            "no vehicle 'fly' here, only 'wasp', 'bee'; start the runtime with --vehicle wasp"
        );
    }
}
