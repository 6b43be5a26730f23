//! Flights: control leases, events, tracks, crash cards, the leaderboard, the lab day.
//!
//! ```text
//! in   poses and the referee's events, from the pose thread; reports of the runtimes; commands of
//!      users (start, land, stop, reset), from the page
//! out  events, to runtimes, page and standard output; runs, to the database; crash cards, to the page
//! ```
//! Imports no other room: all rooms report to this one.

pub mod check_in;
pub mod control_lease;
pub mod crash;
pub mod crash_card;
pub mod events;
pub mod lab_day;
pub mod leaderboard;
pub mod recent_previews;
mod recorder;
pub mod samples;
pub mod track;
pub mod vehicle;

pub(crate) use recorder::record;

use std::sync::Arc;

use self::leaderboard::Leaderboard;
use self::vehicle::VehicleFlight;

#[derive(Debug)]
pub struct Flights {
    /// Random number by which a runtime detects a restart of the server.
    pub instance_id: u64,
    /// Flights by index of the vehicle; at least one, at most
    /// [`MAX_VEHICLES`](vizflyt_arena::config::MAX_VEHICLES).
    pub vehicles: Vec<Arc<VehicleFlight>>,
    /// Database of runs; `None` if disabled.
    pub leaderboard: Option<Leaderboard>,
}

impl Flights {
    /// Creates the state of a server at its start.
    pub fn new(vehicles: Vec<VehicleFlight>, leaderboard: Option<Leaderboard>) -> Self {
        Self {
            instance_id: vizflyt_trust::random_instance_id(),
            vehicles: vehicles.into_iter().map(Arc::new).collect(),
            leaderboard,
        }
    }

    /// Returns the vehicle with this name.
    ///
    /// # Errors
    /// Reason of the refusal, for the user.
    pub fn vehicle(&self, name: &str) -> Result<&Arc<VehicleFlight>, String> {
        self.vehicles.iter().find(|vehicle| vehicle.name == name).ok_or_else(|| {
            let names: Vec<_> = self.vehicles.iter().map(|v| format!("'{}'", v.name)).collect();
            let first = self.vehicles.first().map_or("NAME", |vehicle| &vehicle.name);
            format!(
                "no vehicle '{name}' here, only {}; start the runtime with --vehicle {first}",
                names.join(", ")
            )
        })
    }

    /// Logs a note for the pages of all vehicles; runtimes do not receive it.
    pub fn note(&self, text: &str) {
        for vehicle in &self.vehicles {
            vehicle.note(text);
        }
    }

    /// Returns whether any flight is under way.
    pub fn any_under_way(&self) -> bool {
        self.vehicles.iter().any(|vehicle| vehicle.under_way())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejects_an_unknown_vehicle_with_the_known_names() {
        let vehicles = ["wasp", "bee"].iter().enumerate();
        let vehicles = vehicles.map(|(index, name)| vehicle::tests::named(index, name));
        let flights = Flights::new(vehicles.collect(), None);
        assert_eq!(flights.vehicle("bee").map(|vehicle| vehicle.index), Ok(1));
        assert_eq!(
            flights.vehicle("fly").unwrap_err(),
            "no vehicle 'fly' here, only 'wasp', 'bee'; start the runtime with --vehicle wasp"
        );
    }
}
