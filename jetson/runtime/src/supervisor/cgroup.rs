//! Control group of the plugin: limits memory, processors and processes of the plugin and its descendants,
//! and lists them, so that all of them can be killed.
//!
//! Uses version 2 if it is mounted and delegates its controllers, or else version 1 for each controller.
//! Requires permission to make a group: root, or a group that systemd delegates to the user. Without a
//! group, [`confine`](super::confine) limits the plugin by other means.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::limits::PluginLimits;

/// Controller of a control group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Controller {
    Memory,
    Cpu,
    Pids,
}

impl Controller {
    const ALL: [Self; 3] = [Self::Memory, Self::Cpu, Self::Pids];

    fn name(self) -> &'static str {
        match self {
            Self::Memory => "memory",
            Self::Cpu => "cpu",
            Self::Pids => "pids",
        }
    }
}

/// The plugin's control groups: one in version 2, up to three in version 1. Removed when dropped.
#[derive(Debug, Default)]
pub(super) struct Cgroup {
    parts: Vec<GroupFolder>,
}

#[derive(Debug)]
struct GroupFolder {
    folder: PathBuf,
    version: u8,
    limits: Vec<Controller>,
    /// `cgroup.procs`, opened for writing before the plugin changes its user.
    procs: File,
}

/// Prefix of the groups' names; the runtime's process id and a count follow.
const NAME: &str = "vizflyt-plugin-";
/// Period of the processors' quota. [us]
const CPU_PERIOD_US: u64 = 20_000;

impl Cgroup {
    /// Makes as many of the groups as possible; an empty result is valid.
    pub(super) fn make(limits: &PluginLimits) -> Self {
        let mounts = fs::read_to_string("/proc/self/mountinfo").unwrap_or_default();
        let own = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
        let hierarchies = hierarchies(&mounts, &own);
        let mut group = Self::default();
        for place in &hierarchies {
            let missing: Vec<_> =
                place.offers.iter().copied().filter(|&c| !group.limits(c)).collect();
            // A group of version 2 is useful even without controllers: it lists its processes.
            if missing.is_empty() && (place.version == 1 || group.has_version_2()) {
                continue;
            }
            group.parts.extend(GroupFolder::make(place, &missing, limits));
        }
        group
    }

    fn has_version_2(&self) -> bool {
        self.parts.iter().any(|part| part.version == 2)
    }

    /// Whether a group applies this limit.
    pub(super) fn limits(&self, controller: Controller) -> bool {
        self.parts.iter().any(|part| part.limits.contains(&controller))
    }

    /// Returns the files into which a process writes `0` to join.
    pub(super) fn doors(&self) -> Vec<&File> {
        self.parts.iter().map(|part| &part.procs).collect()
    }

    /// Whether the kernel killed a process of the group because of its memory.
    pub(super) fn ran_out_of_memory(&self) -> bool {
        self.events(Controller::Memory, |part| match part.version {
            2 => ("memory.events", "oom_kill"),
            _ => ("memory.oom_control", "oom_kill"),
        })
    }

    /// Whether the kernel rejected a new process of the group.
    pub(super) fn ran_out_of_processes(&self) -> bool {
        self.events(Controller::Pids, |_| ("pids.events", "max"))
    }

    fn events(
        &self,
        controller: Controller,
        place: impl Fn(&GroupFolder) -> (&'static str, &'static str),
    ) -> bool {
        let part = self.parts.iter().find(|part| part.limits.contains(&controller));
        part.is_some_and(|part| {
            let (file, key) = place(part);
            let text = fs::read_to_string(part.folder.join(file)).unwrap_or_default();
            field(&text, key).is_some_and(|count| count > 0)
        })
    }

    /// Returns the member processes; empty without a group.
    pub(super) fn members(&self) -> Vec<Pid> {
        self.parts.first().map_or_else(Vec::new, GroupFolder::members)
    }

    /// Kills all members, including those that they start during the call.
    pub(super) fn kill(&self) {
        for part in &self.parts {
            // Version 2 since Linux 5.14; atomic, so a forking member cannot escape.
            if fs::write(part.folder.join("cgroup.kill"), "1").is_ok() {
                continue;
            }
            // Bounded: the limit on processes stops a member that forks faster than this loop kills.
            for _ in 0..64 {
                let members = part.members();
                if members.is_empty() {
                    break;
                }
                for member in members {
                    let _ = kill(member, Signal::SIGKILL);
                }
            }
        }
    }
}

impl Drop for Cgroup {
    fn drop(&mut self) {
        // An ended process stays a member until it is reaped.
        for part in &self.parts {
            for _ in 0..100 {
                match fs::remove_dir(&part.folder) {
                    Err(error) if error.kind() == io::ErrorKind::ResourceBusy => {
                        thread::sleep(Duration::from_millis(2));
                    }
                    _ => break,
                }
            }
        }
    }
}

impl GroupFolder {
    /// Makes a group in the nearest ancestor of this process's group that permits it and its controllers.
    fn make(place: &Hierarchy, wanted: &[Controller], limits: &PluginLimits) -> Option<Self> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let name = format!("{NAME}{}-{count}", std::process::id());
        // Version 2 forbids processes in a group that delegates controllers to its children. This process
        // is a member of its group, so the search starts at that group's parent.
        let own = place.root.join(place.own.trim_start_matches('/'));
        let above = own.ancestors().skip(usize::from(place.version == 2 && own != place.root));
        let mut best: Option<Self> = None;
        for parent in above.take_while(|parent| parent.starts_with(&place.root)) {
            remove_left_behind(parent);
            let folder = parent.join(&name);
            if fs::create_dir(&folder).is_err() {
                continue;
            }
            let procs = OpenOptions::new().write(true).open(folder.join("cgroup.procs"));
            let Ok(procs) = procs else {
                let _ = fs::remove_dir(&folder);
                continue;
            };
            let mut part = Self { folder, version: place.version, limits: Vec::new(), procs };
            part.limits = wanted.iter().copied().filter(|&c| part.limit(c, limits)).collect();
            if best.as_ref().is_none_or(|best| best.limits.len() < part.limits.len()) {
                part.swap_into(&mut best);
            } else {
                part.remove();
            }
            if best.as_ref().is_some_and(|best| best.limits.len() == wanted.len()) {
                break;
            }
        }
        best
    }

    fn swap_into(self, best: &mut Option<Self>) {
        if let Some(former) = best.replace(self) {
            former.remove();
        }
    }

    fn remove(self) {
        let _ = fs::remove_dir(&self.folder);
    }

    /// Sets a limit; returns whether the kernel accepted it.
    fn limit(&self, controller: Controller, limits: &PluginLimits) -> bool {
        let set = |file: &str, value: String| fs::write(self.folder.join(file), value).is_ok();
        let memory = (limits.memory_mb * 1_000_000).to_string();
        let quota_us = ((limits.cpus * CPU_PERIOD_US as f64) as u64).max(1000);
        match (controller, self.version) {
            (Controller::Memory, 2) => {
                // Without swap accounting the file does not exist, and all use counts as memory.
                let _ = set("memory.swap.max", "0".into());
                let _ = set("memory.oom.group", "1".into());
                set("memory.max", memory)
            }
            (Controller::Memory, _) => {
                let done = set("memory.limit_in_bytes", memory.clone());
                let _ = set("memory.memsw.limit_in_bytes", memory);
                done
            }
            (Controller::Cpu, 2) => set("cpu.max", format!("{quota_us} {CPU_PERIOD_US}")),
            (Controller::Cpu, _) => {
                set("cpu.cfs_period_us", CPU_PERIOD_US.to_string())
                    && set("cpu.cfs_quota_us", quota_us.to_string())
            }
            (Controller::Pids, _) => set("pids.max", limits.processes.to_string()),
        }
    }

    fn members(&self) -> Vec<Pid> {
        let text = fs::read_to_string(self.folder.join("cgroup.procs")).unwrap_or_default();
        text.lines().filter_map(|line| Some(Pid::from_raw(line.parse().ok()?))).collect()
    }
}

/// Removes the groups of runtimes that were killed. The kernel keeps groups with members.
fn remove_left_behind(parent: &Path) {
    let Ok(entries) = fs::read_dir(parent) else { return };
    for entry in entries.flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let pid = name.strip_prefix(NAME).and_then(|rest| rest.split('-').next()?.parse().ok());
        // A running runtime may have made its group without members yet.
        let runs = |pid: u32| Path::new("/proc").join(pid.to_string()).exists();
        if pid.is_some_and(|pid| !runs(pid)) {
            let _ = fs::remove_dir(entry.path());
        }
    }
}

/// A hierarchy and the group of this process in it.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Hierarchy {
    root: PathBuf,
    own: String,
    version: u8,
    offers: Vec<Controller>,
}

/// Returns the hierarchies in `/proc/self/mountinfo` (proc_pid_mountinfo(5)), each with the group of this
/// process from `/proc/self/cgroup` (cgroups(7)), version 2 first.
fn hierarchies(mounts: &str, own: &str) -> Vec<Hierarchy> {
    let mut hierarchies: Vec<Hierarchy> = mounts
        .lines()
        .filter_map(|line| {
            let (mount, kind) = line.split_once(" - ")?;
            let mut mount = mount.split(' ').skip(3);
            let (inner, root) = (mount.next()?, mount.next()?);
            let mut kind = kind.split(' ');
            let version = match kind.next()? {
                "cgroup2" => 2,
                "cgroup" => 1,
                _ => return None,
            };
            let options = kind.nth(1).unwrap_or_default();
            let offers: Vec<Controller> = Controller::ALL
                .into_iter()
                .filter(|c| version == 2 || options.split(',').any(|o| o == c.name()))
                .collect();
            if offers.is_empty() {
                return None;
            }
            let path = own.lines().find_map(|line| {
                let mut fields = line.splitn(3, ':').skip(1);
                let (names, path) = (fields.next()?, fields.next()?);
                let is_it = match version {
                    2 => names.is_empty(),
                    _ => names.split(',').any(|name| offers.iter().any(|c| c.name() == name)),
                };
                is_it.then_some(path)
            })?;
            // Inside a container, the mount shows only a part of the hierarchy.
            let path = path.strip_prefix(inner.trim_end_matches('/')).unwrap_or(path);
            Some(Hierarchy { root: root.into(), own: path.to_owned(), version, offers })
        })
        .collect();
    hierarchies.sort_by_key(|place| std::cmp::Reverse(place.version));
    hierarchies
}

/// Returns the number after `key` in lines of `KEY NUMBER`.
fn field(text: &str, key: &str) -> Option<u64> {
    text.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(' ')?.trim().parse().ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    const MOUNTS_1: &str = "\
35 24 0:30 / /sys/fs/cgroup rw - tmpfs tmpfs rw
36 35 0:31 / /sys/fs/cgroup/memory rw,relatime - cgroup cgroup rw,memory
37 35 0:32 / /sys/fs/cgroup/cpu,cpuacct rw,relatime - cgroup cgroup rw,cpu,cpuacct
38 35 0:33 / /sys/fs/cgroup/blkio rw,relatime - cgroup cgroup rw,blkio
39 35 0:34 / /sys/fs/cgroup/unified rw,relatime - cgroup2 cgroup2 rw";

    #[test]
    fn finds_hierarchies_of_both_versions() {
        let own = "4:memory:/a/b\n2:cpu,cpuacct:/\n3:blkio:/\n0::/user.slice";
        let found = hierarchies(MOUNTS_1, own);
        let seen: Vec<_> =
            found.iter().map(|p| (p.root.to_str().unwrap(), p.own.as_str(), p.version)).collect();
        assert_eq!(
            seen,
            [
                ("/sys/fs/cgroup/unified", "/user.slice", 2),
                ("/sys/fs/cgroup/memory", "/a/b", 1),
                ("/sys/fs/cgroup/cpu,cpuacct", "/", 1)
            ]
        );
        assert_eq!(found[2].offers, [Controller::Cpu]);
        let inside = "36 35 0:31 /docker/x /sys/fs/cgroup rw - cgroup2 cgroup rw";
        assert_eq!(hierarchies(inside, "0::/docker/x/y")[0].own, "/y");
        assert!(
            hierarchies("", "0::/").is_empty() && hierarchies("nonsense - cgroup", "").is_empty()
        );
    }

    #[test]
    fn removes_its_groups_when_dropped() {
        let limits = PluginLimits { processes: 9, ..PluginLimits::default() };
        let group = Cgroup::make(&limits);
        let folders: Vec<_> = group.parts.iter().map(|part| part.folder.clone()).collect();
        // Empty if this user may not make groups.
        for part in &group.parts {
            assert!(part.members().is_empty() && part.folder.exists());
        }
        assert!(!group.ran_out_of_memory() && !group.ran_out_of_processes());
        drop(group);
        assert!(folders.iter().all(|folder| !folder.exists()));
    }

    #[test]
    fn parses_event_counters() {
        assert_eq!(field("low 0\noom_kill 3\n", "oom_kill"), Some(3));
        assert_eq!(field("oom_kill_disable 0\noom_kill 1\n", "oom_kill"), Some(1));
        assert_eq!(field("", "max"), None);
    }
}
