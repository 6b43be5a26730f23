//! `[[localization]]`: pose sources, and conversion of their numbers to poses of the vehicle in the `world`
//! frame.
//!
//! ```text
//! stream's position * units -> axes -> offset ----------------> position  [m, world]
//! stream's rotation (euler, quaternion) -> axes, body -> nose --> attitude  (body to world)
//! ```
//! Each setting corresponds to a visible property of the room, so that `vizflyt doctor localization` can name
//! the one to change. `conventions` contains the values, `alignment` the conversion.

mod alignment;
mod conventions;
mod driver;

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::path::Path;
use std::str::FromStr;

use anyhow::{Context, Result};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use vizflyt_arena::config::{ConfigError, check_number, check_position, invalid};

pub use self::alignment::{Alignment, Offset};
pub use self::conventions::{Axes, BodyAxes, Euler, Nose, Quaternion, Units, UpAxis};
pub use self::driver::Driver;
use crate::scene;

/// `[[localization]]`: one pose source.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocalizationConfig {
    pub driver: Driver,
    /// Address and port where poses arrive, or are requested; default: depends on the driver.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
    /// Length unit of the stream; default: depends on the driver.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub units: Option<Units>,
    /// Axis of the stream that points up; a short form of `axes`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub up: Option<UpAxis>,
    /// Orientation of the stream's axes in the world; `xyz` by default, `x-zy` for y up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub axes: Option<Axes>,
    /// Vicon: order of the rotations about the fixed axes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub euler: Option<Euler>,
    /// NatNet, JSON, VRPN: order and direction of a quaternion's four numbers.
    #[serde(default, skip_serializing_if = "is_default")]
    pub quaternion: Quaternion,
    /// Orientation of the object's own axes; as the stream's by default.
    #[serde(default, skip_serializing_if = "is_default")]
    pub body: BodyAxes,
    /// Nose of the vehicle; x by default.
    #[serde(default, skip_serializing_if = "is_default")]
    pub nose: Nose,
    /// Position and heading of the stream's origin in the world.
    #[serde(default, skip_serializing_if = "is_default")]
    pub offset: Offset,
    /// Position of the tracked point on the vehicle. [m, body]
    #[serde(default, skip_serializing_if = "is_default")]
    pub pivot_m: DVec3,
    /// Constant delay of the source, 0 to 500. It is subtracted from the stamp, or from the arrival if there is
    /// no stamp. [ms]
    #[serde(default, skip_serializing_if = "is_default")]
    pub latency_ms: f64,
    /// Names of the vehicles' objects in the stream, if they differ from the vehicles' names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub objects: BTreeMap<String, String>,
    /// NatNet by multicast: address of this computer in Motive's network, if there are several networks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interface: Option<Ipv4Addr>,
    /// VRPN: sensor number of the tracker that is the vehicle; default: 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<u16>,
}

impl LocalizationConfig {
    /// Creates a source with all defaults.
    pub fn new(driver: Driver) -> Self {
        Self {
            driver,
            address: None,
            units: None,
            up: None,
            axes: None,
            euler: None,
            quaternion: Quaternion::default(),
            body: BodyAxes::default(),
            nose: Nose::default(),
            offset: Offset::default(),
            pivot_m: DVec3::ZERO,
            latency_ms: 0.0,
            objects: BTreeMap::new(),
            interface: None,
            sensor: None,
        }
    }

    /// Parses `DRIVER[:ADDRESS][,KEY=VALUE...]` of the command line. Keys and values are those of
    /// `[[localization]]`, lists in brackets: `pivot_m=[0.02,0,0.05]`.
    ///
    /// # Errors
    /// What is wrong, and the valid values.
    pub fn parse(text: &str) -> Result<Self, String> {
        let (head, settings) = text.split_once(',').unwrap_or((text, ""));
        let (driver, address) = head.split_once(':').map_or((head, None), |(d, a)| (d, Some(a)));
        let mut table = toml::Table::new();
        table.insert("driver".to_owned(), driver.into());
        if let Some(address) = address {
            table.insert("address".to_owned(), address.into());
        }
        let mut settings = settings;
        while !settings.is_empty() {
            let (setting, rest) = first_setting(settings);
            settings = rest;
            if setting.is_empty() {
                continue;
            }
            let (key, value) = setting
                .split_once('=')
                .ok_or_else(|| format!("'{setting}': write KEY=VALUE, as units=mm"))?;
            let read = toml::Value::from_str(value).ok();
            if value.starts_with('[') && read.is_none() {
                return Err(format!("'{setting}': write a position as [x,y,z]"));
            }
            // Names are text even if they look like numbers.
            let value = read
                .filter(|value| value.is_str() || !key.starts_with("objects."))
                .unwrap_or_else(|| value.into());
            insert(&mut table, key, value)?;
        }
        let config: Self = table.try_into().map_err(|error: toml::de::Error| {
            format!(
                "{}; write DRIVER:ADDRESS,KEY=VALUE; drivers are {}",
                error.message(),
                Driver::names()
            )
        })?;
        config.check("--pose").map_err(|error| error.to_string())?;
        Ok(config)
    }

    /// Returns the address where its stream arrives.
    pub fn address(&self) -> &str {
        self.address.as_deref().unwrap_or(self.driver.usual_address())
    }

    /// Returns the axes, from either form.
    pub fn stream_axes(&self) -> Axes {
        self.axes.unwrap_or_else(|| self.up.map_or(Axes::IDENTITY, UpAxis::axes))
    }

    /// Returns the conversion from the stream's numbers to poses.
    pub fn alignment(&self) -> Alignment {
        Alignment {
            unit_m: self.units.unwrap_or(self.driver.usual_units()).metres(),
            axes: self.stream_axes(),
            quaternion: self.quaternion,
            body: self.body,
            nose: self.nose,
            offset: self.offset,
            pivot_m: self.pivot_m,
        }
    }

    /// Returns the name of a vehicle's object in the stream.
    pub fn object_of<'a>(&'a self, vehicle: &'a str) -> &'a str {
        self.objects.get(vehicle).map_or(vehicle, String::as_str)
    }

    fn check(&self, key: &str) -> Result<(), ConfigError> {
        if let (Some(_), Some(axes)) = (self.up, self.axes) {
            let advice = "`up` is a short form of `axes`: leave one of them out";
            return Err(invalid(format!("{key}.axes"), axes, advice));
        }
        let own = [
            ("euler", self.euler.map(|euler| euler.to_string())),
            ("interface", self.interface.map(|address| address.to_string())),
            ("sensor", self.sensor.map(|sensor| sensor.to_string())),
        ];
        for (name, value) in own {
            if let (Some(value), Some(advice)) = (value, self.driver.refuses(name)) {
                return Err(invalid(format!("{key}.{name}"), value, advice));
            }
        }
        if !self.driver.has_quaternions() && !is_default(&self.quaternion) {
            let advice = format!("{} has no quaternions whose order could differ", self.driver);
            return Err(invalid(format!("{key}.quaternion"), self.quaternion, advice));
        }
        if self.body != BodyAxes::Stream && self.stream_axes().is_mirror() {
            let advice = "a mirrored stream has no such axes: leave `body` out, or correct `axes`";
            return Err(invalid(format!("{key}.body"), self.body, advice));
        }
        check_number(&format!("{key}.nose"), self.nose.deg(), "degrees", -360.0..=360.0)?;
        check_position(&format!("{key}.offset.position_m"), self.offset.position_m)?;
        check_position(&format!("{key}.pivot_m"), self.pivot_m)?;
        check_number(&format!("{key}.latency_ms"), self.latency_ms, "ms", 0.0..=500.0)?;
        check_number(
            &format!("{key}.offset.yaw_deg"),
            self.offset.yaw_deg,
            "degrees",
            -360.0..=360.0,
        )
    }
}

/// Splits the first setting KEY=VALUE off several, at a comma that is not in a list's brackets or in quotes.
fn first_setting(settings: &str) -> (&str, &str) {
    let value = settings.find('=').map_or(settings.len(), |equals| equals + 1);
    let within = match settings[value..].chars().next() {
        // Nested lists are not supported: no setting is one.
        Some('[') => Some(settings[value..].find(']').unwrap_or(settings.len() - value)),
        Some(quote @ ('"' | '\'')) => settings[value + 1..].find(quote).map(|end| end + 1),
        _ => None,
    };
    // A comma may come before the equals sign: after a setting without a value.
    let comma = settings[..value].find(',');
    let comma = comma.or_else(|| {
        let from = value + within.unwrap_or(0);
        settings[from..].find(',').map(|place| from + place)
    });
    comma.map_or((settings, ""), |comma| (&settings[..comma], &settings[comma + 1..]))
}

/// Inserts a value under a key of one or several parts: `offset.yaw_deg`.
fn insert(table: &mut toml::Table, key: &str, value: toml::Value) -> Result<(), String> {
    let Some((outer, inner)) = key.split_once('.') else {
        table.insert(key.to_owned(), value);
        return Ok(());
    };
    let inside = table.entry(outer).or_insert_with(|| toml::Table::new().into());
    let inside = inside.as_table_mut().ok_or_else(|| format!("'{outer}' is not a table"))?;
    insert(inside, inner, value)
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// Part of `arena.toml` that this module reads; other modules read the rest.
#[derive(Deserialize)]
struct ArenaToml {
    #[serde(default)]
    localization: Vec<LocalizationConfig>,
}

/// Parses every `[[localization]]` of the text of an `arena.toml`.
///
/// # Errors
/// Names the line: unknown keys, invalid values, more than [`MAX_SOURCES`].
pub fn read_all(arena_toml: &str) -> Result<Vec<LocalizationConfig>, ConfigError> {
    let ArenaToml { localization } = vizflyt_toml::parse(arena_toml)?;
    check_all(&localization).map_err(|error| error.in_text(arena_toml))?;
    Ok(localization)
}

fn check_all(sources: &[LocalizationConfig]) -> Result<(), ConfigError> {
    if sources.len() > MAX_SOURCES {
        let advice = format!("give at most {MAX_SOURCES} [[localization]]");
        return Err(invalid("localization", format!("{} of them", sources.len()), advice));
    }
    let mut sources = sources.iter().enumerate();
    sources.try_for_each(|(index, source)| source.check(&format!("localization[{index}]")))
}

/// Returns the pose sources of an arena, given its file or folder; a bare scene has none.
///
/// # Errors
/// A file that cannot be read, or an error of [`read_all`].
pub fn of_arena(path: &Path) -> Result<Vec<LocalizationConfig>> {
    let Some((path, text)) = scene::arena_text(path)? else { return Ok(Vec::new()) };
    read_all(&text).with_context(|| format!("{} is wrong", path.display()))
}

/// Maximum number of sources of one server.
pub const MAX_SOURCES: usize = 8;

#[cfg(test)]
mod tests;
