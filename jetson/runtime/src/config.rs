//! `jetson.toml`: which lab this computer belongs to, and how far a flight may go here.
//!
//! ```toml
//! [server]                            # without this section `vizflyt fly` flies the simulated lab
//! address = "192.168.10.2:4433"
//!
//! [vehicle]
//! name = "vizflyt"
//! mavlink = "udpin:0.0.0.0:14550"     # or serial:/dev/ttyTHS1:921600
//!
//! [limits]                            # of these and the arena's, the stricter wins
//! max_speed_mps = 2.0
//!
//! [plugin]
//! path = "/home/team/first"
//! memory_mb = 2000                    # what it may use: docs/guides/safety.md
//!
//! [log]
//! keep_gb = 20                        # when a flight begins, the oldest logs beyond it are deleted
//! ```
//! Text comes in through [`JetsonConfig::parse`], which refuses unknown keys (it names the nearest
//! known one) and values that cannot work. The command line goes before the file. Nothing is
//! resolved or opened here: a host name in the file is looked up when it is used.

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

/// The whole of `jetson.toml`. Every section may be absent.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JetsonConfig {
    /// The render server; with it, `vizflyt fly` flies the real lab.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub server: Option<ServerConfig>,
    /// The vehicle this computer sits on.
    pub vehicle: VehicleConfig,
    /// Limits of this vehicle; the arena has its own, and the stricter wins.
    pub limits: LimitsConfig,
    /// The plugin and what it may use.
    pub plugin: PluginConfig,
    /// Flight logs.
    pub log: LogConfig,
}

/// `[server]`: the render server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServerConfig {
    /// `HOST:PORT`.
    pub address: String,
    /// SHA-256 of its certificate; without it, the one this computer is paired with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fingerprint: Option<Fingerprint>,
    /// Folder of this computer's key and of `servers.toml`; without it the user's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub keys: Option<PathBuf>,
}

/// `[vehicle]`: the vehicle this computer sits on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VehicleConfig {
    /// Its name in the localization system.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Its autopilot: `udpin:ADDR:PORT`, `udpout:HOST:PORT`, `tcpin:`, `tcpout:` or
    /// `serial:PATH:BAUD`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mavlink: Option<String>,
    /// Its autopilot's MAVLink system id, where several share a link; without it the only one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub system: Option<u8>,
    /// Poses sent to the autopilot, 30 to 50; without it 50. [Hz]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vision_hz: Option<f64>,
    /// File with the key for MAVLink 2 signing, made by `vizflyt vehicle sign`; with it, packets
    /// that are not signed are refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub signing_key: Option<PathBuf>,
}

/// `[limits]`: what the guard keeps to beyond the arena's own limits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LimitsConfig {
    /// Greatest speed. [m/s]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_speed_mps: Option<f64>,
    /// Greatest acceleration. [m/s^2]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_acceleration_mps2: Option<f64>,
    /// Greatest lean. [deg]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_tilt_deg: Option<f64>,
    /// Greatest height of the body's centre. [m, world]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_altitude_m: Option<f64>,
}

impl From<LimitsConfig> for Limits {
    /// What is not set does not limit.
    fn from(config: LimitsConfig) -> Self {
        Self {
            max_speed_mps: config.max_speed_mps.unwrap_or(f64::INFINITY),
            max_acceleration_mps2: config.max_acceleration_mps2.unwrap_or(f64::INFINITY),
            max_tilt_deg: config.max_tilt_deg,
            max_altitude_m: config.max_altitude_m,
        }
    }
}

/// `[plugin]`: the plugin and what it may use.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PluginConfig {
    /// The default plugin of `vizflyt fly`: a folder, a `.py`, a program, a built-in's name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub path: Option<PathBuf>,
    /// Memory; without it half of this computer's. [MB]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_mb: Option<u64>,
    /// Processors it may keep busy, 1.5 is one and a half; without it all but one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpus: Option<f64>,
    /// Processes and threads; without it 128.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub processes: Option<u32>,
    /// Maximum time of `on_image`, without it 100; what is beyond is shown. [ms]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline_ms: Option<f64>,
    /// When it is started again: `never`, `on_ground` (without it), `in_flight`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub restart: Option<Restart>,
    /// How often, in one flight; without it 3.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub restarts: Option<u32>,
    /// Whether it may use the network.
    pub network: bool,
    /// The user it runs as if the runtime is root; without it `vizflyt`, or else `nobody`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// Folders it may write in, beside its own, the working folder and `/tmp`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub write: Vec<PathBuf>,
    /// Files and folders of yours that it reads, beside its own folder, the working folder, its interpreter and the
    /// system.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub read: Vec<PathBuf>,
    /// The cameras that it flies by: each must be fresh. Without it one fresh camera is enough.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<String>,
}

impl PluginConfig {
    /// Returns what the plugin may use.
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

/// `[log]`: which images flight logs hold, and how long they are kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LogConfig {
    /// `reduced` (without it) or `full`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub images: Option<LoggedImages>,
    /// Size of all logs of a folder together, without it 20. Beyond it the oldest are deleted when a
    /// flight begins; `inf` keeps all. [GB]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_gb: Option<f64>,
    /// Age at which a log is deleted when a flight begins; without it none. [days]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_days: Option<f64>,
}

impl LogConfig {
    /// Returns how long logs are kept.
    pub fn retention(&self) -> Retention {
        // 20 GB are five and a half hours of reduced logs.
        let max_bytes = (self.keep_gb.unwrap_or(20.0) * 1e9) as u64;
        let max_age = self.keep_days.map(|days| Duration::from_secs_f64(days * 86_400.0));
        Retention { max_bytes, max_age }
    }
}

/// Why a `jetson.toml` is refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{path}: {why}", path = .path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        why: std::io::Error,
    },
    /// Syntax, types, absent or unknown keys: all of them.
    #[error(transparent)]
    Toml(#[from] TomlErrors),
    /// A value that cannot work.
    #[error("{key} = {value}: {advice}")]
    Invalid {
        /// Where in the file: `limits.max_speed_mps`.
        key: &'static str,
        /// What it says.
        value: String,
        /// What is wrong and what to do.
        advice: String,
    },
    /// Several of these; two at least.
    #[error("{}", lines(.0))]
    Several(Vec<Self>),
    /// A limit of the plugin that leaves it no room to live.
    #[error("{0}")]
    Plugin(String),
    /// What is wrong in which file.
    #[error("{path}: {error}", path = .path.display())]
    In {
        /// The file.
        path: PathBuf,
        /// The error.
        error: Box<Self>,
    },
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

    /// Reads the settings of a file. Paths in it are relative to its folder.
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
        // A bare name may be a built-in: it stays as it is.
        for folder_of_plugin in &mut config.plugin.write {
            *folder_of_plugin = folder.join(&*folder_of_plugin);
        }
        if let Some(plugin) = &mut config.plugin.path
            && plugin.components().count() > 1
        {
            *plugin = folder.join(&*plugin);
        }
        Ok(config)
    }

    /// Returns the text of a `jetson.toml` that parses to the same value.
    ///
    /// # Errors
    /// If a path in it is not UTF-8.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        toml::to_string(self)
    }

    /// Looks at every value.
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

/// Returns the file that counts where none is named: `./jetson.toml`, the user's, the computer's.
pub fn find() -> Option<PathBuf> {
    let home = std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".config"));
    // A relative XDG_CONFIG_HOME is to be ignored (XDG Base Directory Specification).
    let user = std::env::var_os("XDG_CONFIG_HOME").map(PathBuf::from).filter(|p| p.is_absolute());
    let folders = [Some(PathBuf::from(".")), user.or(home).map(|c| c.join("vizflyt"))];
    folders
        .into_iter()
        .flatten()
        .chain([PathBuf::from("/etc/vizflyt")])
        .map(|folder| folder.join("jetson.toml"))
        .find(|path| path.is_file())
}

/// Bytes of [`vizflyt_protocol::messages::Name`].
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
