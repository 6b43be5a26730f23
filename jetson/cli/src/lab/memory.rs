//! Peak memory of this process and all its descendants, from `/proc`.

use std::collections::HashMap;
use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

/// Samples the sum of resident set sizes five times a second. Shared pages count once per process,
/// so the sum is an upper bound.
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

    /// Returns the peak; 0 without `/proc`. [MB]
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
    family(root).values().sum()
}

/// Returns the resident sets of `root` and its descendants, by process. [kB]
fn family(root: u32) -> HashMap<u32, u64> {
    let Ok(entries) = fs::read_dir("/proc") else { return HashMap::new() };
    // pid -> (parent, resident kB)
    let processes: HashMap<u32, (u32, u64)> = entries
        .filter_map(|entry| {
            let pid = entry.ok()?.file_name().to_str()?.parse().ok()?;
            let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
            Some((pid, (field(&status, "PPid:")? as u32, field(&status, "VmRSS:").unwrap_or(0))))
        })
        .collect();
    let descends = |mut pid: u32| {
        // The chain of parents ends at pid 0. The bound protects against inconsistent data.
        for _ in 0..64 {
            if pid == root {
                return true;
            }
            let Some(&(parent, _)) = processes.get(&pid) else { return false };
            pid = parent;
        }
        false
    };
    let of_it = processes.iter().filter(|&(&pid, _)| descends(pid));
    of_it.map(|(&pid, &(_, rss_kb))| (pid, rss_kb)).collect()
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
    fn counts_a_child() {
        use std::io::{BufRead, BufReader};
        use std::process::{Command, Stdio};

        // The child has memory once it has printed, and waits until its input closes. A sum over
        // this process would prove nothing: other tests allocate and free memory at the same time.
        let mut child = Command::new("sh")
            .args(["-c", "echo up; read -r line"])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let own = std::process::id();
        let together = family(own);
        let stranger = family(child.id());
        drop(child.stdin.take());
        child.wait().unwrap();
        assert_eq!(line, "up\n");
        assert!(together[&own] > 500, "this process has {} kB", together[&own]);
        assert!(together[&child.id()] > 0, "the child is not counted: {together:?}");
        assert!(!stranger.contains_key(&own), "the family of a child contains its parent");
        assert!(!family(own).contains_key(&child.id()), "an ended child is counted");
    }

    #[test]
    fn finds_fields() {
        assert_eq!(field("Name:\tx\nPPid:\t12\nVmRSS:\t  345 kB\n", "VmRSS:"), Some(345));
        assert_eq!(field("Name:\tx\n", "VmRSS:"), None);
    }
}
