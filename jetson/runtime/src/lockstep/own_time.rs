//! Own time of a plugin during a reply: its computing time, and its voluntary sleep.
//!
//! ```text
//! /proc: its processes and threads --> Sample --> OwnTime --> taken, or lost
//! ```
//! Time that the computer takes from the plugin does not count: waiting for a processor or a disk, being stopped by
//! another process, and time in which this program itself is stopped. Therefore a plugin does not fail on a loaded,
//! swapping or suspended computer.

use std::collections::BTreeMap;
use std::fs;
use std::time::{Duration, Instant};

/// Sampling period while a reply is awaited.
pub(super) const SAMPLE_EVERY: Duration = Duration::from_millis(200);
/// Maximum time that counts between two samples: beyond it, this program itself was not running.
const LONGEST: Duration = Duration::from_millis(400);
/// A plugin that neither computes nor sleeps for this long was stopped, or the computer is overloaded. Counts only time
/// in which this program was running.
const LOST_AFTER: Duration = Duration::from_mins(10);

/// Activity of a plugin's processes and threads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Activity {
    /// All sleep: each waits for something by its own choice.
    Sleeping,
    /// At least one needs a processor or a disk, or is stopped.
    Wanting,
    /// There are no processes.
    Gone,
}

/// Sample of a plugin's processes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Sample {
    /// Computing time of all processes, including those that have ended.
    pub cpu: Duration,
    pub activity: Activity,
}

/// Own time of a plugin since an observation was published.
#[derive(Debug)]
pub(super) struct OwnTime {
    sampled: Instant,
    /// Computing time at the last sample; unknown before the first one.
    cpu: Option<Duration>,
    taken: Duration,
    withheld: Duration,
}

impl OwnTime {
    /// Starts to count.
    pub(super) fn new(now: Instant) -> Self {
        Self { sampled: now, cpu: None, taken: Duration::ZERO, withheld: Duration::ZERO }
    }

    /// Whether the next sample is due.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.sampled) >= SAMPLE_EVERY
    }

    /// Adds a sample taken at `now`.
    pub(super) fn take(&mut self, now: Instant, sample: Sample) {
        let since = now.saturating_duration_since(self.sampled).min(LONGEST);
        self.sampled = now;
        // Computing time before the first sample may belong to an earlier reply.
        let before = self.cpu.unwrap_or(sample.cpu);
        let computed = sample.cpu.saturating_sub(before);
        self.cpu = Some(sample.cpu.max(before));
        self.taken += computed;
        match sample.activity {
            Activity::Sleeping => self.taken += since.saturating_sub(computed),
            Activity::Wanting | Activity::Gone if computed.is_zero() => {
                self.withheld += since;
                return;
            }
            Activity::Wanting | Activity::Gone => {}
        }
        self.withheld = Duration::ZERO;
    }

    /// Returns the own time.
    pub(super) fn taken(&self) -> Duration {
        self.taken
    }

    /// Whether the plugin got no time for [`LOST_AFTER`], so that waiting longer is useless.
    pub(super) fn is_lost(&self) -> bool {
        self.withheld >= LOST_AFTER
    }
}

/// Samples a process and all its descendants.
pub(super) fn look(root: u32) -> Sample {
    let ticks = nix::unistd::sysconf(nix::unistd::SysconfVar::CLK_TCK).ok().flatten();
    let ticks_per_s = ticks.unwrap_or(100).max(1) as f64;
    let all = processes();
    let (mut ticks, mut activity) = (0, Activity::Gone);
    for (&id, process) in &all {
        let is_of_plugin = process.group == root || descends(&all, id, root);
        if !is_of_plugin || process.state == 'Z' {
            continue;
        }
        ticks += process.ticks;
        if activity != Activity::Wanting {
            let sleeps = states(id).into_iter().all(|state| matches!(state, 'S' | 'I' | 'Z' | 'X'));
            activity = if sleeps { Activity::Sleeping } else { Activity::Wanting };
        }
    }
    Sample { cpu: Duration::from_secs_f64(ticks as f64 / ticks_per_s), activity }
}

/// Fields of proc_pid_stat(5) of a process or thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Stat {
    state: char,
    parent: u32,
    group: u32,
    /// Computing time of the process and of children that it has waited for. [clock ticks]
    ticks: u64,
}

/// Parses a line of proc_pid_stat(5). The name in parentheses may contain any characters.
fn parse(line: &str) -> Option<Stat> {
    let (_, fields) = line.rsplit_once(") ")?;
    let fields: Vec<&str> = fields.split_ascii_whitespace().collect();
    let number = |index: usize| fields.get(index)?.parse::<u64>().ok();
    let ticks = (11..15).map(number).try_fold(0u64, |sum, ticks| Some(sum.saturating_add(ticks?)));
    Some(Stat {
        state: fields.first()?.chars().next()?,
        parent: fields.get(1)?.parse().ok()?,
        group: fields.get(2)?.parse().ok()?,
        ticks: ticks?,
    })
}

fn processes() -> BTreeMap<u32, Stat> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    let stat = |entry: fs::DirEntry| {
        let id = entry.file_name().to_str()?.parse().ok()?;
        Some((id, parse(&fs::read_to_string(entry.path().join("stat")).ok()?)?))
    };
    entries.filter_map(stat).collect()
}

/// Whether a process is a descendant of `root`.
fn descends(all: &BTreeMap<u32, Stat>, mut id: u32, root: u32) -> bool {
    // Bounded, because entries read while processes start and end may form a cycle.
    for _ in 0..64 {
        if id == root {
            return true;
        }
        match all.get(&id) {
            Some(process) if process.parent != 0 => id = process.parent,
            _ => return false,
        }
    }
    false
}

/// Returns the states of a process's threads.
fn states(id: u32) -> Vec<char> {
    let threads = fs::read_dir(format!("/proc/{id}/task")).into_iter().flatten().flatten();
    let state = |entry: fs::DirEntry| {
        Some(parse(&fs::read_to_string(entry.path().join("stat")).ok()?)?.state)
    };
    threads.filter_map(state).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::process::{Command, Stdio};

    const STEP: Duration = SAMPLE_EVERY;

    /// Samples a plugin with this behaviour every [`STEP`].
    fn after(looks: u32, activity: Activity, cpu_share: f64) -> OwnTime {
        let start = Instant::now();
        let mut time = OwnTime::new(start);
        for look in 0..=looks {
            let cpu = STEP.mul_f64(cpu_share) * look;
            time.take(start + STEP * look, Sample { cpu, activity });
        }
        time
    }

    #[test]
    fn counts_only_computing_and_sleeping() {
        let close = |found: Duration, expected: Duration| {
            assert!(found.abs_diff(expected) < Duration::from_millis(1), "{found:?} {expected:?}");
        };
        close(after(50, Activity::Sleeping, 0.0).taken(), STEP * 50);
        close(after(50, Activity::Wanting, 1.0).taken(), STEP * 50);
        // A starved plugin, with a tenth of a processor; one with four processors.
        close(after(50, Activity::Wanting, 0.1).taken(), STEP * 5);
        close(after(50, Activity::Wanting, 4.0).taken(), STEP * 200);
        // Stopped or swapped out: does not count, and is lost in the end.
        let stopped = after(2999, Activity::Wanting, 0.0);
        assert!(stopped.taken().is_zero() && !stopped.is_lost());
        assert!(after(3001, Activity::Wanting, 0.0).is_lost());
        assert!(!after(9000, Activity::Wanting, 0.01).is_lost());
    }

    #[test]
    fn ignores_time_in_which_this_program_was_stopped() {
        let start = Instant::now();
        let mut time = OwnTime::new(start);
        let asleep = Sample { cpu: Duration::from_secs(5), activity: Activity::Sleeping };
        time.take(start + STEP, asleep);
        time.take(start + Duration::from_hours(1), asleep);
        assert!(time.taken() <= STEP + LONGEST, "{:?}", time.taken());
        let stopped = Sample { activity: Activity::Wanting, ..asleep };
        time.take(start + Duration::from_hours(2), stopped);
        assert!(!time.is_lost());
    }

    #[test]
    fn parses_lines_with_any_name() {
        let line = "12 (a) R 9 (c) S 7 77 77 0 -1 4194560 1 2 3 4 50 6 7 8 20 0 9 0 123 456 789";
        let expected = Stat { state: 'S', parent: 7, group: 77, ticks: 71 };
        assert_eq!(parse(line), Some(expected));
        for cut in 0..line.len() - 35 {
            assert_eq!(parse(&line[..cut]), None, "{cut}");
        }
    }

    #[test]
    fn samples_a_process_and_its_children() {
        let mut sleeper = Command::new("sh")
            .args(["-c", "setsid sleep 60 & read line; kill $!"])
            .stdin(Stdio::piped())
            .spawn()
            .unwrap();
        let until = |root: u32, activity: Activity| {
            while look(root).activity != activity {
                std::thread::yield_now();
            }
        };
        until(sleeper.id(), Activity::Sleeping);
        drop(sleeper.stdin.take());
        sleeper.wait().unwrap();
        assert_eq!(look(sleeper.id()).activity, Activity::Gone);
        // The child computes, in a separate process group, while its parent waits.
        let mut busy = Command::new("sh")
            .args(["-c", "setsid sh -c 'while :; do :; done' & trap 'kill $!' TERM; wait"])
            .spawn()
            .unwrap();
        while look(busy.id()).cpu < Duration::from_millis(50) {
            std::thread::yield_now();
        }
        assert_eq!(look(busy.id()).activity, Activity::Wanting);
        let id = nix::unistd::Pid::from_raw(busy.id().cast_signed());
        nix::sys::signal::kill(id, nix::sys::signal::Signal::SIGTERM).unwrap();
        busy.wait().unwrap();
    }

    proptest! {
        #[test]
        fn no_line_panics(line in ".{0,200}") {
            let _ = parse(&line);
        }
    }
}
