//! Current sensors of a vehicle; like cameras, they can be changed with the page and the API.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use serde_json::{Map, Value};
use tokio::sync::watch;
use vizflyt_arena::config::{ConfigError, SensorConfig};
use vizflyt_protocol::sensor::{MAX_SENSORS, ReadingHeader, SensorInfo};

use super::model::SensorModel;
use crate::render::cameras::ChangeError;

/// All sensors of a vehicle, in the order of their index in the protocol.
#[derive(Clone, Debug, Default)]
pub struct SensorSet {
    /// Settings as in `arena.toml`.
    pub configs: Vec<SensorConfig>,
    pub models: Vec<SensorModel>,
    /// Data sent to the runtime.
    pub infos: Vec<SensorInfo>,
}

impl SensorSet {
    /// Creates the models of sensors; at most [`MAX_SENSORS`].
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] for the first invalid model.
    pub fn new(configs: &[SensorConfig]) -> Result<Self, ConfigError> {
        let configs = configs[..configs.len().min(MAX_SENSORS)].to_vec();
        let mut set = Self { configs, ..Self::default() };
        for (index, config) in set.configs.iter().enumerate() {
            let model = SensorModel::new(config, |field| format!("sensors[{index}].{field}"))?;
            set.infos.push(model.info(config));
            set.models.push(model);
        }
        Ok(set)
    }
}

/// Reading as sent over the network.
#[derive(Clone, Debug)]
pub struct MadeReading {
    /// Sensor, time and pose of the reading.
    pub header: ReadingHeader,
    /// Header and records as in the protocol.
    pub bytes: Bytes,
}

impl MadeReading {
    pub fn records(&self) -> &[u8] {
        &self.bytes[ReadingHeader::SIZE..]
    }
}

/// Counters of a sensor's readings.
#[derive(Debug, Default)]
pub struct SensorCounters {
    /// Readings made.
    pub made: AtomicU64,
    /// Readings that the runtime acknowledged.
    pub sent: AtomicU64,
    /// Readings dropped on their way to the runtime.
    pub late: AtomicU64,
}

/// Sensors of a vehicle with their newest readings, shared by all threads.
#[derive(Debug)]
pub struct Sensors {
    set: watch::Sender<Arc<SensorSet>>,
    newest: [watch::Sender<Option<Arc<MadeReading>>>; MAX_SENSORS],
    /// Counters by sensor.
    pub counters: [SensorCounters; MAX_SENSORS],
}

impl Default for Sensors {
    fn default() -> Self {
        Self::new(SensorSet::default())
    }
}

impl Sensors {
    /// Creates the sensors of an arena.
    pub fn new(set: SensorSet) -> Self {
        Self {
            set: watch::Sender::new(Arc::new(set)),
            newest: Default::default(),
            counters: Default::default(),
        }
    }

    /// Returns the current sensors.
    pub fn newest(&self) -> Arc<SensorSet> {
        self.set.borrow().clone()
    }

    /// Returns a receiver of every later change.
    pub fn subscribe(&self) -> watch::Receiver<Arc<SensorSet>> {
        self.set.subscribe()
    }

    /// Returns a receiver of the newest reading of a sensor; `None` if the sensor does not exist.
    pub fn readings(&self, index: usize) -> Option<watch::Receiver<Option<Arc<MadeReading>>>> {
        self.newest.get(index).map(watch::Sender::subscribe)
    }

    /// Publishes a reading in place of the last one.
    pub fn publish(&self, reading: MadeReading) {
        let index = usize::from(reading.header.sensor);
        if let Some(newest) = self.newest.get(index) {
            self.counters[index].made.fetch_add(1, Ordering::Relaxed);
            newest.send_replace(Some(Arc::new(reading)));
        }
    }

    /// Changes the keys in `json` of the sensor `name`; null removes a key (RFC 7396, JSON merge patch). Its
    /// name and the kind of its model cannot change.
    ///
    /// # Errors
    /// [`ChangeError`]; the sensors stay unchanged.
    pub fn patch(&self, name: &str, json: &[u8]) -> Result<SensorConfig, ChangeError> {
        let patch: Map<String, Value> = serde_json::from_slice(json)?;
        let mut result = None;
        // Under the lock, so that two concurrent changes do not overwrite each other.
        self.set.send_if_modified(|set| {
            let changed = changed(set, name, patch);
            let modified =
                changed.as_ref().is_ok_and(|(index, new, _)| set.configs[*index] != *new);
            if let (true, Ok((index, new, model))) = (modified, &changed) {
                let mut next = SensorSet::clone(set);
                next.infos[*index] = model.info(new);
                next.configs[*index] = new.clone();
                next.models[*index] = model.clone();
                *set = Arc::new(next);
            }
            result = Some(changed.map(|(_, new, _)| new));
            modified
        });
        result.expect("the closure ran")
    }
}

fn changed(
    set: &SensorSet,
    name: &str,
    patch: Map<String, Value>,
) -> Result<(usize, SensorConfig, SensorModel), ChangeError> {
    let index = set.configs.iter().position(|sensor| sensor.name == name);
    let Some(index) = index else {
        let known = set.configs.iter().map(|sensor| sensor.name.clone()).collect();
        return Err(ChangeError::UnknownSensor { name: name.to_owned(), known });
    };
    let old = &set.configs[index];
    let mut keys: Map<String, Value> = serde_json::from_value(serde_json::to_value(old)?)?;
    for (key, value) in patch {
        if value.is_null() {
            keys.remove(&key);
        } else {
            keys.insert(key, value);
        }
    }
    let new: SensorConfig = serde_json::from_value(Value::Object(keys))?;
    if new.name != old.name {
        return Err(ChangeError::Renamed(new.name));
    }
    new.validate()?;
    let model = SensorModel::new(&new, str::to_owned)?;
    let (is, was) = (model.kind(), set.infos[index].kind);
    if is != was {
        return Err(ChangeError::Kind { model: new.model, is, was });
    }
    Ok((index, new, model))
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    fn sensors() -> Sensors {
        let sensor = |name, model| SensorConfig::ahead(name, model, DVec3::ZERO);
        Sensors::new(SensorSet::new(&[sensor("top", "os1-16"), sensor("down", "tfmini")]).unwrap())
    }

    #[test]
    fn patches_change_rate_range_and_enabled() {
        let sensors = sensors();
        let mut watcher = sensors.subscribe();
        let json = br#"{"rate_hz": 5, "max_range_m": 20, "enabled": false}"#;
        let new = sensors.patch("top", json).unwrap();
        assert_eq!((new.rate_hz, new.max_range_m, new.enabled), (Some(5.0), Some(20.0), false));
        let set = watcher.borrow_and_update().clone();
        let info = &set.infos[0];
        assert_eq!((info.rate_hz, info.max_range_m, info.enabled), (5.0, 20.0, false));
        assert_eq!(set.models[0].rate_hz(), 5.0);
        // An identical patch is not a change; null resets a key to the model's value.
        sensors.patch("top", json).unwrap();
        assert!(!watcher.has_changed().unwrap());
        sensors.patch("top", br#"{"rate_hz": null}"#).unwrap();
        assert_eq!(sensors.newest().infos[0].rate_hz, 10.0);
        // Another model of the same kind is valid.
        sensors.patch("down", br#"{"model": "lidar-lite-v3"}"#).unwrap();
        assert_eq!(sensors.newest().infos[1].max_range_m, 40.0);
    }

    #[test]
    fn reports_errors_and_changes_nothing() {
        let sensors = sensors();
        let before = sensors.newest();
        let refused = |name: &str, json: &str, expected: &str| {
            let error = sensors.patch(name, json.as_bytes()).unwrap_err().to_string();
            assert!(error.contains(expected), "'{error}' lacks '{expected}'");
        };
        refused("left", "{}", "there is no sensor 'left'; there are top, down");
        refused("top", "{", "EOF");
        refused("top", r#"{"rate": 5}"#, "unknown field `rate`");
        refused("top", r#"{"rate_hz": 0}"#, "rate_hz = 0");
        refused("top", r#"{"name": "roof"}"#, "keeps its name");
        refused("top", r#"{"model": "tfmini"}"#, "is a range_finder, and the sensor a lidar");
        refused("down", r#"{"settings": {"gamma": 1}}"#, "unknown field `gamma`");
        assert!(Arc::ptr_eq(&before, &sensors.newest()));
    }
}
