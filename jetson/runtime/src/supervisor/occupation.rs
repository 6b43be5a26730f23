//! Time budget of the plugin's processes: computing, waiting for a processor, or sleeping. The supervisor samples
//! them at 10 Hz; the samples explain a silent plugin.

use std::collections::VecDeque;
use std::fmt;
use std::fs;

use nix::unistd::Pid;
use vizflyt_protocol::time::HostTime;

/// Number of samples kept: longer than the silence after which the vehicle lands.
const LOOKS: usize = 40;

/// Computing time below which a plugin that waits for a processor counts as starved: twice the default deadline of a
/// reply. [s]
const LITTLE_S: f64 = 0.2;

/// One sample: state of all threads at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Look {
    pub(super) at: HostTime,
    /// Processor time since each thread's start. [ns]
    pub(super) computed_ns: u64,
    /// Whether a thread runs or is ready to run.
    pub(super) wants_processor: bool,
}

/// The newest samples, newest first.
#[derive(Debug, Default)]
pub(super) struct Occupation(VecDeque<Look>);

/// Time of the plugin's processes, split by use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimeSpent {
    /// Time between the first and the last sample. [s]
    pub total_s: f64,
    /// Computing, on all processors. [s]
    pub computed_s: f64,
    /// Ready to run, without a processor. [s]
    pub waited_s: f64,
}

impl Look {
    /// Samples `processes`. Ended processes are not counted.
    pub(super) fn at(at: HostTime, processes: &[Pid]) -> Self {
        let mut look = Self { at, computed_ns: 0, wants_processor: false };
        for process in processes {
            let threads = fs::read_dir(format!("/proc/{process}/task"));
            for thread in threads.into_iter().flatten().flatten() {
                let read = |name| fs::read_to_string(thread.path().join(name)).unwrap_or_default();
                look.computed_ns += computed_ns(&read("schedstat"));
                look.wants_processor |= wants_processor(&read("stat"));
            }
        }
        look
    }
}

impl Occupation {
    pub(super) fn add(&mut self, look: Look) {
        self.0.truncate(LOOKS - 1);
        self.0.push_front(look);
    }

    /// Returns how the time from `since` on was spent; `None` with fewer than two samples.
    pub(super) fn since(&self, since: HostTime) -> Option<TimeSpent> {
        let looks: Vec<_> = self.0.iter().take_while(|look| look.at >= since).collect();
        let (newest, oldest) = (*looks.first()?, *looks.last()?);
        if looks.len() < 2 {
            return None;
        }
        let computed_s = newest.computed_ns.saturating_sub(oldest.computed_ns) as f64 * 1e-9;
        // A sampled state counts for the time since the previous sample.
        let wanted_s: f64 = looks
            .windows(2)
            .filter(|pair| pair[0].wants_processor)
            .map(|pair| pair[0].at.seconds_since(pair[1].at))
            .sum();
        Some(TimeSpent {
            total_s: newest.at.seconds_since(oldest.at),
            computed_s,
            waited_s: (wanted_s - computed_s).max(0.0),
        })
    }
}

impl fmt::Display for TimeSpent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { total_s, computed_s, waited_s } = *self;
        let wanted_s = computed_s + waited_s;
        if wanted_s < 0.5 * total_s {
            let slept_s = (total_s - wanted_s).max(0.0);
            return write!(
                f,
                "of {total_s:.1} s the plugin's process slept for {slept_s:.1} s: look for what `on_image` waits for"
            );
        }
        write!(
            f,
            "of {total_s:.1} s the plugin's process computed for {computed_s:.1} s and waited {waited_s:.1} s for a processor: "
        )?;
        f.write_str(if computed_s < LITTLE_S {
            "other programs keep this computer busy, or it needs more than `cpus` in [plugin]"
        } else {
            "look for a loop or slow code in `on_image`"
        })
    }
}

/// Parses the processor time, the first field of `schedstat` (Linux, Documentation/scheduler/sched-stats.rst). [ns]
fn computed_ns(schedstat: &str) -> u64 {
    schedstat.split(' ').next().and_then(|field| field.parse().ok()).unwrap_or(0)
}

/// Whether a thread's state in its `stat` is R (proc_pid_stat(5)). The name before it may contain any characters.
fn wants_processor(stat: &str) -> bool {
    stat.rsplit_once(") ").is_some_and(|(_, fields)| fields.starts_with('R'))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the sentence for a silence of 2 s, with `computed_ms` of processor time in each 0.1 s.
    fn sentence(computed_ms: u64, wants_processor: bool) -> String {
        let mut occupation = Occupation::default();
        let start = HostTime::from_ns(1_000_000_000);
        // The opposite state before the silence must not count.
        for k in 0..15u32 {
            let at = start.plus_ns(i64::from(k) * 100_000_000 - 1_600_000_000);
            occupation.add(Look { at, computed_ns: 0, wants_processor: !wants_processor });
        }
        for k in 0..=20u64 {
            let (at, computed_ns) =
                (start.plus_ns(k as i64 * 100_000_000), k * computed_ms * 1_000_000);
            occupation.add(Look { at, computed_ns, wants_processor });
        }
        occupation.since(start).unwrap().to_string()
    }

    #[test]
    fn distinguishes_starving_computing_and_sleeping() {
        let expect = |sentence: String, times: &str, advice: &str| {
            assert!(sentence.contains(times) && sentence.contains(advice), "{sentence}");
        };
        let starved = sentence(1, true);
        expect(
            starved,
            "of 2.0 s the plugin's process computed for 0.0 s and waited 2.0 s",
            "busy",
        );
        expect(sentence(95, true), "computed for 1.9 s and waited 0.1 s", "a loop or slow code");
        // Slow code is also named on a busy computer.
        expect(sentence(40, true), "computed for 0.8 s and waited 1.2 s", "a loop or slow code");
        expect(sentence(1, false), "slept for 2.0 s", "waits for");
    }

    #[test]
    fn returns_none_with_fewer_than_two_samples() {
        let mut occupation = Occupation::default();
        let at = HostTime::from_ns(5);
        assert_eq!(occupation.since(at), None);
        occupation.add(Look { at, computed_ns: 0, wants_processor: true });
        assert_eq!(occupation.since(at), None);
        for _ in 0..1000 {
            occupation.add(Look { at, computed_ns: 0, wants_processor: true });
        }
        assert_eq!(occupation.0.len(), LOOKS);
    }

    #[test]
    fn parses_schedstat_and_stat() {
        assert_eq!(computed_ns("12345 678 9\n"), 12345);
        assert_eq!(computed_ns(""), 0);
        assert!(wants_processor("12 (a) b) R 1 77") && !wants_processor("12 (R) S 1 77"));
        let own = Look::at(HostTime::from_ns(1), &[Pid::this()]);
        assert!(own.computed_ns > 0 && own.wants_processor, "{own:?}");
    }
}
