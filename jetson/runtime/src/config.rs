//! `jetson.toml`: settings of the vehicle's computer: server, vehicle, limits, plugin, log.
//!
//! ```toml
//! [server]                            # without this section `vizflyt fly` flies the simulated lab
//! address = "192.168.10.2:4433"
//!
//! [vehicle]
//! name = "vizflyt"
//! mavlink = "udpin:0.0.0.0:14550"     # or serial:/dev/ttyTHS1:921600
//!
//! [limits]                            # the stricter of these and the arena's limits applies
//! max_speed_mps = 2.0
//!
//! [plugin]
//! path = "/home/team/first"
//! memory_mb = 2000                    # resource limits: docs/guides/safety.md
//!
//! [log]
//! keep_gb = 20                        # older logs beyond it are deleted when a flight begins
//! ```
//! [`JetsonConfig::parse`] rejects unknown keys (the error suggests the nearest known key) and invalid values. The
//! command line has priority over the file. This module resolves and opens nothing: a host name in the file is resolved
//! when it is used.

#[cfg(test)]
mod tests;

use std::fmt::Display;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use vizflyt_protocol::messages::Limits;
use vizflyt_toml::TomlErrors;
use vizflyt_trust::Fingerprint;

use crate::link::VISION_HZ;
use crate::log::{LoggedImages, Retention};
use crate::supervisor::{PluginLimits, Restart};
use vizflyt_guardian::port::{self, Shape};

/// Contents of `jetson.toml`. Every section is optional.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JetsonConfig {
    /// Render server. If it is set, `vizflyt fly` flies the real lab.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub server: Option<ServerConfig>,
    /// Vehicle of this computer.
    pub vehicle: VehicleConfig,
    /// Limits of this vehicle; the stricter of these and the arena's limits applies.
    pub limits: LimitsConfig,
    /// Plugin and its resource limits.
    pub plugin: PluginConfig,
    /// Flight logs.
    pub log: LogConfig,
}

/// `[server]`: render server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServerConfig {
    /// `HOST:PORT`.
    pub address: String,
    /// SHA-256 of the server's certificate. Default: the certificate from pairing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fingerprint: Option<Fingerprint>,
    /// Folder of this computer's key and of `servers.toml`. Default: the user's folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub keys: Option<PathBuf>,
}

/// `[vehicle]`: vehicle of this computer.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VehicleConfig {
    /// Name of the vehicle in the localization system.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Connection to the autopilot: `udpin:ADDR:PORT`, `udpout:HOST:PORT`, `tcpin:`, `tcpout:` or `serial:PATH:BAUD`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mavlink: Option<String>,
    /// MAVLink system id of the autopilot, if several share a link. Default: the only one on the link.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub system: Option<u8>,
    /// Rate of poses sent to the autopilot, 30 to 50. Default: 50. [Hz]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vision_hz: Option<f64>,
    /// Key file for MAVLink 2 signing, created by `vizflyt vehicle sign`. If it is set, unsigned packets are rejected.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub signing_key: Option<PathBuf>,
}

/// `[limits]`: limits of the guard in addition to those of the arena.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LimitsConfig {
    /// Maximum speed. [m/s]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_speed_mps: Option<f64>,
    /// Maximum acceleration. [m/s^2]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_acceleration_mps2: Option<f64>,
    /// Maximum tilt. [deg]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_tilt_deg: Option<f64>,
    /// Maximum height of the body's centre. [m, world]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_altitude_m: Option<f64>,
}

impl From<LimitsConfig> for Limits {
    /// Missing values become infinite or `None`: no limit.
    fn from(config: LimitsConfig) -> Self {
        Self {
            max_speed_mps: config.max_speed_mps.unwrap_or(f64::INFINITY),
            max_acceleration_mps2: config.max_acceleration_mps2.unwrap_or(f64::INFINITY),
            max_tilt_deg: config.max_tilt_deg,
            max_altitude_m: config.max_altitude_m,
        }
    }
}

/// `[plugin]`: plugin and its resource limits.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PluginConfig {
    /// Default plugin of `vizflyt fly`: a folder, a `.py` file, a program, or the name of a built-in plugin.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub path: Option<PathBuf>,
    /// Maximum memory. Default: half of this computer's memory. [MB]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_mb: Option<u64>,
    /// Maximum processor use; 1.5 is one and a half processors. Default: all but one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpus: Option<f64>,
    /// Maximum number of processes and threads. Default: 128.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub processes: Option<u32>,
    /// Maximum duration of `on_image`; longer calls are reported. Default: 100. [ms]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline_ms: Option<f64>,
    /// When the plugin is restarted: `never`, `on_ground` (default) or `in_flight`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub restart: Option<Restart>,
    /// Maximum number of restarts in one flight. Default: 3.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub restarts: Option<u32>,
    /// Whether the plugin may use the network.
    pub network: bool,
    /// User of the plugin's process if the runtime is root. Default: the account `vizflyt`, or `nobody` if it
    /// does not exist.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// Folders that the plugin may write to, in addition to its own folder, the working folder and `/tmp`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub write: Vec<PathBuf>,
    /// Files and folders that the plugin may read, in addition to its own folder, the working folder, its interpreter
    /// and the system.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub read: Vec<PathBuf>,
    /// Cameras that the plugin needs: each must deliver fresh images. Default: one fresh camera is enough.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<String>,
}

impl PluginConfig {
    /// Returns the resource limits of the plugin.
    pub fn limits(&self) -> PluginLimits {
        let fair = PluginLimits::default();
        PluginLimits {
            memory_mb: self.memory_mb.unwrap_or(fair.memory_mb),
            cpus: self.cpus.unwrap_or(fair.cpus),
            processes: self.processes.unwrap_or(fair.processes),
            deadline_ms: self.deadline_ms.unwrap_or(fair.deadline_ms),
            restart: self.restart.unwrap_or(fair.restart),
            restarts: self.restarts.unwrap_or(fair.restarts),
            network: self.network,
            user: self.user.clone(),
            write: self.write.clone(),
            read: self.read.clone(),
            ..fair
        }
    }
}

/// `[log]`: images in flight logs, and retention of the logs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LogConfig {
    /// `reduced` (default) or `full`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub images: Option<LoggedImages>,
    /// Maximum size of all logs in a folder. When a flight begins, the oldest logs beyond it are deleted; `inf` keeps
    /// all. Default: 20. [GB]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_gb: Option<f64>,
    /// Maximum age of a log. When a flight begins, older logs are deleted. Default: no limit. [days]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_days: Option<f64>,
}

impl LogConfig {
    /// Returns the retention of logs.
    pub fn retention(&self) -> Retention {
        // 20 GB are five and a half hours of reduced logs.
        let max_bytes = (self.keep_gb.unwrap_or(20.0) * 1e9) as u64;
        let max_age = self.keep_days.map(|days| Duration::from_secs_f64(days * 86_400.0));
        Retention { max_bytes, max_age }
    }
}

/// Error in a `jetson.toml`.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{path}: {why}", path = .path.display())]
    Unreadable {
        path: PathBuf,
        /// Error of the operating system.
        why: std::io::Error,
    },
    /// All errors of syntax, types, missing and unknown keys.
    #[error(transparent)]
    Toml(#[from] TomlErrors),
    /// Invalid value.
    #[error("{key} = {value}: {advice}")]
    Invalid {
        /// Key in the file, such as `limits.max_speed_mps`.
        key: &'static str,
        /// Value in the file.
        value: String,
        /// Problem and solution.
        advice: String,
    },
    /// Two or more errors.
    #[error("{}", lines(.0))]
    Several(Vec<Self>),
    /// Invalid resource limit of the plugin.
    #[error("{0}")]
    Plugin(String),
    /// Error in the file `path`.
    #[error("{path}: {error}", path = .path.display())]
    In { path: PathBuf, error: Box<Self> },
}

impl JetsonConfig {
    /// Parses and checks the settings in `text`.
    ///
    /// # Errors
    /// [`ConfigError::Toml`] with line and column, [`ConfigError::Invalid`] with the key.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let config: Self = vizflyt_toml::parse(text)?;
        config.validate()?;
        Ok(config)
    }

    /// Reads the settings from a file. Relative paths in it start at its folder.
    ///
    /// # Errors
    /// As [`JetsonConfig::parse`], with the path; [`ConfigError::Unreadable`].
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|why| ConfigError::Unreadable { path: path.to_owned(), why })?;
        let mut config = Self::parse(&text)
            .map_err(|error| ConfigError::In { path: path.to_owned(), error: Box::new(error) })?;
        let folder = path.parent().unwrap_or(Path::new(""));
        if let Some(keys) = config.server.as_mut().and_then(|server| server.keys.as_mut()) {
            *keys = folder.join(&*keys);
        }
        if let Some(key) = &mut config.vehicle.signing_key {
            *key = folder.join(&*key);
        }
        for path_of_plugin in config.plugin.write.iter_mut().chain(&mut config.plugin.read) {
            *path_of_plugin = folder.join(&*path_of_plugin);
        }
        // A bare name may be a built-in plugin: keep it.
        if let Some(plugin) = &mut config.plugin.path
            && plugin.components().count() > 1
        {
            *plugin = folder.join(&*plugin);
        }
        Ok(config)
    }

    /// Returns TOML text that parses to the same value.
    ///
    /// # Errors
    /// Fails if a path is not UTF-8.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        toml::to_string(self)
    }

    fn validate(&self) -> Result<(), ConfigError> {
        let Self { server, vehicle, limits, plugin, log } = self;
        let address = server.as_ref().map(|server| &server.address);
        let checks = [
            address.map_or(Ok(()), |at| check_host_port("server.address", at, at)),
            vehicle.name.as_deref().map_or(Ok(()), check_name),
            vehicle.mavlink.as_deref().map_or(Ok(()), check_mavlink),
            check("vehicle.vision_hz", vehicle.vision_hz, "Hz", VISION_HZ),
            check("limits.max_speed_mps", limits.max_speed_mps, "m/s", 0.1..=30.0),
            check(
                "limits.max_acceleration_mps2",
                limits.max_acceleration_mps2,
                "m/s^2",
                0.1..=50.0,
            ),
            check("limits.max_tilt_deg", limits.max_tilt_deg, "deg", 5.0..=80.0),
            check("limits.max_altitude_m", limits.max_altitude_m, "m", 0.2..=1000.0),
            check("log.keep_gb", log.keep_gb, "GB", 0.1..=f64::INFINITY),
            check("log.keep_days", log.keep_days, "days", 0.01..=36_500.0),
            plugin.limits().check().map_err(ConfigError::Plugin),
        ];
        vizflyt_toml::join_errors(checks, ConfigError::Several)
    }
}

fn lines(errors: &[ConfigError]) -> String {
    errors.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
}

fn check_name(name: &str) -> Result<(), ConfigError> {
    if (1..=MAX_NAME_BYTES).contains(&name.len()) {
        return Ok(());
    }
    Err(invalid("vehicle.name", quoted(name), "give 1 to 32 bytes"))
}

fn check_mavlink(address: &str) -> Result<(), ConfigError> {
    match port::shape(address) {
        None => Err(invalid("vehicle.mavlink", quoted(address), port::SHAPES)),
        Some(Shape::Net(_, at)) => check_host_port("vehicle.mavlink", address, at),
        Some(Shape::Serial(..)) => Ok(()),
    }
}

/// Returns the default settings file: `./jetson.toml`, the user's, or the computer's.
pub fn find() -> Option<PathBuf> {
    let home = std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".config"));
    // The XDG Base Directory Specification says to ignore a relative XDG_CONFIG_HOME.
    let user = std::env::var_os("XDG_CONFIG_HOME").map(PathBuf::from).filter(|p| p.is_absolute());
    let folders = [Some(PathBuf::from(".")), user.or(home).map(|c| c.join("vizflyt"))];
    folders
        .into_iter()
        .flatten()
        .chain([PathBuf::from("/etc/vizflyt")])
        .map(|folder| folder.join("jetson.toml"))
        .find(|path| path.is_file())
}

/// Size of [`vizflyt_protocol::messages::Name`] in bytes.
const MAX_NAME_BYTES: usize = 32;

fn invalid(key: &'static str, value: impl Display, advice: impl Into<String>) -> ConfigError {
    ConfigError::Invalid { key, value: value.to_string(), advice: advice.into() }
}

fn quoted(text: &str) -> String {
    format!("{text:?}")
}

fn check(
    key: &'static str,
    value: Option<f64>,
    unit: &str,
    range: RangeInclusive<f64>,
) -> Result<(), ConfigError> {
    match value {
        Some(value) if !range.contains(&value) => {
            let (low, high) = range.into_inner();
            Err(invalid(key, value, format!("give a number from {low} to {high} {unit}")))
        }
        _ => Ok(()),
    }
}

fn check_host_port(key: &'static str, value: &str, host_port: &str) -> Result<(), ConfigError> {
    let is_good = host_port.rsplit_once(':').is_some_and(|(host, port)| {
        !host.is_empty() && !host.contains(char::is_whitespace) && port.parse::<u16>().is_ok()
    });
    if is_good {
        return Ok(());
    }
    Err(invalid(key, quoted(value), "it needs a host and a port, as in 192.168.10.2:4433"))
}
