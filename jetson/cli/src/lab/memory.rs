//! Peak memory of this process and all its descendants, from `/proc`.

use std::collections::HashMap;
use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

/// Samples the sum of resident set sizes five times a second. Pages that processes share count
/// once for each of them, so the figure is an upper bound.
pub(crate) struct MemoryWatch {
    peak_kb: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
}

impl MemoryWatch {
    /// Starts the sampler's thread.
    pub(crate) fn start() -> Self {
        let watch =
            Self { peak_kb: Arc::new(AtomicU64::new(0)), stop: Arc::new(AtomicBool::new(false)) };
        let (peak_kb, stop) = (watch.peak_kb.clone(), watch.stop.clone());
        std::thread::spawn(move || {
            while !stop.load(Ordering::Relaxed) {
                peak_kb.fetch_max(family_rss_kb(std::process::id()), Ordering::Relaxed);
                std::thread::sleep(Duration::from_millis(200));
            }
        });
        watch
    }

    /// Returns the peak so far; 0 where there is no `/proc`. [MB]
    pub(crate) fn peak_mb(&self) -> f64 {
        self.peak_kb.load(Ordering::Relaxed) as f64 / 1024.0
    }
}

impl Drop for MemoryWatch {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

/// Returns the summed resident set of `root` and its descendants. [kB]
fn family_rss_kb(root: u32) -> u64 {
    let Ok(entries) = fs::read_dir("/proc") else { return 0 };
    // pid -> (parent, resident kB)
    let processes: HashMap<u32, (u32, u64)> = entries
        .filter_map(|entry| {
            let pid = entry.ok()?.file_name().to_str()?.parse().ok()?;
            let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
            Some((pid, (field(&status, "PPid:")? as u32, field(&status, "VmRSS:").unwrap_or(0))))
        })
        .collect();
    let descends = |mut pid: u32| {
        // The chain of parents ends at pid 0; a bound guards against a torn reading.
        for _ in 0..64 {
            if pid == root {
                return true;
            }
            let Some(&(parent, _)) = processes.get(&pid) else { return false };
            pid = parent;
        }
        false
    };
    processes.iter().filter(|&(&pid, _)| descends(pid)).map(|(_, &(_, rss_kb))| rss_kb).sum()
}

/// Returns the number after `name` in the text of `/proc/PID/status`.
fn field(status: &str, name: &str) -> Option<u64> {
    status.lines().find_map(|line| line.strip_prefix(name))?.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn a_child_is_counted() {
        let alone = family_rss_kb(std::process::id());
        assert!(alone > 500, "this process alone has {alone} kB");
        let mut child = std::process::Command::new("sleep").arg("30").spawn().unwrap();
        let together = family_rss_kb(std::process::id());
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(together > alone, "{together} kB with a child, {alone} kB without");
    }

    #[test]
    fn fields_are_found() {
        assert_eq!(field("Name:\tx\nPPid:\t12\nVmRSS:\t  345 kB\n", "VmRSS:"), Some(345));
        assert_eq!(field("Name:\tx\n", "VmRSS:"), None);
    }
}
