//! Limits of a plugin, and what happens when it ends: the settings, from `[plugin]` in
//! `jetson.toml`.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::available_parallelism;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};

/// When a plugin that ended is started again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Restart {
    /// Never: on the ground the flight is off, in the air the vehicle lands.
    Never,
    /// As long as the vehicle stands on the ground; in the air it lands.
    #[default]
    OnGround,
    /// In the air too: the vehicle holds until the plugin is back, and lands if it is not.
    InFlight,
}

/// Limits of a plugin. Memory, processors and processes count for it and all it starts.
#[derive(Clone, Debug, PartialEq)]
pub struct PluginLimits {
    /// Memory. [MB]
    pub memory_mb: u64,
    /// Processors it may keep busy; 1.5 is one and a half.
    pub cpus: f64,
    /// Processes and threads.
    pub processes: u32,
    /// Maximum time of `on_image`; what is beyond is shown. [ms]
    pub deadline_ms: f64,
    /// When it is started again.
    pub restart: Restart,
    /// How often, in one flight.
    pub restarts: u32,
    /// Whether it may use the network.
    pub network: bool,
    /// The user it runs as if the runtime is root; without it `vizflyt`, or else `nobody`.
    pub user: Option<String>,
    /// Folders it may write in, beside its own, the working folder and `/tmp`.
    pub write: Vec<PathBuf>,
    /// Files and folders that it sees beside its own, the system and its interpreter, in a cell.
    pub read: Vec<PathBuf>,
    /// Where it starts; without it the working folder.
    pub folder: Option<PathBuf>,
    /// It is graded: its own folder cannot be changed, the working folder is not seen, nothing it writes outlives it,
    /// and of the environment it gets what programs need.
    pub graded: bool,
    /// The map that it is handed, as JSON, where the course's map is known.
    pub map: Option<String>,
    /// Files and folders that it may not read, where it has a cell or the kernel has Landlock: what a grade must keep
    /// from it.
    pub hide: Vec<PathBuf>,
}

impl Default for PluginLimits {
    fn default() -> Self {
        Self {
            // Half of what there is: the other half is for the runtime, and on one computer for
            // the server.
            memory_mb: (memory_total_mb() / 2).max(MIN_MEMORY_MB),
            // One is left for the runtime, so that setpoints leave in time.
            cpus: available_parallelism().map_or(1.0, |n| (n.get() as f64 - 1.0).max(1.0)),
            // numpy, OpenCV and torch start one to two threads per processor each.
            processes: 128,
            // Six images at 60 Hz: the plugin flies on what was true 100 ms ago, at 2 m/s 20 cm.
            deadline_ms: 100.0,
            restart: Restart::default(),
            restarts: 3,
            network: false,
            user: None,
            write: Vec::new(),
            read: Vec::new(),
            folder: None,
            graded: false,
            map: None,
            hide: Vec::new(),
        }
    }
}

/// Less than this, no interpreter starts. [MB]
pub const MIN_MEMORY_MB: u64 = 64;

/// Variables that a graded plugin gets.
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

/// Linux takes environment variables of 128 KiB: some thousand obstacles.
const MAX_MAP: usize = 120 * 1024;

impl PluginLimits {
    /// Hands the plugin a map, if it is one.
    ///
    /// # Errors
    /// The fault.
    pub fn hand_map(&mut self, text: &str) -> Result<(), String> {
        let volumes = vizflyt_sdk::parse_map(text).map_err(|error| error.to_string())?;
        let text = text.trim().to_owned();
        if text.len() > MAX_MAP {
            return Err(format!(
                "the map of {} obstacles has {} kB, more than the {} kB that a plugin can be handed",
                volumes.len(),
                text.len() / 1024,
                MAX_MAP / 1024
            ));
        }
        self.map = Some(text);
        Ok(())
    }

    /// As [`Self::hand_map`], of a file.
    ///
    /// # Errors
    /// The fault, and the name.
    pub fn hand_map_file(&mut self, path: &Path) -> anyhow::Result<()> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("the map {} cannot be read", path.display()))?;
        let handed = self.hand_map(&text).map_err(anyhow::Error::msg);
        handed.with_context(|| path.display().to_string())
    }

    /// Leaves a graded plugin of our environment what programs need: tokens and courses may stand in the rest.
    pub(super) fn choose_environment(&self, process: &mut Command) {
        if self.graded {
            let is_kept = |name: &str| KEPT.contains(&name) || name.starts_with("LC_");
            let ours = std::env::vars_os();
            process.env_clear();
            process.envs(ours.filter(|(name, _)| name.to_str().is_some_and(is_kept)));
        }
    }

    /// Checks that the limits leave a plugin room to live.
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

/// Returns this computer's memory; 4 GB where the system does not report it. [MB]
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
    fn defaults_leave_room_and_nonsense_is_refused() {
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
