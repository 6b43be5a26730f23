//! How much of its own time a plugin has taken for an answer: what it computed, and what it slept by its own choice.
//!
//! ```text
//! /proc: its processes and threads --> Sample --> OwnTime --> taken, or lost
//! ```
//! Time that the computer took from it counts for nothing: while it waits for a processor or a disk, while somebody
//! has stopped it, and while we are stopped ourselves. So a loaded, swapping or suspended computer fails no plugin.

use std::collections::BTreeMap;
use std::fs;
use std::time::{Duration, Instant};

/// A plugin that has not answered is looked at this often.
pub(super) const SAMPLE_EVERY: Duration = Duration::from_millis(200);
/// Between two looks so much counts at most: whatever is beyond, we were not there ourselves.
const LONGEST: Duration = Duration::from_millis(400);
/// A plugin that neither computes nor sleeps for so long, as far as we were there, has been stopped, or its computer has
/// no time for it.
const LOST_AFTER: Duration = Duration::from_mins(10);

/// What a plugin's processes and threads are doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Activity {
    /// All of them sleep: each waits for something that it chose to wait for.
    Sleeping,
    /// One of them at least wants a processor or a disk, or is stopped.
    Wanting,
    /// There are none.
    Gone,
}

/// One look at a plugin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Sample {
    /// Computed so far by all of them, also those that have ended.
    pub cpu: Duration,
    /// What they are doing.
    pub activity: Activity,
}

/// The time that a plugin has taken since it was asked.
#[derive(Debug)]
pub(super) struct OwnTime {
    sampled: Instant,
    /// Computed when it was looked at last; nothing is known before the first look.
    cpu: Option<Duration>,
    taken: Duration,
    withheld: Duration,
}

impl OwnTime {
    /// Begins to count.
    pub(super) fn new(now: Instant) -> Self {
        Self { sampled: now, cpu: None, taken: Duration::ZERO, withheld: Duration::ZERO }
    }

    /// Whether it is time for the next look.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.sampled) >= SAMPLE_EVERY
    }

    /// Takes a look at `now`.
    pub(super) fn take(&mut self, now: Instant, sample: Sample) {
        let since = now.saturating_duration_since(self.sampled).min(LONGEST);
        self.sampled = now;
        // What it computed before the first look is not known to be of this answer.
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

    /// Returns what it has taken.
    pub(super) fn taken(&self) -> Duration {
        self.taken
    }

    /// Whether the computer has given it no time for so long that this is not going to end.
    pub(super) fn is_lost(&self) -> bool {
        self.withheld >= LOST_AFTER
    }
}

/// Looks at a process and all that it started.
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

/// What proc_pid_stat(5) says of a process or thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Stat {
    state: char,
    parent: u32,
    group: u32,
    /// Of its own and of children that it has waited for. [clock ticks]
    ticks: u64,
}

/// Parses a line of proc_pid_stat(5). The name in parentheses may hold anything.
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

/// Whether a process was started by `root`, or by one that was.
fn descends(all: &BTreeMap<u32, Stat>, mut id: u32, root: u32) -> bool {
    // Bounded: what is read while processes come and go may be a ring.
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

    /// Looks every [`STEP`] at a plugin that does this.
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
    fn what_it_computes_and_sleeps_counts_and_nothing_else() {
        let close = |found: Duration, expected: Duration| {
            assert!(found.abs_diff(expected) < Duration::from_millis(1), "{found:?} {expected:?}");
        };
        close(after(50, Activity::Sleeping, 0.0).taken(), STEP * 50);
        close(after(50, Activity::Wanting, 1.0).taken(), STEP * 50);
        // A starved one, with a tenth of a processor; one with four.
        close(after(50, Activity::Wanting, 0.1).taken(), STEP * 5);
        close(after(50, Activity::Wanting, 4.0).taken(), STEP * 200);
        // Stopped, or swapped out: not its doing, and in the end nobody waits for it.
        let stopped = after(2999, Activity::Wanting, 0.0);
        assert!(stopped.taken().is_zero() && !stopped.is_lost());
        assert!(after(3001, Activity::Wanting, 0.0).is_lost());
        assert!(!after(9000, Activity::Wanting, 0.01).is_lost());
    }

    #[test]
    fn what_we_slept_ourselves_does_not_count() {
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
    fn lines_are_parsed_with_any_name() {
        let line = "12 (a) R 9 (c) S 7 77 77 0 -1 4194560 1 2 3 4 50 6 7 8 20 0 9 0 123 456 789";
        let expected = Stat { state: 'S', parent: 7, group: 77, ticks: 71 };
        assert_eq!(parse(line), Some(expected));
        for cut in 0..line.len() - 35 {
            assert_eq!(parse(&line[..cut]), None, "{cut}");
        }
    }

    #[test]
    fn a_process_and_its_children_are_seen() {
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
        // The child computes, in a group of its own, while its parent waits.
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
