//! Settings of a plugin from `[plugin]` in `jetson.toml`: limits and restarts.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::available_parallelism;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};

/// Restart policy for a plugin that has ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Restart {
    /// Never: on the ground the flight ends, in the air the vehicle lands.
    Never,
    /// Only on the ground; in the air the vehicle lands.
    #[default]
    OnGround,
    /// Also in the air: the vehicle holds until the plugin is ready again, and lands if it is not.
    InFlight,
}

/// Limits of a plugin. Memory, processors and processes include its descendants.
#[derive(Clone, Debug, PartialEq)]
pub struct PluginLimits {
    /// Maximum memory. [MB]
    pub memory_mb: u64,
    /// Maximum number of busy processors, for example 1.5.
    pub cpus: f64,
    /// Maximum number of processes and threads.
    pub processes: u32,
    /// Maximum time of `on_image`; longer calls are reported. [ms]
    pub deadline_ms: f64,
    pub restart: Restart,
    /// Maximum number of restarts in one flight.
    pub restarts: u32,
    /// Whether the plugin may use the network.
    pub network: bool,
    /// User that the plugin runs as if the runtime is root. Default: the account `vizflyt`, or `nobody`
    /// if it does not exist.
    pub user: Option<String>,
    /// Writable folders in addition to the plugin's own, the working folder and `/tmp`.
    pub write: Vec<PathBuf>,
    /// Files and folders shown in a cell in addition to the plugin's own, the system and its interpreter.
    pub read: Vec<PathBuf>,
    /// Folders of the student in addition to those of scripts on the command line. Links in them are not followed out
    /// of them, except from a virtual environment to its Python.
    pub untrusted: Vec<PathBuf>,
    /// Folder in which the plugin starts. Default: the working folder.
    pub folder: Option<PathBuf>,
    /// Whether the plugin is graded: the plugin's folder is read-only, the working folder is hidden, its scratch
    /// files are deleted when it ends, and its environment has only the variables that programs need.
    pub graded: bool,
    /// Map passed to the plugin as JSON, if the course's map is known.
    pub map: Option<String>,
    /// Files and folders that the plugin must not read, such as a grade's secrets. Requires a cell or Landlock.
    pub hide: Vec<PathBuf>,
}

impl Default for PluginLimits {
    fn default() -> Self {
        Self {
            // The other half is for the runtime, and on one computer for the server.
            memory_mb: (memory_total_mb() / 2).max(MIN_MEMORY_MB),
            // One processor is left for the runtime, so that setpoints are sent in time.
            cpus: available_parallelism().map_or(1.0, |n| (n.get() as f64 - 1.0).max(1.0)),
            // numpy, OpenCV and torch start one to two threads per processor each.
            processes: 128,
            // Six images at 60 Hz: an image is then 100 ms old, which is 20 cm at 2 m/s.
            deadline_ms: 100.0,
            restart: Restart::default(),
            restarts: 3,
            network: false,
            user: None,
            write: Vec::new(),
            read: Vec::new(),
            untrusted: Vec::new(),
            folder: None,
            graded: false,
            map: None,
            hide: Vec::new(),
        }
    }
}

/// Minimum memory; no interpreter starts with less. [MB]
pub const MIN_MEMORY_MB: u64 = 64;

/// Environment variables of a graded plugin.
const KEPT: [&str; 9] = [
    "PATH",
    "HOME",
    "LANG",
    "TZ",
    "PYTHONPATH",
    "VIRTUAL_ENV",
    "LD_LIBRARY_PATH",
    "OMP_NUM_THREADS",
    "RUST_BACKTRACE",
];

/// Maximum length of a map, some thousand obstacles: Linux limits an environment variable to 128 KiB. [bytes]
const MAX_MAP: usize = 120 * 1024;

impl PluginLimits {
    /// Parses a map and stores it for the plugin.
    ///
    /// # Errors
    /// If the map is invalid or too large.
    pub fn hand_map(&mut self, text: &str) -> Result<(), String> {
        let volumes = vizflyt_sdk::parse_map(text).map_err(|error| error.to_string())?;
        let text = text.trim().to_owned();
        if text.len() > MAX_MAP {
            return Err(format!(
                "the map of {} obstacles has {} kB, more than the maximum of {} kB; merge obstacles, or leave \
                 out distant ones",
                volumes.len(),
                text.len() / 1024,
                MAX_MAP / 1024
            ));
        }
        self.map = Some(text);
        Ok(())
    }

    /// Same as [`Self::hand_map`], for a file.
    ///
    /// # Errors
    /// If the file cannot be read, or the map is invalid; the text contains the path.
    pub fn hand_map_file(&mut self, path: &Path) -> anyhow::Result<()> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("the map {} cannot be read", path.display()))?;
        let handed = self.hand_map(&text).map_err(anyhow::Error::msg);
        handed.with_context(|| path.display().to_string())
    }

    /// Reduces the environment of a graded plugin to [`KEPT`]: other variables may contain tokens or courses.
    pub(super) fn choose_environment(&self, process: &mut Command) {
        if self.graded {
            let is_kept = |name: &str| KEPT.contains(&name) || name.starts_with("LC_");
            let ours = std::env::vars_os();
            process.env_clear();
            process.envs(ours.filter(|(name, _)| name.to_str().is_some_and(is_kept)));
        }
    }

    /// Checks that a plugin can run within the limits.
    ///
    /// # Errors
    /// One sentence that names the setting.
    pub fn check(&self) -> Result<(), String> {
        if self.memory_mb < MIN_MEMORY_MB {
            return Err(format!(
                "plugin.memory_mb = {}: give {MIN_MEMORY_MB} or more",
                self.memory_mb
            ));
        }
        if !(self.cpus >= 0.1 && self.cpus <= 1024.0) {
            return Err(format!("plugin.cpus = {}: give 0.1 or more", self.cpus));
        }
        if self.processes < 4 {
            return Err(format!("plugin.processes = {}: give 4 or more", self.processes));
        }
        if !(self.deadline_ms > 0.0 && self.deadline_ms.is_finite()) {
            return Err(format!("plugin.deadline_ms = {}: give more than 0", self.deadline_ms));
        }
        Ok(())
    }
}

/// Returns this computer's memory; 4 GB if the system does not report it. [MB]
fn memory_total_mb() -> u64 {
    let text = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let kib = text.lines().find_map(|line| line.strip_prefix("MemTotal:"));
    let kib = kib.and_then(|kib| kib.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
    kib.map_or(4000, |kib| kib * 1024 / 1_000_000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accepts_defaults_and_rejects_invalid_limits_and_maps() {
        let fair = PluginLimits::default();
        assert_eq!(fair.check(), Ok(()));
        assert!(!fair.network && fair.cpus >= 1.0);
        let check = |limits: PluginLimits, named: &str| {
            let why = limits.check().unwrap_err();
            assert!(why.contains(named), "{why}");
        };
        let mut mapped = fair.clone();
        assert!(mapped.hand_map("{}").unwrap_err().contains("map.json"));
        let volume = r#"{"sphere": {"center_m": [1, 2, 3], "radius_m": 0.5}}"#;
        let large = format!("[{}]", vec![volume; 3000].join(","));
        assert!(mapped.hand_map(&large).unwrap_err().contains("3000 obstacles"));
        assert_eq!(mapped.hand_map(&format!("[{volume}]\n")), Ok(()));
        assert_eq!(mapped.map, Some(format!("[{volume}]")));
        check(PluginLimits { memory_mb: 1, ..fair.clone() }, "plugin.memory_mb = 1");
        check(PluginLimits { cpus: f64::NAN, ..fair.clone() }, "plugin.cpus = NaN");
        check(PluginLimits { processes: 1, ..fair.clone() }, "plugin.processes = 1");
        check(PluginLimits { deadline_ms: -1.0, ..fair }, "plugin.deadline_ms = -1");
    }
}
