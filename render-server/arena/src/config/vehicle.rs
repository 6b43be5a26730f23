//! `[[vehicles]]`: the vehicles of the arena, each with its own spawn and cameras.

use std::collections::HashSet;

use serde::{Deserialize, Serialize};
use vizflyt_protocol::messages::MAX_CAMERAS;

use super::validate::{ConfigError, check_name, invalid};
use super::{ArenaConfig, Spawn};

/// `[[vehicles]]`: one vehicle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VehicleConfig {
    /// Name of the vehicle's object in the localization system; at most 24 bytes.
    pub name: String,
    /// Position and heading at the start; default: the arena's `spawn`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub spawn: Option<Spawn>,
    /// Names of the vehicle's cameras, in the order of their index in messages; default: all cameras.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cameras: Option<Vec<String>>,
    /// Names of the vehicle's sensors other than cameras; default: all sensors.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensors: Option<Vec<String>>,
}

impl VehicleConfig {
    /// Returns a vehicle with all cameras at the arena's spawn.
    pub fn named(name: &str) -> Self {
        Self { name: name.to_owned(), spawn: None, cameras: None, sensors: None }
    }
}

impl ArenaConfig {
    /// Returns the vehicles that fly: those in `names`, with their settings from `[[vehicles]]` if present;
    /// without names, all of `[[vehicles]]`; if there are none, one named `vizflyt`.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] for invalid names, and for too many vehicles.
    pub fn flying(&self, names: &[String]) -> Result<Vec<VehicleConfig>, ConfigError> {
        let known = |name: &String| self.vehicles.iter().find(|vehicle| vehicle.name == *name);
        let mut vehicles: Vec<_> = names
            .iter()
            .map(|name| known(name).cloned().unwrap_or_else(|| VehicleConfig::named(name)))
            .collect();
        if names.is_empty() {
            vehicles.clone_from(&self.vehicles);
        }
        if vehicles.is_empty() {
            vehicles.push(VehicleConfig::named(DEFAULT_NAME));
        }
        check_names(&vehicles, |_| "--vehicle".to_owned())?;
        Ok(vehicles)
    }

    /// Returns the arena for one vehicle: with its spawn, and only its cameras and sensors.
    #[must_use]
    pub fn of_vehicle(&self, vehicle: &VehicleConfig) -> Self {
        let mut arena = self.clone();
        arena.vehicles.clear();
        arena.spawn = vehicle.spawn.unwrap_or(self.spawn);
        if let Some(start) = &mut arena.rules.start_box {
            // The box moves with the spawn.
            let way_m = arena.spawn.position_m - self.spawn.position_m;
            (start.min_m, start.max_m) = (start.min_m + way_m, start.max_m + way_m);
        }
        if let Some(names) = &vehicle.cameras {
            let named = |name: &String| self.cameras.iter().find(|camera| camera.name == *name);
            arena.cameras = names.iter().filter_map(named).cloned().collect();
        }
        if let Some(names) = &vehicle.sensors {
            let named = |name: &String| self.sensors.iter().find(|sensor| sensor.name == *name);
            arena.sensors = names.iter().filter_map(named).cloned().collect();
        }
        arena
    }

    pub(super) fn check_vehicles(&self) -> Result<(), ConfigError> {
        check_names(&self.vehicles, |index| format!("vehicles[{index}].name"))?;
        let known: Vec<_> = self.cameras.iter().map(|camera| camera.name.as_str()).collect();
        for (index, vehicle) in self.vehicles.iter().enumerate() {
            if let Some(cameras) = &vehicle.cameras {
                let key = format!("vehicles[{index}].cameras");
                let mut taken = HashSet::new();
                for name in cameras {
                    if !known.contains(&name.as_str()) {
                        let advice = format!("is not among the [[cameras]]: {}", known.join(", "));
                        return Err(invalid(key, format!("{name:?}"), advice));
                    }
                    check_name(&key, name, &mut taken)?;
                }
                if cameras.is_empty() {
                    let advice = format!(
                        "give 1 to {MAX_CAMERAS} names of [[cameras]], or leave `cameras` out for all"
                    );
                    return Err(invalid(key, "[]", advice));
                }
            }
            let mut taken = HashSet::new();
            for name in vehicle.sensors.iter().flatten() {
                let key = format!("vehicles[{index}].sensors");
                if !self.sensors.iter().any(|sensor| sensor.name == *name) {
                    let advice = "is not among the [[sensors]]; name one that is, or add it there";
                    return Err(invalid(key, format!("{name:?}"), advice));
                }
                check_name(&key, name, &mut taken)?;
            }
            if let Some(spawn) = vehicle.spawn {
                self.check_spawn(&format!("vehicles[{index}].spawn"), spawn)?;
            }
        }
        Ok(())
    }
}

fn check_names(
    vehicles: &[VehicleConfig],
    key: impl Fn(usize) -> String,
) -> Result<(), ConfigError> {
    if vehicles.len() > MAX_VEHICLES {
        let advice = format!("one server serves at most {MAX_VEHICLES} vehicles; start another");
        return Err(invalid("vehicles", format!("{} of them", vehicles.len()), advice));
    }
    let mut taken = HashSet::new();
    for (index, vehicle) in vehicles.iter().enumerate() {
        let (key, name) = (key(index), &vehicle.name);
        check_name(&key, name, &mut taken)?;
        if name.len() > MAX_OBJECT_BYTES || name.contains('\0') {
            let advice = format!(
                "a localization system's object has a name of at most {MAX_OBJECT_BYTES} bytes"
            );
            return Err(invalid(key, format!("{name:?}"), advice));
        }
    }
    Ok(())
}

/// Maximum number of vehicles per server: a net holds no more.
pub const MAX_VEHICLES: usize = 8;
/// Bytes of a name in Vicon's UDP object stream.
const MAX_OBJECT_BYTES: usize = 24;
/// Vehicle name in the simulator and the examples.
const DEFAULT_NAME: &str = "vizflyt";
