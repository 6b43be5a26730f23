//! `[[localization]]`: where poses come from, and how the stream's numbers become poses of the
//! vehicle in the `world` frame.
//!
//! ```text
//! stream's position * units -> axes -> offset ----------------> position  [m, world]
//! stream's rotation (euler, quaternion) -> axes, body -> nose --> attitude  (body to world)
//! ```
//! Each setting is something a person can see in the room, so that `vizflyt doctor localization`
//! can name the one to change. `conventions` has the words, `alignment` what they do together.

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

/// `[[localization]]`: one source of poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocalizationConfig {
    /// What sends poses.
    pub driver: Driver,
    /// Address and port where they arrive, or are asked for; the driver's usual one by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
    /// Length unit of the stream; the driver's own by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub units: Option<Units>,
    /// The stream's axis that points up; a short form of `axes`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub up: Option<UpAxis>,
    /// How the stream's axes lie in the world; `xyz` by default, `x-zy` for y up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub axes: Option<Axes>,
    /// Vicon: the order in which its three angles turn about the fixed axes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub euler: Option<Euler>,
    /// NatNet, JSON: how the four numbers of a quaternion are meant.
    #[serde(default, skip_serializing_if = "is_default")]
    pub quaternion: Quaternion,
    /// How the object's own axes are laid; as the stream's by default.
    #[serde(default, skip_serializing_if = "is_default")]
    pub body: BodyAxes,
    /// How the object's axes lie to the vehicle's nose; it points along x by default.
    #[serde(default, skip_serializing_if = "is_default")]
    pub nose: Nose,
    /// Where the stream's origin is in the world, and how it is turned there.
    #[serde(default, skip_serializing_if = "is_default")]
    pub offset: Offset,
    /// Where the tracked point is on the vehicle. [m, body]
    #[serde(default, skip_serializing_if = "is_default")]
    pub pivot_m: DVec3,
    /// The source's own constant delay, 0 to 500: so much earlier than stamped, or than it arrived where it has no
    /// stamp, a pose was true. [ms]
    #[serde(default, skip_serializing_if = "is_default")]
    pub latency_ms: f64,
    /// Names of the vehicles' objects in the stream, where they differ from the vehicles' names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub objects: BTreeMap<String, String>,
    /// NatNet by multicast: our address in the network that it comes from, where there are several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interface: Option<Ipv4Addr>,
    /// VRPN: which sensor of a tracker the vehicle is; 0 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<u16>,
}

impl LocalizationConfig {
    /// Makes a source with everything as usual.
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

    /// Reads `DRIVER[:ADDRESS][,KEY=VALUE...]`, as the command line has it; keys and values are those
    /// of `[[localization]]`, lists in brackets: `pivot_m=[0.02,0,0.05]`.
    ///
    /// # Errors
    /// Says what is wrong, and what could stand there.
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
                return Err(format!("'{setting}': write a place as [x,y,z]"));
            }
            // Names are text even if they are numbers.
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

    /// Returns where its stream arrives.
    pub fn address(&self) -> &str {
        self.address.as_deref().unwrap_or(self.driver.usual_address())
    }

    /// Returns the axes, given in either form.
    pub fn stream_axes(&self) -> Axes {
        self.axes.unwrap_or_else(|| self.up.map_or(Axes::IDENTITY, UpAxis::axes))
    }

    /// Returns what takes the stream's numbers to poses.
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
            let advice = "a mirrored stream has no such axes: leave `body` out, or mend `axes`";
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

/// Cuts the first setting off several, KEY=VALUE and commas: those within a list's brackets, or quotes, part nothing.
fn first_setting(settings: &str) -> (&str, &str) {
    let value = settings.find('=').map_or(settings.len(), |equals| equals + 1);
    let within = match settings[value..].chars().next() {
        // Of nested lists nothing is made: no setting is one.
        Some('[') => Some(settings[value..].find(']').unwrap_or(settings.len() - value)),
        Some(quote @ ('"' | '\'')) => settings[value + 1..].find(quote).map(|end| end + 1),
        _ => None,
    };
    // Before the sign there may be a comma still: of a setting without a value.
    let comma = settings[..value].find(',');
    let comma = comma.or_else(|| {
        let from = value + within.unwrap_or(0);
        settings[from..].find(',').map(|place| from + place)
    });
    comma.map_or((settings, ""), |comma| (&settings[..comma], &settings[comma + 1..]))
}

/// Puts a value under a key of one or several parts: `offset.yaw_deg`.
fn insert(table: &mut toml::Table, key: &str, value: toml::Value) -> Result<(), String> {
    let Some((outer, inner)) = key.split_once('.') else {
        table.insert(key.to_owned(), value);
        return Ok(());
    };
    let inside = table.entry(outer).or_insert_with(|| toml::Table::new().into());
    let inside = inside.as_table_mut().ok_or_else(|| format!("'{outer}' is no table"))?;
    insert(inside, inner, value)
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// The part of `arena.toml` that is read here; the rest is the arena's.
#[derive(Deserialize)]
struct ArenaToml {
    #[serde(default)]
    localization: Vec<LocalizationConfig>,
}

/// Reads every `[[localization]]` of the text of an `arena.toml`.
///
/// # Errors
/// Points at the line: unknown keys, values that cannot work, more than [`MAX_SOURCES`].
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

/// Returns the sources of poses of an arena, by its file or folder; a bare scene names none.
///
/// # Errors
/// A file that cannot be read, or as [`read_all`].
pub fn of_arena(path: &Path) -> Result<Vec<LocalizationConfig>> {
    let Some((path, text)) = scene::arena_text(path)? else { return Ok(Vec::new()) };
    read_all(&text).with_context(|| format!("{} is wrong", path.display()))
}

/// Sources of one server at most.
pub const MAX_SOURCES: usize = 8;

#[cfg(test)]
mod tests;
