//! Checks a plugin's limits: by its control group, or else by counting its processes.

use std::collections::BTreeMap;
use std::fs;

use nix::unistd::Pid;

use super::cgroup::Cgroup;
use super::limits::PluginLimits;

/// Memory and number of the processes of a group.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Usage {
    /// Private memory, without shared pages. [bytes]
    pub memory: u64,
    /// Number of processes and threads.
    pub tasks: u64,
}

/// Returns the exceeded limit as a sentence; `None` if the plugin is within its limits.
pub(super) fn beyond_limits(
    limits: &PluginLimits,
    cgroup: &Cgroup,
    counted: Option<Usage>,
) -> Option<String> {
    let usage = counted.unwrap_or_default();
    if cgroup.ran_out_of_memory() || usage.memory > limits.memory_mb * 1_000_000 {
        return Some(format!(
            "the plugin used more than its {} MB of memory and was ended; look for what grows with \
             each image, or raise memory_mb in [plugin]",
            limits.memory_mb
        ));
    }
    if cgroup.ran_out_of_processes() || usage.tasks > u64::from(limits.processes) {
        return Some(format!(
            "the plugin started more than its {} processes and threads and was ended; look for what \
             starts them with each image, or raise processes in [plugin]",
            limits.processes
        ));
    }
    None
}

/// Counts the processes of a process group; in a cell, all descendants of its init.
pub(super) fn count(group: Pid, in_cell: bool) -> Usage {
    let page = nix::unistd::sysconf(nix::unistd::SysconfVar::PAGE_SIZE).ok().flatten();
    let page = page.map_or(4096, i64::unsigned_abs);
    let mut usage = Usage::default();
    for (id, stat) in found(group, in_cell) {
        let folder = format!("/proc/{id}");
        // Resident minus shared (proc_pid_statm(5)): the images are in the runtime's memory.
        let statm = fs::read_to_string(format!("{folder}/statm")).unwrap_or_default();
        let mut pages = statm.split(' ').skip(1).map(|field| field.parse::<u64>().unwrap_or(0));
        let (resident, shared) = (pages.next().unwrap_or(0), pages.next().unwrap_or(0));
        usage.memory += resident.saturating_sub(shared) * page;
        usage.tasks += stat.threads;
    }
    usage
}

/// Returns the processes counted by [`count`].
pub(super) fn processes(group: Pid, in_cell: bool) -> Vec<Pid> {
    found(group, in_cell).into_iter().map(|(id, _)| Pid::from_raw(id)).collect()
}

fn found(group: Pid, in_cell: bool) -> Vec<(i32, Stat)> {
    let mut all = BTreeMap::new();
    for entry in fs::read_dir("/proc").into_iter().flatten().flatten() {
        let folder = entry.path();
        let id = entry.file_name().to_str().and_then(|name| name.parse::<i32>().ok());
        let stat = fs::read_to_string(folder.join("stat")).unwrap_or_default();
        all.extend(id.and_then(|id| Some((id, parse_stat(&stat)?))));
    }
    let parent = |id: i32| all.get(&id).map(|stat: &Stat| stat.parent);
    let counts = |id: i32, stat: &Stat| {
        // Skips keeper and init, the keeper's child: they hold copies of the runtime's memory.
        if in_cell {
            let mut above = std::iter::successors(parent(id), |&id| parent(id)).skip(1);
            above.any(|id| id == group.as_raw())
        } else {
            stat.group == group.as_raw()
        }
    };
    all.iter().filter(|(id, stat)| counts(**id, stat)).map(|(&id, &stat)| (id, stat)).collect()
}

/// Fields of a process (proc_pid_stat(5)).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Stat {
    parent: i32,
    group: i32,
    threads: u64,
}

/// Parses a `stat` line. The name in parentheses may contain any characters.
fn parse_stat(stat: &str) -> Option<Stat> {
    let (_, fields) = stat.rsplit_once(") ")?;
    let mut fields = fields.split(' ').skip(1);
    let mut number = |skip| fields.nth(skip)?.parse::<i64>().ok();
    let (parent, group, threads) = (number(0)?, number(0)?, number(14)?);
    Some(Stat {
        parent: parent.try_into().ok()?,
        group: group.try_into().ok()?,
        threads: threads.try_into().ok()?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_stat_lines_with_any_process_name() {
        let line = "12 (a) b (c) S 1 77 77 0 -1 4194560 1 2 3 4 5 6 7 8 20 0 9 0 123 456 789";
        assert_eq!(parse_stat(line), Some(Stat { parent: 1, group: 77, threads: 9 }));
        assert_eq!(parse_stat("nonsense"), None);
        let own = fs::read_to_string("/proc/self/stat").unwrap();
        let group = nix::unistd::getpgrp();
        assert_eq!(parse_stat(&own).unwrap().group, group.as_raw());
        let usage = count(group, false);
        assert!(usage.tasks >= 1 && usage.memory > 100_000, "{usage:?}");
    }

    #[test]
    fn reports_each_exceeded_limit_with_its_value() {
        let limits = PluginLimits { memory_mb: 100, processes: 9, ..PluginLimits::default() };
        let verdict = |memory, tasks| {
            beyond_limits(&limits, &Cgroup::default(), Some(Usage { memory, tasks }))
        };
        assert_eq!(verdict(99_000_000, 9), None);
        assert!(verdict(101_000_000, 1).unwrap().contains("its 100 MB of memory"));
        assert!(verdict(0, 10).unwrap().contains("its 9 processes"));
    }
}
